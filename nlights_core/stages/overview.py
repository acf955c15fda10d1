"""The stage that finds height for near light in reduced photographs."""

from __future__ import annotations

from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.files.arrays import write_array
from nlights_core.machine.progress import Progress
from nlights_core.near_light.overview import reduced_room
from nlights_core.near_light.overview import solve_overview as find_overview
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.noise import read_noise
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def overview(
    store: Store, tile: Tile, lights: ArtefactRef, flat_field: ArtefactRef | None, passes: int
) -> Work:
    """Height for near light, from reduced photographs: ``height.npy``.

    See `nlights_core.near_light.overview`.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames") | {"passes": passes}
    inputs = {"lights": lights, "flat_field": flat_field}
    ref, record = describe("overview", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)
        divisor = read_flat_field(store.path(flat_field)) if flat_field else None
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            noise = read_noise(store.path(flat_field)) if flat_field else None
            room.noise = noise or room.noise
            small = reduced_room(room, lambda share: progress(0.7 * share))
        write_array(folder / "height.npy", find_overview(small, field, divisor, passes))

    return Work(ref, record, make)
