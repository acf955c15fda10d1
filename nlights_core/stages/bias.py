"""The stage that says how the flat's normals are distorted."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import NormalDetrend, NormalSolver
from nlights_core.capture import Tile
from nlights_core.contracts import verbs
from nlights_core.fields import NormalField
from nlights_core.files.arrays import read_array, write_array
from nlights_core.machine.progress import Progress
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.solving import band_solving
from nlights_core.stages.inputs import FLATS, facts_of_photographs, read_lights
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("photographs", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def bias(
    store: Store,
    tile: Tile,
    detrend: NormalDetrend,
    solver: NormalSolver,
    lights: ArtefactRef,
    flat_field: ArtefactRef | None,
) -> Work:
    """The distortion that the flat's normals show: ``bias.npy``."""
    facts = facts_of_photographs(store, tile, "flats")
    _, solved = describe("normals", tile.artwork, tile.name, rests_on=RESTS_ON, algorithm=solver)
    facts["solver"] = solved["algorithm"]
    inputs = {"lights": lights, "flat_field": flat_field}
    ref, record = describe(
        "bias", tile.artwork, FLATS, rests_on=RESTS_ON, algorithm=detrend, inputs=inputs, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)
        divisor = read_flat_field(store.path(flat_field)) if flat_field else None
        with store.scratch() as scratch, darkroom(tile, scratch, flats=True) as room:
            band_solving.solve_tile(room, solver, field, divisor, None, scratch, progress)
            reference = NormalField(read_array(scratch / "normals.npy"), room.grid)
            write_array(folder / "bias.npy", verbs.bias(detrend, reference))

    return Work(ref, record, make)
