"""The stage that gives a height its constant: its level above the plane of the flat."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlights_core.capture import Tile
from nlights_core.files.arrays import BandWriter, read_array
from nlights_core.frames import Array
from nlights_core.integration.normal_integration import sample_rows
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import Progress
from nlights_core.near_light.overview import Enlarged, block_edge
from nlights_core.photographs.development import bands_of_grid
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def level(store: Store, tile: Tile, height: ArtefactRef, calibration: ArtefactRef) -> Work:
    """Height above the plane of the flat, ``height.npy``: with the constant of the calibration's coarse one."""
    inputs = {"height": height, "calibration": calibration}
    ref, record = describe("level", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs)

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        before = read_array(store.path(height) / "height.npy")
        coarse = Enlarged(
            read_array(store.path(calibration) / "height.npy"), block_edge(grid.columns), grid.shape
        )
        lines = sample_rows(grid)
        apart = [coarse[row : row + 1] - before[row : row + 1] for row in range(*lines.indices(grid.rows))]
        # The median: patches of another material are unlike in both.
        offset = np.float32(np.nanmedian(np.concatenate(apart)))

        def raised(rows: tuple[int, int]) -> Array:
            return np.asarray(before[slice(*rows)] + offset)

        with BandWriter(folder / "height.npy", before.shape) as file:
            for rows in in_order(raised, bands_of_grid(grid, 48)):
                file.write(rows)

    return Work(ref, record, make)
