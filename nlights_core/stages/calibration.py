"""The stage that finds what all pixels of a tile share, in reduced photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlights_core.calibration.correction import unreached
from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.record import NOISIER, write_calibration, write_nothing
from nlights_core.calibration.two_rings import compare_halves
from nlights_core.calibration.uncertainty import smooth_errors
from nlights_core.capture import Tile
from nlights_core.machine.progress import Progress
from nlights_core.near_light.overview import reduced_room
from nlights_core.photographs.development import Darkroom, darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.noise import Noise, measure_noise_between_lamps, read_noise, write_noise
from nlights_core.photographs.shifted import noise_left
from nlights_core.stages.inputs import facts_of_photographs, read_lights, shifts_of, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("calibration", "integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def calibration(
    store: Store,
    tile: Tile,
    lights: ArtefactRef,
    flat_field: ArtefactRef,
    groups: tuple[str, ...],
    alignment: ArtefactRef | None = None,
) -> Work:
    """Values that all pixels share, ``calibration.json`` and ``noise.json``; a coarse height and its uncertainty.

    See `nlights_core.calibration`.  ``groups`` are what may be believed of the photographs, and "level" where that is
    sought.  Distant lamps light all heights alike: of them nothing is sought.  Shifts that an ``alignment`` found are
    taken out of the photographs.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames") | {"groups": list(groups)}
    facts["flats_averaged"] = tile.flats_averaged
    positions, wandering = None, 0.0
    if tile.stand:
        positions, wandering = tile.stand.uncertainty_mm, tile.stand.lamp.wandering_mm
    facts |= {"positions_mm": positions, "wandering_mm": wandering}
    inputs = {"lights": lights, "flat_field": flat_field}
    if alignment:
        inputs["alignment"] = alignment
    ref, record = describe(
        "calibration", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field, divisor = read_lights(store, lights), read_flat_field(store.path(flat_field))
        shifts = shifts_of(store, alignment)
        with store.scratch() as scratch, darkroom(tile, scratch, shifts=shifts) as room:
            room.noise, noisier = _noise(tile, room, read_noise(store.path(flat_field)))
            write_noise(folder, room.noise)
            grid = room.grid
            if not field.near or grid.unit != "mm":
                write_nothing(folder, len(field.lamps), grid, noisier)
                return
            small = reduced_room(room, lambda share: progress(0.5 * share))
        found = calibrate(small, field, divisor, groups, positions, lambda share: progress(0.5 + 0.5 * share))
        missed = unreached(small.grid, found.height, field)
        answers = compare_halves(small, field, divisor, found)
        errors = smooth_errors(found, field, small.grid, wandering)
        if shifts:
            errors = errors._replace(noisier=errors.noisier * np.float32(noise_left(shifts.values())))
        write_calibration(folder, found, errors, missed, answers, noisier)

    return Work(ref, record, make)


def _noise(tile: Tile, room: Darkroom, flats: Noise | None) -> tuple[Noise, float | None]:
    """Noise of the photographs, and its variance over that of the flats where nobody states either.

    It is the flats', which show it best, unless the photographs are plainly noisier.
    """
    if flats is None:
        return room.noise, None
    if tile.sensor is not None or tile.flats_averaged is not None:
        return flats, None
    own = measure_noise_between_lamps(room.photographs.values(), room.dark, room.mask)
    if own is None:
        return flats, None
    noisier = float(own.gain.mean() / flats.gain.mean())
    return (own if noisier > NOISIER else flats), noisier
