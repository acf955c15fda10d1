"""``python -m nlights``: the command line."""

from nlights_flows.commands.cli import main

if __name__ == "__main__":
    main()
