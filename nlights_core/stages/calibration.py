"""The stage that finds what all pixels of a tile share, in reduced photographs."""

from __future__ import annotations

from pathlib import Path

from nlights_core.calibration.correction import unreached
from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.record import write_calibration, write_nothing
from nlights_core.calibration.uncertainty import smooth_errors
from nlights_core.capture import Tile
from nlights_core.machine.progress import Progress
from nlights_core.near_light.overview import reduced_room
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.noise import read_noise
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("calibration", "integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def calibration(
    store: Store, tile: Tile, lights: ArtefactRef, flat_field: ArtefactRef, groups: tuple[str, ...]
) -> Work:
    """Values that all pixels share, ``calibration.json``; a coarse height and its uncertainty.

    See `nlights_core.calibration`.  ``groups`` are what may be believed of the photographs, and "level" where that is
    sought.  Distant lamps light all heights alike: of them nothing is sought.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames") | {"groups": list(groups)}
    inputs = {"lights": lights, "flat_field": flat_field}
    ref, record = describe(
        "calibration", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field, divisor = read_lights(store, lights), read_flat_field(store.path(flat_field))
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            room.noise = read_noise(store.path(flat_field)) or room.noise
            grid = room.grid
            if not field.near or grid.unit != "mm":
                write_nothing(folder, len(field.lamps), grid)
                return
            small = reduced_room(room, lambda share: progress(0.5 * share))
        found = calibrate(small, field, divisor, groups, lambda share: progress(0.5 + 0.5 * share))
        missed = unreached(small.grid, found.height, field)
        write_calibration(folder, found, smooth_errors(found, field, small.grid), missed)

    return Work(ref, record, make)
