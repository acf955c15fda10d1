"""Preparing: what a command was told, read and checked before anything is written."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.memory import VARIABLE, parse_size
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.store import Store


def prepared(
    artwork: Path,
    recipe: str,
    out: Path,
    store: Path | None,
    stand: str | None,
    root: Path | None,
    names: Sequence[str] | None,
) -> tuple[Recipe, list[Tile], Store]:
    """Read recipe, stand and manifest; the tiles are those of these names, or all.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What the user has to mend.
    """
    chosen = load_recipe(recipe)
    found = load_capture(artwork, stand=stand, root=root)
    require_named(found, names, str(artwork))
    tiles = [tile for tile in found if not names or tile.name in names]
    lacking = [chosen.lacking(tile) for tile in tiles]
    if all(lacking):
        raise CaptureError("\n".join(f"{artwork}: {sentence}" for sentence in lacking[0]))
    return chosen, tiles, Store(store or out / ".store")


def require_named(tiles: Iterable[Tile], names: Sequence[str] | None, where: str) -> None:
    """See that some tile has each name.

    Raises
    ------
    CaptureError
        When none has; ``where`` says what was looked into.
    """
    there = dict.fromkeys(tile.name for tile in tiles)
    for name in names or ():
        if name not in there:
            raise CaptureError(f"--tile: {where} has no tile '{name}'; it has {', '.join(there)}")


def allow_memory(size: str | None) -> None:
    """Set the memory budget of this process and of those it starts; None leaves it as it is.

    Raises
    ------
    CaptureError
        When it is no size.
    """
    if size is None:
        return
    try:
        os.environ[VARIABLE] = str(parse_size(size))
    except ValueError as fault:
        raise CaptureError(f"--memory: {fault}") from None
