"""The command `nlights compare`: variants on the same captures, answered with error bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from nlights_flows.commands.options import (
    Compression,
    CompressionOption,
    Memory,
    Prefect,
    Root,
    StandOption,
    StoreOption,
    Tiles,
    Timeout,
)

if TYPE_CHECKING:
    from nlights_flows.comparison.order import Order

SEVERAL = ("--recipes", "--grid")
"""Options that take every word up to the next option."""


def spread(words: Sequence[str]) -> list[str]:
    """Repeat an option of several values before each of them, as the command line's parser wants it.

    Examples
    --------
    >>> spread(["a.yaml", "--recipes", "x", "y", "--out", "z"])
    ['a.yaml', '--recipes', 'x', '--recipes', 'y', '--out', 'z']
    """
    found: list[str] = []
    current = ""
    for i, word in enumerate(words):
        if word == "--":
            return [*found, *words[i:]]
        name, equals, value = word.partition("=")
        if name in SEVERAL:
            current = name
            last = i + 1 == len(words) or words[i + 1].startswith("-")
            if equals:
                found += [name, value]
            elif last:  # the parser then says that a value is missing
                found.append(name)
        elif word.startswith("-") and word != "-":
            current = ""
            found.append(word)
        else:
            found += [current, word] if current else [word]
    return found


class _SeveralValues(TyperCommand):
    """A command some of whose options take several values at once."""

    def parse_args(self, context: Any, words: list[str]) -> list[str]:
        return super().parse_args(context, spread(words))


def compare(
    artworks: Annotated[
        list[Path],
        typer.Argument(metavar="ARTWORK...", help="Manifests of captures, or the folders that hold them."),
    ],
    recipes: Annotated[
        list[str] | None,
        typer.Option("--recipes", metavar="RECIPE...", help="Shipped recipes or files to compare."),
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            metavar="FIELD=VALUE,VALUE...",
            help="Compare every combination, as integrator=simchony,frankot-chellappa passes=1,3.",
        ),
    ] = None,
    recipe: Annotated[
        str, typer.Option("--recipe", metavar="RECIPE", help="The recipe that --grid varies.")
    ] = "default",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where page and products go.")] = Path(
        "comparison"
    ),
    store: StoreOption = None,
    stand: StandOption = None,
    root: Root = None,
    tile: Tiles = None,
    compression: CompressionOption = Compression.NONE,
    memory: Memory = None,
    timeout: Timeout = None,
    prefect: Prefect = False,
) -> None:
    """Compare recipes on the same photographs, with error bars.

    Writes `OUT/compare.html`, `OUT/compare.json` and the products of every variant.  Stages that
    variants have in common are made once.  Errors are against the truth where a capture has a
    folder `truth`; a winner is named only where the differences are more than chance.
    """
    given = {**locals(), "tiles": tile}
    from nlights_flows.comparison.order import Order, check_comparison, run_comparison, run_directly
    from nlights_flows.tiles import environment
    from nlights_flows.tiles.run_options import RunOptions

    options = RunOptions.of(given)
    order = Order(artworks, recipes or [], grid or [], options)
    if prefect or environment.api_configured():
        check_comparison(order)  # a misspelt recipe need not wait for Prefect
        record = _run_flow(order)
    else:
        record = run_comparison(order, run_directly)
    show(record, out)
    raise typer.Exit(exit_code(record))


def _run_flow(order: Order) -> dict[str, Any]:
    """Compare as a Prefect flow."""
    from nlights_flows.tiles import environment

    with environment.prefect_at_hand():
        from nlights_flows.comparison.compare import compare as flow

        state: Any = flow(
            artworks=[str(path) for path in order.artworks],
            recipes=list(order.recipes),
            grid=list(order.grid),
            **order.options.plain("runner", "address", "copies"),
            return_state=True,
        )
        record = state.data if isinstance(state.data, dict) else state.result(raise_on_failure=False)
        if isinstance(record, BaseException):
            raise record
    return record


def show(record: Mapping[str, Any], out: Path) -> None:
    """Print what was found, and every failure."""
    from nlights_flows.comparison.page import describe_metric, overall
    from nlights_flows.tiles import console

    for run in record["runs"]:
        if run["state"] == "failed":
            console.complain(f"{run['variant']}: {run['tile']}: failed: {run['message']}")
    for note in record["notes"]:
        console.complain(note)
    console.say(overall(record["metrics"]))
    for metric in record["metrics"]:
        console.say(describe_metric(metric) if metric["over"] else f"{metric['title']}: not measured.")
    spent = record["seconds"]
    console.say(f"stages made: {spent['stages']:.1f} s; in all: {spent['all']:.1f} s")
    console.say(out / "compare.html")


def exit_code(record: Mapping[str, Any]) -> int:
    """0: all variants are done on all tiles; 1: some failed; 2: no two variants can be compared."""
    if len(record["compared"]) < 2 or not any(tile["compared"] for tile in record["tiles"]):
        return 2
    return int(any(run["state"] == "failed" for run in record["runs"]))


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(cls=_SeveralValues)(compare)
