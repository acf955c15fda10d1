"""The stage that writes the products that are meshes."""

from __future__ import annotations

from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.files.arrays import read_array
from nlights_core.machine.progress import Progress
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.products.writing import write_meshes
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("photographs", "products", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def mesh(store: Store, tile: Tile, maps: ArtefactRef, height: ArtefactRef) -> Work:
    """Products that are meshes: a vertex per pixel, and a decimated one."""
    ref, record = describe(
        "mesh", tile.artwork, tile.name, rests_on=RESTS_ON, inputs={"maps": maps, "height": height}
    )

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        surface = read_array(store.path(height) / "height.npy")
        write_meshes(folder, surface, store.path(maps), grid, progress)

    return Work(ref, record, make)
