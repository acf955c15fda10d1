"""Stages: references in, one reference out; the only place where files meet algorithms.

Each function names the work (`nlights_core.store.Work`) without doing it, so that planning,
calling directly and running as a Prefect task are the same words.  ``Work.make`` gets, runs and
puts; an algorithm never sees a file, and a stage never sees Prefect.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.algorithms import (
    HeightDetrend,
    ImageDetrend,
    Integrator,
    LightModel,
    NormalDetrend,
    NormalSolver,
)
from nlights_core.capture import Tile
from nlights_core.contracts import verbs
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, LightField, NormalField
from nlights_core.files.arrays import BandWriter, read_array, write_array
from nlights_core.frames import Array
from nlights_core.lamps.emission import check_flat, write_flat_check
from nlights_core.lamps.strengths import refined
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import Progress
from nlights_core.memory import require
from nlights_core.near_light import levelling
from nlights_core.near_light.levelling import Level, read_level, write_level
from nlights_core.near_light.overview import Enlarged, block_edge, reduced_room
from nlights_core.near_light.overview import overview as find_overview
from nlights_core.photographs.block_means import block_means
from nlights_core.photographs.development import bands, darkroom
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.images import Photograph, reduced
from nlights_core.photographs.noise import read_noise, write_noise
from nlights_core.photographs.plates import block_size, continued, read_plate, vignetting, write_plate
from nlights_core.solving import band_solving
from nlights_core.stages.product_stages import maps, mesh, report
from nlights_core.store import ArtefactRef, Store, Work, describe

__all__ = [
    "bias",
    "height",
    "level",
    "lights",
    "maps",
    "mesh",
    "normals",
    "overview",
    "plate",
    "read_lights",
    "report",
    "trend",
]

FLATS = "_flats"
"""Where artefacts go that belong to a flat set, not to a tile; no tile can have this name."""


ROWS = 8
"""Of each block of a flat, that are looked at: smoothed, that leaves 0.01 % of noise."""


def _photographed(store: Store, tile: Tile, which: str) -> dict[str, Any]:
    """Digests and settings of the photographs that a stage reads."""
    paths = tile.flats if which == "flats" else tile.frames
    if paths is None:
        raise TileError(
            f"{tile.artwork}/{tile.name}: flats: the recipe needs photographs of a flat white reference; add "
            "flats to artwork.yaml, or choose another detrend.images (inverse-square)"
        )
    stand = tile.stand
    digests = dict(zip(paths, in_order(store.digest, paths.values()), strict=True))
    seen: dict[str, str] = {}
    for lamp, digest in digests.items():
        if digest in seen:
            raise TileError(
                f"{paths[lamp]}: {which}.{lamp}: is the very photograph of {seen[digest]} "
                f"({paths[seen[digest]].name}); name the one that was taken under {lamp}"
            )
        seen[digest] = lamp
    return {
        which: digests,
        "dark": store.digest(tile.dark) if tile.dark else None,
        "mask": store.digest(tile.mask) if tile.mask and which == "frames" else None,
        "encoding": tile.encoding.model_dump(mode="json"),
        "sensor": tile.sensor.model_dump(mode="json") if tile.sensor else None,
        "field_mm": stand.field_mm if stand else None,
        "camera": stand.camera_position.tolist() if stand else None,
        "pixel_size_mm": tile.pixel_size_mm,
    }


def lights(store: Store, tile: Tile, model: LightModel) -> Work:
    """Where the lamps are: ``lights.json``."""
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
        "names": [path.name for path in tile.frames.values()] if tile.lights else None,
        "encoding": tile.encoding.model_dump(mode="json") if tile.spheres else None,
    }
    if model.refine:
        facts |= _photographed(store, tile, "frames")
    ref, record = describe("lights", tile.artwork, tile.name, algorithm=model, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        with store.scratch() as scratch:

            def read(path: Path, *, reduce: int = 1) -> Array:
                with Photograph(path, tile.encoding, scratch) as photograph:
                    return reduced(photograph, reduce, keep_saturated=True)

            field = verbs.locate(model, tile, read)
            if model.refine:
                field = refined(tile, field, model.prior, scratch)
        _write_json(folder / "lights.json", field.record())

    return Work(ref, record, make)


def read_lights(store: Store, ref: ArtefactRef) -> LightField:
    """Open the artefact of `lights`."""
    return LightField.from_record(json.loads((store.path(ref) / "lights.json").read_text()))


def plate(store: Store, tile: Tile, detrend: ImageDetrend, lights: ArtefactRef) -> Work:
    """What a flat white plate reads: ``plate.npy`` and where its samples are, ``plate.json``."""
    if "flats" in detrend.needs:
        facts = _photographed(store, tile, "flats")
    else:
        facts = _photographed(store, tile, "frames") | {"frames": None}
        facts["size"] = _size(tile)
    ref, record = describe(
        "plate", tile.artwork, FLATS, algorithm=detrend, inputs={"lights": lights}, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)
        info = survey(tile)
        grid = grid_of(tile, info)
        block = block_size(grid)
        x, y = grid.block_centres(block)
        flats = None
        if "flats" in detrend.needs:
            with store.scratch() as scratch, darkroom(tile, scratch, flats=True) as room:
                means = block_means(room, block, ROWS, progress)
                flats = means.images / field.power.astype(np.float32)[:, None, None, :]
                flats[means.saturated] = np.nan
                write_noise(folder, room.noise)

        def measured() -> None:
            reading = verbs.plate(detrend, flats, field, x, y, info.channels)
            found = continued(reading, x, y, block * grid.pixel_size)
            if flats is not None and grid.camera is not None and field.near:
                lens = vignetting(reading, field, x, y, grid.camera)
                found = replace(found, camera=grid.camera, vignetting=lens)
            write_plate(folder, found)

        def checked() -> None:
            if flats is not None and tile.stand is not None and field.near:
                write_flat_check(folder, check_flat(flats, tile.stand, field.lamps, x, y))

        for _ in in_order(lambda work: work(), (measured, checked)):
            pass

    return Work(ref, record, make)


def _size(tile: Tile) -> list[int]:
    info = survey(tile)
    return [info.rows, info.columns]


def bias(
    store: Store,
    tile: Tile,
    detrend: NormalDetrend,
    solver: NormalSolver,
    lights: ArtefactRef,
    plate: ArtefactRef | None,
) -> Work:
    """The distortion that the flat reference's normals show: ``bias.npy``."""
    facts = _photographed(store, tile, "flats")
    _, solved = describe("normals", tile.artwork, tile.name, algorithm=solver)
    facts["solver"] = solved["algorithm"]
    inputs = {"lights": lights, "plate": plate}
    ref, record = describe("bias", tile.artwork, FLATS, algorithm=detrend, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field, flat = read_lights(store, lights), read_plate(store.path(plate)) if plate else None
        with store.scratch() as scratch, darkroom(tile, scratch, flats=True) as room:
            band_solving.solve(room, solver, field, flat, None, scratch, progress)
            reference = NormalField(read_array(scratch / "normals.npy"), room.grid)
            write_array(folder / "bias.npy", verbs.bias(detrend, reference))

    return Work(ref, record, make)


def overview(store: Store, tile: Tile, lights: ArtefactRef, plate: ArtefactRef | None, passes: int) -> Work:
    """Height for near light, from reduced photographs: ``height.npy`` and ``level.json``.

    See `nlights_core.near_light.overview`.
    """
    facts = _photographed(store, tile, "frames") | {"passes": passes}
    inputs = {"lights": lights, "plate": plate}
    ref, record = describe("overview", tile.artwork, tile.name, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field, flat = read_lights(store, lights), read_plate(store.path(plate)) if plate else None
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            noise = read_noise(store.path(plate)) if plate else None
            room.noise = noise or room.noise
            small = reduced_room(room, lambda share: progress(0.7 * share))
            grid = room.grid
        levels = noise is not None and field.near and grid.unit == "mm"
        height, level = find_overview(small, field, flat, passes, levels)
        write_level(folder, level)
        write_array(folder / "height.npy", height)

    return Work(ref, record, make)


def normals(
    store: Store,
    tile: Tile,
    solver: NormalSolver,
    lights: ArtefactRef,
    plate: ArtefactRef | None = None,
    bias: ArtefactRef | None = None,
    height: ArtefactRef | None = None,
    photographed: bool = False,
) -> Work:
    """Normals and what is solved with them; the files are listed in `nlights_core.solving.band_solving`.

    ``height`` is the `overview`, where there is one.  ``photographed``: the plate is, so that it
    makes the albedo absolute.
    """
    facts = _photographed(store, tile, "frames")
    white = facts["white_reflectance"] = tile.white_reflectance if photographed else None
    inputs = {"lights": lights, "plate": plate, "bias": bias, "height": height}
    ref, record = describe("normals", tile.artwork, tile.name, algorithm=solver, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field, flat = read_lights(store, lights), read_plate(store.path(plate)) if plate else None
        before = None
        if height:
            shape = grid_of(tile, survey(tile)).shape
            before = Enlarged(read_array(store.path(height) / "height.npy"), block_edge(shape[1]), shape)
            field = field.stronger(read_level(store.path(height)).strengths)
        removed = read_array(store.path(bias) / "bias.npy") if bias else None
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            if plate:
                room.noise = read_noise(store.path(plate)) or room.noise
            band_solving.solve(room, solver, field, flat, before, folder, progress, removed, white)

    return Work(ref, record, make)


def height(store: Store, tile: Tile, integrator: Integrator, normals: ArtefactRef) -> Work:
    """Height from normals: ``height.npy``."""
    ref, record = describe(
        "height", tile.artwork, tile.name, algorithm=integrator, inputs={"normals": normals}
    )

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        require(
            integrator.bytes_per_pixel * grid.rows * grid.columns,
            f"{tile.artwork}/{tile.name}: integrator: {integrator.name}",
        )
        source = store.path(normals)
        field = NormalField(read_array(source / "normals.npy"), grid, read_array(source / "confidence.npy"))
        write_array(folder / "height.npy", verbs.integrate(integrator, field))

    return Work(ref, record, make)


def trend(store: Store, tile: Tile, detrend: HeightDetrend, height: ArtefactRef) -> Work:
    """Height without its trend, ``height.npy``, and what was removed, ``trend.npy``."""
    ref, record = describe("trend", tile.artwork, tile.name, algorithm=detrend, inputs={"height": height})

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        before = read_array(store.path(height) / "height.npy")
        removed = verbs.trend(detrend, HeightMap(before, grid))
        write_array(folder / "trend.npy", removed)
        with BandWriter(folder / "height.npy", before.shape) as file:
            for start, stop in bands(grid, 12):
                file.write(before[start:stop] - removed[start:stop])

    return Work(ref, record, make)


def level(
    store: Store,
    tile: Tile,
    lights: ArtefactRef,
    plate: ArtefactRef,
    height: ArtefactRef,
    overview: ArtefactRef,
) -> Work:
    """Height above the plane of the flat, ``height.npy``, and what was found, ``level.json``.

    See `nlights_core.near_light.levelling`.  For distant lamps there is nothing to find.  The ``overview`` knows
    with which strengths of the lamps the height was measured.
    """
    facts = _photographed(store, tile, "frames")
    inputs = {"lights": lights, "plate": plate, "height": height, "overview": overview}
    ref, record = describe("level", tile.artwork, tile.name, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        field, flat = read_lights(store, lights), read_plate(store.path(plate))
        before = read_array(store.path(height) / "height.npy")
        found = Level(0.0, None, np.ones(len(field.lamps)))
        with store.scratch() as scratch, darkroom(tile, scratch) as room:
            grid = room.grid
            if field.near and grid.unit == "mm":
                room.noise = read_noise(store.path(plate)) or room.noise
                assumed = read_level(store.path(overview)).strengths
                found = levelling.level(room, field, flat, before, assumed)
        write_level(folder, found)

        def raised(rows: tuple[int, int]) -> Array:
            return np.asarray(before[slice(*rows)] + np.float32(found.offset))

        with BandWriter(folder / "height.npy", before.shape) as file:
            for rows in in_order(raised, bands(grid, 48)):
                file.write(rows)

    return Work(ref, record, make)


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
