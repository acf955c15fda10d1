"""The stage that finds the lamps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.algorithms import LightModel
from nlights_core.capture import Sphere, Tile
from nlights_core.capture_warnings import gathered
from nlights_core.contracts import verbs
from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.lamps.strengths import refine_by_photographs
from nlights_core.machine.progress import Progress, telling
from nlights_core.names.listed import FOLDERS
from nlights_core.photographs.images import Photograph, probe, reduce_photograph
from nlights_core.photographs.masks import Mask
from nlights_core.stages.inputs import facts_of_photographs, write_json
from nlights_core.store import Store, Work, describe

RESTS_ON = ("lamps", "photographs")
"""Departments whose code decides the result, beside what all results rest on."""


def lights(store: Store, tile: Tile, model: LightModel) -> Work:
    """Positions of the lamps: ``lights.json``."""
    facts: dict[str, Any] = {
        "lamps": tile.lamps,
        "stand": tile.stand.model_dump(mode="json", exclude={"name", "source", "optics"})
        if tile.stand
        else None,
        "spheres": [
            {
                "frames": {lamp: store.digest(path) for lamp, path in sphere.frames.items()},
                "circle_px": sphere.circle_px,
                "points_px": sphere.points_px,
                "mask": store.digest(sphere.mask) if sphere.mask else None,
                "outline": store.digest(sphere.outline) if sphere.outline else None,
            }
            for sphere in tile.spheres
        ],
        "given": {
            name: store.digest(path)
            for name in ("directions", "intensities")
            if tile.lights and (path := getattr(tile.lights, name))
        },
        # A list of lights may name photographs, with the folders that tell them apart.
        "names": ["/".join(path.parts[-1 - FOLDERS :]) for path in tile.frames.values()]
        if tile.lights
        else None,
        "encoding": tile.encoding.model_dump(mode="json") if tile.spheres else None,
    }
    if model.refine:
        facts |= facts_of_photographs(store, tile, "frames")
    ref, record = describe("lights", tile.artwork, tile.name, rests_on=RESTS_ON, algorithm=model, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        masks = {sphere.mask: sphere for sphere in tile.spheres}
        with store.scratch() as scratch:

            def read(path: Path, *, reduce: int = 1) -> Array:
                if path in masks:
                    return _mask(path, masks[path], tile)[::reduce, ::reduce]
                with Photograph(path, tile.encoding, scratch) as photograph:
                    return reduce_photograph(photograph, reduce, keep_saturated=True)

            with gathered(folder), telling(progress):
                field = verbs.locate(model, tile, read)
            if model.refine:
                field = refine_by_photographs(tile, field, model.prior, scratch)
        write_json(folder / "lights.json", field.record())

    return Work(ref, record, make)


def _mask(path: Path, sphere: Sphere, tile: Tile) -> Array:
    """The mask of a sphere, (h, w, 1) float32: 1 on the sphere."""
    mask = Mask(path)
    first = next(iter(sphere.frames.values()))
    info = probe(first, tile.encoding)
    if (mask.rows, mask.columns) != (info.rows, info.columns):
        raise TileError(
            f"{path}: chrome_spheres: mask: size {mask.columns} x {mask.rows} px, but {first.name} has "
            f"{info.columns} x {info.rows} px; draw the mask on a photograph of the sphere"
        )
    return mask.band(0, mask.rows)[..., None].astype(np.float32)
