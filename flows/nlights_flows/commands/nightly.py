"""The command `nlights nightly`: an inbox of artworks, digitised over night, and one page in the morning."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlights_flows.commands.options import (
    Address,
    Compression,
    CompressionOption,
    Copy,
    Memory,
    Prefect,
    RecipeOption,
    Runner,
    StoreOption,
    Timeout,
)

if TYPE_CHECKING:
    from nlights_flows.nights.order import Order


def nightly(
    inbox: Annotated[
        Path, typer.Argument(metavar="INBOX", help="Folder into which captures are uploaded, a folder each.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where products and pages go.")],
    recipe: RecipeOption = "default",
    store: StoreOption = None,
    until: Annotated[
        str | None,
        typer.Option(
            "--until", metavar="HH:MM", help="Start nothing that would not end by then (the next such time)."
        ),
    ] = None,
    limits: Annotated[
        str,
        typer.Option(
            "--limits", metavar="FILE", help="Limits of the quality numbers; the shipped ones by default."
        ),
    ] = "default",
    settle: Annotated[
        float,
        typer.Option(
            "--settle",
            metavar="SECONDS",
            min=0,
            help="How long a folder without the file upload-complete must have been quiet.",
        ),
    ] = 300.0,
    notify: Annotated[
        str | None,
        typer.Option(
            "--notify",
            metavar="URL",
            help="Web hook that is told at the end: sentence, counts, address of the page. Better in the variable "
            "NLIGHTS_NOTIFY, since it is a secret.",
        ),
    ] = None,
    compression: CompressionOption = Compression.NONE,
    copies: Copy = False,
    timeout: Timeout = None,
    memory: Memory = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Print the order and the estimated time; run nothing.")
    ] = False,
    runner: Runner = "here",
    address: Address = None,
    prefect: Prefect = False,
) -> None:
    """Digitise every finished upload of an inbox; one page says what became of it.

    Writes the products as `digitise` does, and `OUT/night.html`, which is kept in
    `OUT/nights/<date>/` too.  Highest priority first, then the oldest upload.  A fault costs its
    own tile or artwork; what is left is taken up by the next night.
    """
    given = locals()
    from nlights_flows.nights.notifying import take_address
    from nlights_flows.nights.order import Order, check_order
    from nlights_flows.tiles import environment
    from nlights_flows.tiles.run_options import RunOptions
    from nlights_flows.tiles.streams import outlive_listener

    options = RunOptions.of(given)
    order = Order(inbox, options, until, limits, settle, take_address(notify))
    if plan:
        _show_plan(order)
        return
    outlive_listener()
    check_order(order)  # a misspelt recipe need not wait for Prefect
    if prefect or environment.api_configured():
        _run_flow(order)
    from nlights_flows.nights.record import night_exit_code
    from nlights_flows.nights.running import elsewhere, run_here, run_night, run_on_dask

    with elsewhere(order) as (order, at_once):
        record = run_night(order, run_on_dask if order.options.address else run_here, at_once)
    _show(record.as_json(), out)
    raise typer.Exit(night_exit_code(record))


def _run_flow(order: Order) -> None:
    """Run the night as a flow, and end the command with its exit code."""
    from nlights_flows.nights.notifying import VARIABLE
    from nlights_flows.tiles import environment

    if order.notify:  # the flow takes it from there, and no server sees it
        os.environ[VARIABLE] = order.notify
    with environment.prefect_at_hand():
        from nlights_flows.nights.nightly import nightly as flow

        state: Any = flow(
            inbox=str(order.inbox),
            until=order.until,
            limits=order.limits,
            settle=order.settle,
            **order.options.plain("stand", "root", "tiles"),
            return_state=True,
        )
        found = state.data if isinstance(state.data, dict) else state.result(raise_on_failure=False)
        if isinstance(found, BaseException):
            raise found
    _show(found["record"], order.options.out)
    raise typer.Exit(found["exit_code"])


def _show(record: dict[str, Any], out: Path) -> None:
    """Print what became of the night."""
    from nlights_flows.tiles import console

    for artwork in record["artworks"]:
        name = artwork["artwork"] or artwork["folder"]
        if artwork["message"]:
            console.complain(f"{name}: {artwork['state']}: {artwork['message']}")
        for tile in artwork["tiles"]:
            if tile["message"]:
                console.complain(f"{name}/{tile['tile']}: {tile['state']}: {tile['message']}")
            for note in tile["notes"]:
                console.complain(f"{name}/{tile['tile']}: note: {note}")
    console.say(f"{record['verdict']}; {record['seconds']:.1f} s")
    console.say(out / "night.html")


def _show_plan(order: Order) -> None:
    from rich.table import Table

    from nlights_flows.nights.checking import plan_night
    from nlights_flows.nights.order import check_order
    from nlights_flows.nights.page import duration
    from nlights_flows.tiles import console

    night = check_order(order)
    planned, passed_by, _ = plan_night(night)
    table = Table(box=None, pad_edge=False)
    for heading in (
        "artwork",
        "priority",
        "uploaded",
        "tiles",
        "done already",
        "Mpx to run",
        "takes about",
        "ends after",
    ):
        table.add_column(heading, justify="left" if heading in ("artwork", "uploaded") else "right")
    total = 0.0
    for one in planned:
        total += one.seconds
        candidate = one.candidate
        late = ", after --until" if total > night.deadline.left else ""
        table.add_row(
            candidate.artwork,
            str(candidate.priority),
            f"{datetime.fromtimestamp(candidate.uploaded):%Y-%m-%d %H:%M}",
            str(len(candidate.tiles)),
            str(one.finished),
            f"{one.pixels / 1e6:.4g}",
            duration(one.seconds),
            duration(total) + late,
        )
    console.show_table(table)
    for one in planned:
        for problem in one.problems:
            console.complain(problem)
    for passed in passed_by:
        console.complain(f"{passed.folder}: {'failed' if passed.failed else 'waiting'}: {passed.message}")
    console.say(
        f"{len(planned)} artworks, {sum(len(one.candidate.tiles) for one in planned)} tiles, about {duration(total)}"
    )


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(nightly)
