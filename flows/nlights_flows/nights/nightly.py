"""The Prefect flow `nightly`: an inbox of artworks, a subflow `digitise` for each."""

# No `from __future__ import annotations` here: Prefect resolves the parameters' types itself.
import html
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from prefect import flow
from prefect.artifacts import create_markdown_artifact
from prefect.states import Completed, Failed

from nlights_core.names.control_characters import escape_controls
from nlights_flows.nights.notifying import take_address
from nlights_flows.nights.order import Batch, Order
from nlights_flows.nights.pictures import thumbnail
from nlights_flows.nights.record import PAGE, night_exit_code
from nlights_flows.nights.running import elsewhere, run_night
from nlights_flows.tiles.digitise import digitise, each_tile_through
from nlights_flows.tiles.environment import outlive_reader
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Around
from nlights_flows.tiles.streams import faults_escaped

SHOWN = 20
"""Artworks of which the artifact shows a picture; artifacts are to stay small."""


@flow(name="nightly", persist_result=False, validate_parameters=True)
def nightly(
    inbox: str,
    out: str,
    recipe: str = "default",
    store: str | None = None,
    until: str | None = None,
    limits: str = "default",
    settle: float = 300.0,
    compression: Literal["none", "zstd"] = "none",
    copies: bool = False,
    timeout: float | None = None,
    memory: str | None = None,
    runner: str = "here",
    address: str | None = None,
) -> Any:
    """Digitise every finished upload of an inbox; one page says what became of it.

    Parameters
    ----------
    inbox : str
        Folder into which captures are uploaded; the capture root of all of them.
    out : str
        Folder of the products and of the page ``night.html``.
    recipe : str
        Name of a shipped recipe, or a path.
    store : str, optional
        Folder of the artefacts; ``<out>/.store`` by default.
    until : str, optional
        Time of the day, HH:MM; nothing is started that would not end by then.
    limits : str
        Path of the limits of the quality numbers; the shipped ones by default.
    settle : float
        Seconds for which a folder without the file ``upload-complete`` must have been quiet.
    compression : {"none", "zstd"}
        Of the TIFFs among the products.
    copies : bool
        Copy the products out of the store, instead of sharing their place on the disk.
    timeout : float, optional
        Seconds that a stage may take.
    memory : str, optional
        Memory that a tile may take, as 6GiB.
    runner : str
        Where tiles run: "here", or "dask", on the workers of a Dask scheduler.
    address : str, optional
        Of the scheduler; without one, workers are started on this machine.

    Returns
    -------
    State
        Completed, or Failed when an artwork or tile failed; both carry "record" (what ``night.json``
        holds) and "exit_code" as their data.
    """
    # The address of a web hook is a secret, and parameters stand in Prefect's pages.
    order = Order(Path(inbox), RunOptions.of(locals()), until, limits, settle, take_address(None))
    outlive_reader()
    with faults_escaped(), elsewhere(order) as (order, at_once):
        record = run_night(order, run_as_subflow, at_once)
    found = record.as_json()
    create_markdown_artifact(artifact(found), key="night", description=found["verdict"])
    data = {"record": found, "exit_code": night_exit_code(record)}
    message = f"{found['verdict']}: {order.options.out / PAGE}"
    return Failed(message=message, data=data) if data["exit_code"] else Completed(message=message, data=data)


def run_as_subflow(batch: Batch, around: Around) -> None:
    """Run an artwork's tiles as a flow run that has the artwork's inventory number as its name."""
    options = replace(batch.night.options, tiles=tuple(tile.name for tile in batch.tiles))
    # Prefect fills in what stands in braces.
    name = escape_controls(batch.artwork).replace("{", "{{").replace("}", "}}")
    named = digitise.with_options(flow_run_name=name)
    with each_tile_through(around):
        state: Any = named(artwork=str(batch.manifest), **options.plain(), return_state=True)
    if isinstance(state.data, BaseException):  # not a tile's fault: that is among the outcomes
        raise state.data
    if not state.is_final():
        raise RuntimeError(f"the flow run ended as {state.name}: {state.message}")


def artifact(record: Mapping[str, Any]) -> str:
    """A night as a small table in Markdown, with pictures of the first artworks."""
    out = Path(record["out"])
    lines = [
        f"**{record['verdict']}**",
        "",
        f"Page: `{out / PAGE}`",
        "",
        "| | artwork | state | tiles | |",
        "|---|---|---|---|---|",
    ]
    shown = 0
    for artwork in record["artworks"]:
        picture = ""
        products = next((tile["products"] for tile in artwork["tiles"] if tile["products"]), None)
        if products and shown < SHOWN:
            shown += 1
            data = thumbnail(out / products, out, draw=False)
            picture = f"![]({data})" if data else ""
        messages = [artwork["message"], *(tile["message"] for tile in artwork["tiles"])]
        messages += [note for tile in artwork["tiles"] for note in tile["notes"]]
        told = next((message for message in messages if message), "")
        name = " ".join(filter(None, (artwork["artwork"] or artwork["folder"], artwork["title"])))
        done = sum(tile["state"] in ("done", "unchanged") for tile in artwork["tiles"])
        cells = (picture, _plain(name), artwork["state"], f"{done} of {len(artwork['tiles'])}", _plain(told))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Text that stays text in a table of Markdown."""
    whole = html.escape(escape_controls(" ".join(text.split())))
    return "".join(f"\\{letter}" if letter in "\\`*_[]|!#~" else letter for letter in whole)
