"""The command `nlights review`: what waits for a person's word, and the word itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlights_core.errors import CaptureError

if TYPE_CHECKING:
    from nlights_flows.nights.limits import Limits


def review(
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="Folder of all products: --out of digitise or nightly.")
    ],
    tile: Annotated[
        str | None, typer.Argument(metavar="[ARTWORK/TILE]", help="The tile that is decided about.")
    ] = None,
    accept: Annotated[bool, typer.Option("--accept", help="The tile is good enough as it is.")] = False,
    repeat: Annotated[bool, typer.Option("--repeat", help="It is to be photographed again.")] = False,
    by: Annotated[str | None, typer.Option("--by", metavar="NAME", help="Who decides.")] = None,
    why: Annotated[str | None, typer.Option("--why", metavar="TEXT", help="The reason.")] = None,
    todo: Annotated[
        bool, typer.Option("--todo", help="Print only what is to be photographed again.")
    ] = False,
    limits: Annotated[
        str,
        typer.Option(
            "--limits", metavar="FILE", help="Limits of the quality numbers; the shipped ones by default."
        ),
    ] = "default",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, nothing else.")] = False,
) -> None:
    """List the tiles outside limits or with warnings; record what a person decides about one.

    A decision stands in `review.json` beside the tile's products, with those before it, and is
    shown on the page of the night.  Where other products take their place it no longer counts.
    """
    from nlights_flows.nights.limits import load_limits

    if accept and repeat:
        raise CaptureError("review: --accept and --repeat exclude each other; give one")
    decides = accept or repeat
    if tile is None and (decides or by is not None or why is not None):
        raise CaptureError("review: name the tile that is decided about, as ARTWORK/TILE")
    table = load_limits(limits)
    if tile is None:
        _list(out, table, todo, as_json)
        return
    if todo:
        raise CaptureError("--todo: is a list of all tiles; leave out the tile")
    if not decides:
        raise CaptureError(f"review: say what is decided about '{tile}': --accept or --repeat")
    if by is None or why is None:
        raise CaptureError(f"review: {'--by NAME' if by is None else '--why TEXT'} is missing")
    _decide(out, tile, accept, by, why, table, as_json)


def _decide(out: Path, tile: str, accept: bool, by: str, why: str, table: Limits, as_json: bool) -> None:
    from nlights_flows.nights.decisions import describe_decision
    from nlights_flows.nights.review import draw_page_anew, record_decision, review_tile
    from nlights_flows.tiles import console

    folder = record_decision(out, tile, "accept" if accept else "repeat", by, why)
    found = review_tile(folder, table)
    if as_json:
        console.say_json(found.as_json())
    else:
        console.say(f"{found.name}: {describe_decision(found.entry.review[-1])}")
    if fault := draw_page_anew(out):
        console.complain(f"the decision is recorded; the page of the night does not show it yet: {fault}")


def _list(out: Path, table: Limits, todo: bool, as_json: bool) -> None:
    from nlights_flows.nights.decisions import describe_decision, standing
    from nlights_flows.nights.review import review_tiles
    from nlights_flows.tiles import console

    tiles = review_tiles(out, table)
    shown = [one for one in tiles if one.state == "repeat" or not (todo or one.state == "fine")]
    if as_json:
        console.say_json({"tiles": [one.as_json() for one in shown]})
        return
    for one in shown:
        decision = standing(one.entry.review)
        console.say(f"{one.name}: {describe_decision(decision) if decision else 'open'}")
        if todo:
            continue
        for sentence in one.reasons:
            console.say(f"    {sentence}")
        for former in one.entry.review:
            if not former["counts"]:
                console.say(f"    before: {describe_decision(former)}")
    counts = {state: sum(one.state == state for one in tiles) for state in ("open", "accepted", "repeat")}
    if todo:
        console.say(f"{counts['repeat']} of {len(tiles)} tiles to be photographed again")
    else:
        console.say(
            f"{counts['open']} of {len(tiles)} tiles open, {counts['accepted']} accepted, "
            f"{counts['repeat']} to be photographed again"
        )


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(review)
