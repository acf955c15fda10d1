"""The stage that finds the height of the whole above the flat."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlights_core.capture import Tile
from nlights_core.files.arrays import BandWriter, read_array
from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import Progress
from nlights_core.near_light import levelling
from nlights_core.near_light.levelling import Level, read_level, write_level
from nlights_core.photographs.development import bands_of_grid, darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.noise import read_noise
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def level(
    store: Store,
    tile: Tile,
    lights: ArtefactRef,
    flat_field: ArtefactRef,
    height: ArtefactRef,
    overview: ArtefactRef,
) -> Work:
    """Height above the plane of the flat, ``height.npy``, and what was found, ``level.json``.

    See `nlights_core.near_light.levelling`.  For distant lamps there is nothing to find.  The ``overview`` knows
    with which strengths of the lamps the height was measured.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames")
    inputs = {"lights": lights, "flat_field": flat_field, "height": height, "overview": overview}
    ref, record = describe("level", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field, divisor = read_lights(store, lights), read_flat_field(store.path(flat_field))
        before = read_array(store.path(height) / "height.npy")
        found = Level(0.0, None, np.ones(len(field.lamps)))
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            grid = room.grid
            if field.near and grid.unit == "mm":
                room.noise = read_noise(store.path(flat_field)) or room.noise
                assumed = read_level(store.path(overview)).strengths
                found = levelling.find_level(room, field, divisor, before, assumed)
        write_level(folder, found)

        def raised(rows: tuple[int, int]) -> Array:
            return np.asarray(before[slice(*rows)] + np.float32(found.offset))

        with BandWriter(folder / "height.npy", before.shape) as file:
            for rows in in_order(raised, bands_of_grid(grid, 48)):
                file.write(rows)

    return Work(ref, record, make)
