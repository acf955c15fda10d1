"""The stage that solves normals and albedo."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import NormalSolver
from nlights_core.calibration.correction import (
    correct_strip,
    known_lights,
    leave_out_unreached,
    take_out_gloss,
)
from nlights_core.calibration.record import read_calibration
from nlights_core.calibration.reflectance import Reflectance
from nlights_core.calibration.sampling import flat_field_of, mean_flat
from nlights_core.capture import Tile
from nlights_core.fields import LightField
from nlights_core.files.arrays import read_array
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.progress import Progress
from nlights_core.near_light.overview import Enlarged, block_edge
from nlights_core.photographs.development import Band, Rows, darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.noise import read_noise
from nlights_core.photographs.strips import Blocks, Optics, Strip
from nlights_core.solving import band_solving
from nlights_core.solving.correction import Correction
from nlights_core.stages.inputs import facts_of_photographs, read_lights, shifts_of, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("calibration", "integration", "near_light", "photographs", "solving")
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
    alignment: ArtefactRef | None = None,
) -> Work:
    """Normals and what is solved with them; the files are listed in `nlights_core.solving.band_solving`.

    ``height`` is the `overview` or the `calibration`, where there is one; what the latter found is taken out of the
    photographs, and their noise is what it says.  ``photographed``: the flat field is, so that it
    makes the albedo absolute.  Shifts that an ``alignment`` found are taken out of the photographs.
    """
    tile = with_mask(store, tile)
    facts = facts_of_photographs(store, tile, "frames")
    white = facts["white_reflectance"] = tile.white_reflectance if photographed else None
    inputs = {"lights": lights, "flat_field": flat_field, "bias": bias, "height": height}
    if alignment:
        inputs["alignment"] = alignment
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
        removed = read_array(store.path(bias) / "bias.npy") if bias else None
        shifts = shifts_of(store, alignment)
        with store.scratch() as scratch, darkroom(tile, scratch, shifts=shifts) as room:
            if flat_field:
                known = height and read_noise(store.path(height))
                room.noise = known or read_noise(store.path(flat_field)) or room.noise
            correction = None
            if height and height.stage == "calibration" and divisor is not None:
                shared = read_calibration(store.path(height)).shared
                room.veil = shared.additive * mean_flat(divisor)
                field, divisor = known_lights(field, divisor, shared), flat_field_of(divisor, field, shared)
                correction = _correction(store.path(height), room.grid, before, shared.reflectance, field)
            band_solving.solve_tile(
                room, solver, field, divisor, before, folder, progress, removed, white, correction
            )

    return Work(ref, record, make)


def _correction(
    calibration: Path, grid: PixelGrid, height: Rows | None, reflectance: Reflectance, lights: LightField
) -> Correction | None:
    """Make what takes out of a band of samples what is not of a matt surface under a known flat; None: nothing."""
    missed = read_calibration(calibration).unreached > 0
    if reflectance.matt and not missed:
        return None

    def correct(band: Band) -> Band:
        rows = None if height is None else height[band.start : band.stop]
        if missed:
            band = leave_out_unreached(band, grid, rows, lights)
        return band if reflectance.matt else take_out_gloss(band, grid, rows, reflectance)

    def correct_blocks(strip: Strip, optics: Optics, blocks: Blocks) -> Array:
        return correct_strip(strip, optics, blocks, grid, reflectance, missed)

    return Correction(correct, correct_blocks)
