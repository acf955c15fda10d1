"""The stage that integrates normals."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import Integrator
from nlights_core.capture import Tile
from nlights_core.capture_warnings import gathered
from nlights_core.contracts import verbs
from nlights_core.fields import NormalField
from nlights_core.files.arrays import read_array, write_array
from nlights_core.machine.progress import Progress, telling
from nlights_core.memory import require
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "photographs")
"""Departments whose code decides the result, beside what all results rest on."""


def height(store: Store, tile: Tile, integrator: Integrator, normals: ArtefactRef) -> Work:
    """Height from normals: ``height.npy``."""
    ref, record = describe(
        "height",
        tile.artwork,
        tile.name,
        rests_on=RESTS_ON,
        algorithm=integrator,
        inputs={"normals": normals},
    )

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        require(
            integrator.bytes_per_pixel * grid.rows * grid.columns,
            f"{tile.artwork}/{tile.name}: integrator: {integrator.name}",
        )
        source = store.path(normals)
        field = NormalField(read_array(source / "normals.npy"), grid, read_array(source / "confidence.npy"))
        with gathered(folder), telling(progress):
            found = verbs.integrate(integrator, field)
        write_array(folder / "height.npy", found)

    return Work(ref, record, make)
