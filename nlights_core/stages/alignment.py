"""The stage that finds how far the photographs of a tile lie from each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.capture_warnings import read_warnings, write_warnings
from nlights_core.machine.progress import Progress
from nlights_core.movement.shifts import find_shifts, warn_of_shifts, write_shifts
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("capture_warnings", "movement", "photographs", "reduced_light")
"""Departments whose code decides the result, beside what all results rest on."""


def alignment(store: Store, tile: Tile, lights: ArtefactRef, agreement: ArtefactRef) -> Work:
    """Shifts of the photographs against each other, ``shifts.json``, and ``warnings.json`` that says them.

    Photographs in which the `agreement` found something else than a movement have no say and are not shifted.
    """
    tile = with_mask(store, tile)
    facts: dict[str, Any] = facts_of_photographs(store, tile, "frames")
    facts |= facts_of_photographs(store, tile, "flats")
    inputs = {"lights": lights, "agreement": agreement}
    ref, record = describe(
        "alignment", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        wrong = {
            lamp
            for warning in read_warnings(store.path(agreement))
            if warning.code != "moved"
            for lamp in warning.lamps
        }
        trusted = [lamp for lamp in tile.lamps if lamp not in wrong]
        with store.scratch() as scratch:
            found = find_shifts(tile, read_lights(store, lights), scratch, trusted)
        write_shifts(folder, found)
        write_warnings(folder, warn_of_shifts(found, tile))

    return Work(ref, record, make)
