"""The stage that solves normals and albedo."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import NormalSolver
from nlights_core.capture import Tile
from nlights_core.files.arrays import read_array
from nlights_core.machine.progress import Progress
from nlights_core.near_light.levelling import read_level
from nlights_core.near_light.overview import Enlarged, block_edge
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.noise import read_noise
from nlights_core.solving import band_solving
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("integration", "near_light", "photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def normals(
    store: Store,
    tile: Tile,
    solver: NormalSolver,
    lights: ArtefactRef,
    flat_field: ArtefactRef | None = None,
    bias: ArtefactRef | None = None,
    height: ArtefactRef | None = None,
    photographed: bool = False,
) -> Work:
    """Normals and what is solved with them; the files are listed in `nlights_core.solving.band_solving`.

    ``height`` is the `overview`, where there is one.  ``photographed``: the flat field is, so that it
    makes the albedo absolute.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames")
    white = facts["white_reflectance"] = tile.white_reflectance if photographed else None
    inputs = {"lights": lights, "flat_field": flat_field, "bias": bias, "height": height}
    ref, record = describe(
        "normals", tile.artwork, tile.name, rests_on=RESTS_ON, algorithm=solver, inputs=inputs, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)
        divisor = read_flat_field(store.path(flat_field)) if flat_field else None
        before = None
        if height:
            shape = grid_of(tile, survey(tile)).shape
            before = Enlarged(read_array(store.path(height) / "height.npy"), block_edge(shape[1]), shape)
            field = field.stronger(read_level(store.path(height)).strengths)
        removed = read_array(store.path(bias) / "bias.npy") if bias else None
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            if flat_field:
                room.noise = read_noise(store.path(flat_field)) or room.noise
            band_solving.solve_tile(room, solver, field, divisor, before, folder, progress, removed, white)

    return Work(ref, record, make)
