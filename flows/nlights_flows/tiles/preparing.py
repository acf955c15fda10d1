"""Preparing: what a command was told, read and checked before anything is written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.names.artworks import require_own_folder
from nlights_core.recipe import Recipe, RecipeLike, load_recipe
from nlights_core.store import make_writable
from nlights_flows.tiles.run_options import RunOptions


def prepare_run(
    artwork: str | Path, options: RunOptions, recipe: RecipeLike | None = None
) -> tuple[Recipe, list[Tile]]:
    """Read recipe, stand and manifest; the tiles are those that the options name, or all.

    Parameters
    ----------
    artwork : str or Path
        The manifest, or its folder.
    options : RunOptions
        What was asked for.
    recipe : RecipeLike, optional
        Instead of the options', which is a name or a path.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What the user has to mend.
    """
    chosen = load_recipe(options.recipe if recipe is None else recipe)
    found = load_capture(artwork, stand=options.stand, root=options.root)
    require_named(found, options.tiles, str(artwork))
    require_own_folder(found[0].artwork, options.out)
    tiles = [tile for tile in found if not options.tiles or tile.name in options.tiles]
    lacking = [chosen.lacking(tile) for tile in tiles]
    if all(lacking):
        raise CaptureError("\n".join(f"{artwork}: {sentence}" for sentence in lacking[0]))
    return chosen, tiles


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


def make_folders(options: RunOptions) -> None:
    """Make the folders of the products and of the artefacts, or say why they cannot be written.

    Raises
    ------
    CaptureError
        Naming the folder, the reason and the option that chooses another.
    """
    make_writable(options.out, "--out")
    options.artefacts.prepare()
