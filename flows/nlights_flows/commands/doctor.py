"""The command `nlights doctor`: what this installation is and has, and whether its loops are compiled."""

from __future__ import annotations

from typing import Annotated

import typer

from nlights_core.errors import NlightsError


def doctor(
    warm: Annotated[
        bool,
        typer.Option(
            "--warm", help="Compile all loops now, into the installation: no painting then waits for it."
        ),
    ] = False,
    portable: Annotated[
        bool,
        typer.Option(
            "--portable", help="With --warm: also for older processors, as a container needs that others run."
        ),
    ] = False,
) -> None:
    """Say what this installation has: versions, cores, memory, disk, compiled loops.

    With `--warm`, do what is needed once per machine and version: compile the loops over pixels.
    Whoever installs nLights for others runs it as the owner of the installation.
    """
    from nlights_flows.tiles import console, examination

    if portable and not warm:
        raise NlightsError("--portable: goes with --warm; nothing is compiled without it")
    if warm:
        _prepare(portable)
    console.show_facts(examination.facts())


def _prepare(portable: bool) -> None:
    from nlights_flows.tiles import console
    from nlights_flows.tiles.kernel_preparation import prepare_kernels

    with console.compiling_bar() as progress:
        count, folder = prepare_kernels(progress, portable)
    if folder is None:
        console.complain(
            "doctor --warm: compiled loops cannot be kept: neither the installation nor a home folder can be "
            "written; run it as the owner of the installation, or set NUMBA_CACHE_DIR to a folder of your own"
        )
        raise typer.Exit(2)
    console.say(
        f"compiled {count} loops; all are in {folder}" if count else f"all loops are compiled: {folder}"
    )


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(doctor)
