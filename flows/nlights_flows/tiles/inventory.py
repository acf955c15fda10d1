"""Inventory: where the products of an output folder, and the artefacts of a store, are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from nlights_core.products.publishing import FORMER
from nlights_core.products.writing import PROVENANCE
from nlights_flows.tiles.records import QUALITY

MARKS = {PROVENANCE, QUALITY, "report.html"}
"""Files by which a folder is known to hold the products of a tile, even where one of them is lost."""


def product_folders(out: Path, *, former: bool = False) -> Iterator[Path]:
    """Folders with the products of a tile, by name, in any depth; links are not followed.

    ``former``: those kept in ``.former`` too.
    """
    for place, folders, files in os.walk(out):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") or (former and name == FORMER)
        )
        if MARKS & {*files, *folders}:
            folders[:] = [name for name in folders if name not in MARKS]
            yield Path(place)


def artefact_folders(store: Path) -> Iterator[Path]:
    """Folders of artefacts, ``<artwork>/<tile>/<stage>-<key>``, or what stands in the place of one."""
    for place in _shown(store):
        for tile in _shown(place):
            yield from _shown(tile)


def _shown(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:  # no folder, or somebody removes it
        return []


def place_of(products: Path) -> tuple[str, str]:
    """Names of the artwork's folder and of the tile that a folder of products belongs to."""
    parts = products.absolute().parts
    if FORMER in parts:
        return parts[parts.index(FORMER) - 1], products.name
    return parts[-2], products.name
