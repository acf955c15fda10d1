"""Planning: what exists, what would be made, and why; nothing runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.recipe import Recipe
from nlights_core.store import RECORD, ArtefactRef, Store, Work
from nlights_flows.tiles.chain import digitise_tile


@dataclass(frozen=True)
class Step:
    """A stage of a tile.

    Attributes
    ----------
    ref : ArtefactRef
        What it makes.
    exists : bool
        Whether the store has it.
    why : str
        Why it would be made.
    """

    ref: ArtefactRef
    exists: bool
    why: str


def plan(tile: Tile, recipe: Recipe, store: Store) -> list[Step]:
    """Plan a tile.

    Returns
    -------
    list of Step
        In the order of the chain.

    Raises
    ------
    TileError
        When the recipe needs what the tile has not, or a photograph is missing, so that nothing of it can be planned.
    """
    if lacking := recipe.lacking(tile):
        raise TileError("; ".join(lacking))
    found: list[Step] = []

    def call(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> ArtefactRef:
        work = stage(store, tile, *arguments)
        exists = store.has(work.ref)
        found.append(Step(work.ref, exists, "" if exists else why(work, store)))
        return work.ref

    digitise_tile(tile, recipe, call)
    return found


def why(work: Work, store: Store) -> str:
    """Say how a missing artefact differs from the most similar one that the store has."""
    folder = store.path(work.ref).parent
    nearest: list[str] | None = None
    for path in folder.glob(f"{work.ref.stage}-*/{RECORD}"):
        other = _read(path)
        different = sorted(set(_differences(work.record, other)))
        if nearest is None or len(different) < len(nearest):
            nearest = different
    if nearest is None:
        return "not made yet"
    shown = ", ".join(nearest[:3]) + (f" and {len(nearest) - 3} more" if len(nearest) > 3 else "")
    return f"differs in {shown}" if shown else "damaged"


_CAUSES = ("code", "algorithm", "inputs", "facts")


def _differences(mine: dict[str, Any], other: dict[str, Any]) -> Iterator[str]:
    for cause in _CAUSES:
        yield from _leaves(cause, mine.get(cause), other.get(cause))


def _leaves(name: str, mine: Any, other: Any) -> Iterator[str]:
    if isinstance(mine, dict) and isinstance(other, dict):
        for key in {*mine, *other}:
            yield from _leaves(f"{name}.{key}", mine.get(key), other.get(key))
    elif json.dumps(mine, sort_keys=True, default=str) != json.dumps(other, sort_keys=True, default=str):
        yield name


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
