"""Running tiles in this process: each tile on its own, what fails is told and passed by."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nlights_core.capture import Tile
from nlights_core.errors import NlightsError, TileError
from nlights_core.machine.progress import note
from nlights_core.memory import ANY_TILE, require
from nlights_core.names.artworks import require_own_folder
from nlights_core.photographs.headers import survey
from nlights_core.products.publishing import Published, publish
from nlights_core.recipe import Recipe
from nlights_core.store import ArtefactRef, RottenArtefactError, Work
from nlights_flows.tiles import isolation
from nlights_flows.tiles.chain import digitise_tile
from nlights_flows.tiles.explaining import explain_fault
from nlights_flows.tiles.kernel_preparation import compiled_beside
from nlights_flows.tiles.photographs import Photographs
from nlights_flows.tiles.run_options import RunOptions


@dataclass(frozen=True)
class Outcome:
    """Outcome of a tile.

    Attributes
    ----------
    artwork, tile : str
        Which.
    state : {"done", "unchanged", "failed"}
        Unchanged: everything was in the store already.
    folder : Path or None
        The products.
    message : str
        Why it failed, for people.
    seconds : float
        How long it took.
    notes : tuple of str
        Sentences about what was done and may not be expected.
    """

    artwork: str
    tile: str
    state: Literal["done", "unchanged", "failed"]
    folder: Path | None = None
    message: str = ""
    seconds: float = 0.0
    notes: tuple[str, ...] = ()


ROTTEN = 30
"""Artefacts of a tile that are made again, at most: a disk on which more are damaged keeps nothing."""

Around = Callable[[Tile, Callable[[], Outcome]], Outcome | None]
"""Told a tile and how to run it, right before it would be run; None when it declined to."""

Ensure = Callable[..., tuple[ArtefactRef, bool]]
"""How to run a stage: ``ensure(stage, tile, ...)`` gives the artefact and whether the store had it."""

Watch = Callable[[str, str, float], None]
"""Told tile, stage and the stage's share done (1 when it ended)."""


def exit_code(outcomes: Iterable[Outcome]) -> int:
    """0: all done; 1: some tiles failed and others are done; 2: nothing was produced."""
    states = [outcome.state == "failed" for outcome in outcomes]
    if not any(states):
        return 0 if states else 2
    return 2 if all(states) else 1


def run_tile(tile: Tile, recipe: Recipe, options: RunOptions, call: Callable[..., Any]) -> Published:
    """Run the chain for a tile and publish its products.

    Parameters
    ----------
    tile, recipe : Tile, Recipe
        What, and with which algorithms.
    options : RunOptions
        Where artefacts are and products go, and how the products are compressed.
    call : callable
        How to call a stage.

    Returns
    -------
    Published
        The folder of the products, and what was there before.
    """
    if lacking := recipe.lacking(tile):
        raise TileError("; ".join(lacking))
    require_own_folder(tile.artwork, options.out)
    require_memory(tile, recipe)
    store = options.artefacts
    removed: list[str] = []
    while True:
        try:
            with Photographs.watched(tile, recipe, store):
                refs = digitise_tile(tile, recipe, call, options.compression)
            published = publish(store, tile, refs, options.out, copied=options.copies)
        except (
            RottenArtefactError
        ) as fault:  # it is gone: the chain makes it again, and passes by what is whole
            if len(removed) == ROTTEN:
                raise
            removed.append(str(fault))
            note(f"{tile.name}: {fault}")
        else:
            return published._replace(remade=tuple(removed))


def require_memory(tile: Tile, recipe: Recipe) -> None:
    """Refuse a tile that does not fit the memory, before hours are spent on it.

    Only an integrator holds a whole field; everything else takes bands of rows.

    Raises
    ------
    TileError
        With need, budget and remedy.
    """
    try:
        info = survey(tile)
    except (NlightsError, OSError):
        return  # the stage that reads the photographs will say what is wrong with them
    need = ANY_TILE + recipe.integrator.bytes_per_pixel * info.rows * info.columns
    require(need, f"{tile.artwork}/{tile.name}: integrator: {recipe.integrator.name}")


def run_directly(tile: Tile, recipe: Recipe, options: RunOptions, watch: Watch) -> Outcome:
    """Run a tile by calling its stages; never raises for what concerns the tile only.

    For child processes see `ensure_here`.
    """
    return attempt(tile, recipe, options, ensure_here(options, tile.name, watch))


def ensure_here(options: RunOptions, place: str, watch: Watch) -> Ensure:
    """Make a function that runs stages by calling them.

    They run in this process, or each in a child where there is a time-out or a plugin of somebody
    else's: see `nlights_flows.tiles.isolation`.  ``place`` is what ``watch`` is told as the tile.
    """
    store = options.artefacts

    def ensure(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> tuple[ArtefactRef, bool]:
        name = stage.__name__
        watch(place, name, 0.0)
        work = stage(store, tile, *arguments)

        def told(share: float) -> None:
            # 0 and 1 are said here alone: a stage begins once and ends once.
            watch(place, name, min(max(share, 0.01), 0.99))

        there = isolation.ensure(store, work, tile, arguments, told, options.timeout)
        watch(place, name, 1.0)
        return work.ref, there

    return ensure


def attempt(tile: Tile, recipe: Recipe, options: RunOptions, ensure: Ensure) -> Outcome:
    """Run a tile, however its stages are run; never raises for what concerns the tile only."""
    started = time.monotonic()
    made: list[str] = []

    def call(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> ArtefactRef:
        ref, there = ensure(stage, tile, *arguments)
        if not there:
            made.append(ref.stage)
        return ref

    published, message = None, ""
    state: Literal["done", "unchanged", "failed"] = "failed"
    try:
        with compiled_beside(recipe):
            published = run_tile(tile, recipe, options, call)
        state = "done" if made else "unchanged"
    except (Exception, SystemExit) as fault:  # a plugin may even call sys.exit
        message = explain_fault(fault, options.artefacts)
    folder, notes = (published.folder, published.notes) if published else (None, ())
    return Outcome(tile.artwork, tile.name, state, folder, message, time.monotonic() - started, notes)
