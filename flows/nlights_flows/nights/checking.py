"""Looking at an artwork's tiles before a night runs them: headers only, so that a fault costs nothing."""

from __future__ import annotations

import glob
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from nlights_core.capture import Tile
from nlights_core.errors import NlightsError, TileError
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.recipe import Recipe
from nlights_core.store import ArtefactRef, Store, Work
from nlights_flows.nights.earlier import earlier_nights
from nlights_flows.nights.estimates import UNCHANGED_SECONDS, Estimate, learn_estimate
from nlights_flows.nights.inbox import Candidate, PassedBy, scan
from nlights_flows.nights.order import Checked
from nlights_flows.tiles.chain import digitise_tile
from nlights_flows.tiles.running import require_memory


class _MissingError(Exception):
    """The store has not everything."""


def in_store(tile: Tile, recipe: Recipe, store: Store, compression: str) -> dict[str, ArtefactRef] | None:
    """The artefacts that hold a tile's products, if the store has all that the recipe makes; nothing runs.

    Returns
    -------
    dict or None
    """
    pattern = f"{glob.escape(tile.folder)}/{glob.escape(tile.name)}/report-*"
    if not any(store.root.glob(pattern)):
        return None  # the photographs need not be read to know

    def call(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> ArtefactRef:
        ref = stage(store, tile, *arguments).ref
        if not store.has(ref):
            raise _MissingError
        return ref

    try:
        return digitise_tile(tile, recipe, call, compression)
    except (_MissingError, NlightsError, OSError):
        return None  # running it says what is wrong


def require_usable(tile: Tile, recipe: Recipe) -> int:
    """Refuse a tile that cannot be digitised, as far as headers tell.

    Returns
    -------
    int
        Its pixels.

    Raises
    ------
    TileError
        With what was found and what to do.
    """
    lacking = recipe.lacking(tile)
    if lacking:
        raise TileError("; ".join(lacking))
    try:
        info = survey(tile)
    except OSError as fault:
        raise TileError(
            f"{fault.filename}: cannot be read ({fault.strerror}); see the disk and its permissions"
        ) from None
    grid_of(tile, info)
    require_memory(tile, recipe)
    return info.rows * info.columns


@dataclass(frozen=True)
class Planned:
    """An artwork as a night would take it.

    Attributes
    ----------
    candidate : Candidate
    finished : int
        Tiles of which the store has everything.
    pixels : int
        Of the tiles that would be run.
    seconds : float
        Estimated.
    problems : list of str
        Tiles that cannot be run, as sentences.
    """

    candidate: Candidate
    finished: int
    pixels: int
    seconds: float
    problems: list[str]


def plan_night(night: Checked) -> tuple[list[Planned], list[PassedBy], Estimate]:
    """Say what a night would do, in its order; nothing runs and nothing is written."""
    order, store = night.order, night.store
    estimate = learn_estimate(earlier_nights(order.options.out, night.recipe.name).timed)
    found = scan(order.inbox, order.settle, (order.options.out, store.root))
    planned = []
    for candidate in found.ready:
        finished, pixels, seconds = 0, 0, 0.0
        problems = []
        for tile in candidate.tiles:
            if in_store(tile, night.recipe, store, order.options.compression):
                finished += 1
                seconds += UNCHANGED_SECONDS
                continue
            try:
                size = require_usable(tile, night.recipe)
            except NlightsError as fault:
                problems.append(f"{candidate.artwork}/{tile.name}: {fault}")
            else:
                pixels += size
                seconds += estimate.seconds(size / 1e6)
        planned.append(Planned(candidate, finished, pixels, seconds, problems))
    return planned, found.passed_by, estimate
