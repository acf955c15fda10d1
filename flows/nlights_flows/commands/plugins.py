"""The commands for the authors of plugins: `nlights plugins`, its `list`, `new` and `check`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

KindName = StrEnum(
    "KindName",
    ["light-model", "image-detrend", "normal-solver", "normal-detrend", "integrator", "height-detrend"],
)
"""The six kinds of `nlights_core.algorithms`, as the command line calls them."""

Schema = Annotated[
    bool, typer.Option("--schema", help="Print the JSON schema of a recipe over what is installed.")
]


def register(app: typer.Typer) -> None:
    """Add the group ``plugins`` to the command line."""
    group = typer.Typer(
        name="plugins",
        invoke_without_command=True,
        rich_markup_mode="markdown",
        help="List the installed algorithms; begin a plugin; check that plugins keep their contracts.",
    )
    group.callback()(_by_default)
    group.command("list")(list_)
    group.command()(new)
    group.command()(check)
    app.add_typer(group)


def _by_default(context: typer.Context, schema: Schema = False) -> None:
    if context.invoked_subcommand is None:
        list_(schema)


def list_(schema: Schema = False) -> None:
    """List the algorithms that are installed, by slot, with the distribution they come from."""
    from nlights_core.recipe import recipe_schema
    from nlights_core.registry import installed
    from nlights_flows.tiles import console

    if schema:
        console.say_json(recipe_schema())
    else:
        console.show_plugins(installed())


def new(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="What recipes will call it: lower case, with hyphens.")
    ],
    kind: Annotated[KindName, typer.Option("--kind", help="Which slot of the recipe it fills.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where its folder nlights-NAME goes.")
    ] = Path(),
) -> None:
    """Write a whole distribution with a small algorithm that works: the place to begin from.

    Its tests pass at once.  Nothing is ever overwritten.
    """
    from nlights_flows.plugin_kit.distributions import begin
    from nlights_flows.tiles.streams import say

    folder = begin(name, kind.value, out)
    module = folder.name.replace("-", "_")
    say(f"{folder}: the algorithm is in {module}.py, its contract in test_{module}.py; next:")
    say(f"    pip install -e {folder}")
    say(f"    pytest {folder}")


def check(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME...]", help="Algorithms or distributions; every plugin if not given."),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also what nLights ships.")] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout",
            metavar="SECONDS",
            min=1,
            help="Stop a check that takes longer; its plugin fails, the others go on.",
        ),
    ] = None,
) -> None:
    """Check that installed plugins keep the contracts of their kinds.

    Options have their default values.  Exit codes: 0 all kept, 1 some broken.
    """
    from rich.table import Table

    from nlights_core.registry import installed
    from nlights_flows.plugin_kit.contracts import choose_offers, run_contract
    from nlights_flows.tiles import console

    registry = installed()
    unusable = [one for one in registry.broken if not names or one.distribution in names]
    usable = [name for name in names or [] if name not in {one.distribution for one in unusable}]
    offers = choose_offers(registry, usable, everything) if usable or not names else []
    table = Table(box=None, pad_edge=False)
    for heading in ("slot", "use", "from", "contract"):
        table.add_column(heading, no_wrap=heading != "contract")
    broken = 0
    for offer in offers:
        found = run_contract(offer, timeout)
        if found.ended:
            console.complain(found.ended)
        broken += bool(found.broken)
        said = "\n".join(found.broken) or found.unchecked or "kept"
        table.add_row(offer.algorithm.slot, offer.algorithm.name, offer.origin, said)
    for one in unusable:
        table.add_row("", "", one.origin, one.why)
    broken += len(unusable)
    if table.rows:
        console.show_table(table)
        console.say(
            f"{broken} of {len(table.rows)} break their contract" if broken else "no contract is broken"
        )
    else:
        console.say("no plugins are installed besides what nLights ships (see them with --all)")
    raise typer.Exit(1 if broken else 0)
