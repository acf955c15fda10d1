"""The stage that removes a trend from the height."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import HeightDetrend
from nlights_core.capture import Tile
from nlights_core.capture_warnings import gathered
from nlights_core.contracts import verbs
from nlights_core.fields import HeightMap
from nlights_core.files.arrays import BandWriter, read_array, write_array
from nlights_core.integration.known_heights import read_known_heights, write_differences
from nlights_core.machine.progress import Progress, telling
from nlights_core.photographs.development import bands_of_grid
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "photographs")
"""Departments whose code decides the result, beside what all results rest on."""


def trend(store: Store, tile: Tile, detrend: HeightDetrend, height: ArtefactRef) -> Work:
    """Height without its trend, ``height.npy``, and what was removed, ``trend.npy``.

    Where the detrend needs known heights, ``known_heights.csv`` says what became of each.
    """
    given = tile.known_heights if "known_heights" in detrend.needs else None
    facts = {}
    if given:
        told = given.model_dump(mode="json", exclude={"file"})
        facts["known_heights"] = {"name": given.file.name, "file": store.digest(given.file), **told}
    ref, record = describe(
        "trend",
        tile.artwork,
        tile.name,
        rests_on=RESTS_ON,
        algorithm=detrend,
        inputs={"height": height},
        facts=facts,
    )

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        before = read_array(store.path(height) / "height.npy")
        known = read_known_heights(given) if given else None
        field = HeightMap(before, grid, known)
        with gathered(folder), telling(progress):
            removed = verbs.trend(detrend, field)
        write_array(folder / "trend.npy", removed)
        with BandWriter(folder / "height.npy", before.shape) as file:
            for start, stop in bands_of_grid(grid, 12):
                file.write(before[start:stop] - removed[start:stop])
        if known:
            write_differences(folder, field, removed, known)

    return Work(ref, record, make)
