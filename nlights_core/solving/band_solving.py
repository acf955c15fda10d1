"""The normal stage's work: solve bands of a tile and write what was found.

Files, all on the photograph's grid: ``normals.npy`` (H, W, 3), ``albedo.tif`` and ``reflection.tif``
(H, W[, 3]) as they leave the system, ``confidence.npy`` and ``residual.npy`` (H, W), all float32, and
``used.npy``, ``saturated.npy`` and ``shadow.npy`` (H, W) uint8: counts of lights.  ``frames.npy``
(L, h, w, C) float32 are small views of the photographs.  ``agreement.json`` is what
`nlights_core.solving.agreement` found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.contracts import verbs
from nlights_core.fields import LightField
from nlights_core.files.arrays import BandWriter, write_array
from nlights_core.files.tiffs import BandTiff
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.machine.progress import Progress
from nlights_core.photographs.development import Band, Darkroom, Rows
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving.agreement import AgreementMeter, write_agreement
from nlights_core.solving.correction import Correction
from nlights_core.solving.kernels import Images

SHADOW = 0.02
"""A light that shows less than this share of what the brightest one shows is counted as shadow."""

ARRAYS: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
    "normals": ((3,), np.float32),
    "confidence": ((), np.float32),
    "residual": ((), np.float32),
    "used": ((), np.uint8),
    "saturated": ((), np.uint8),
    "shadow": ((), np.uint8),
}
"""Arrays that are written, by name: what follows rows and columns in their shape, and their type."""

COLOURS = {
    "albedo": "Albedo; {}; NaN where not known",
    "reflection": "Apparent colour (mean over the lamps) minus albedo; {}; signed",
}
"""What the maps in colour say of themselves."""

AMBIENT_ROUNDS = 4
"""Ambient light is a share of an albedo that is itself solved for; the fixed point of that is
reached to 1e-4 in four rounds for an ambient share of 10 %."""


def solve_tile(
    room: Darkroom,
    solver: NormalSolver,
    lights: LightField,
    flat_field: FlatField | None,
    height: Rows | None,
    folder: Path,
    progress: Progress,
    bias: Array | None = None,
    white: float | None = None,
    correction: Correction | None = None,
) -> None:
    """Solve a tile band by band into a folder.

    Parameters
    ----------
    room : Darkroom
        The open photographs.
    solver : NormalSolver
        Sees one band of plain arrays at a time.
    lights, flat_field : LightField, FlatField or None
        See `nlights_core.photographs.development`.
    height : (H, W) array or None
        Height of the pass before, mm.
    folder : Path
        Where the files go.
    progress : callable
        Told the share done.
    bias : (H, W, 3) array, optional
        Subtracted from the normals, which are then made unit again.
    white : float, optional
        Albedo of the flat, which makes the albedo absolute; None without a photographed flat.
    correction : Correction, optional
        Takes out what is not of a matt surface, before it is solved.

    Raises
    ------
    TileError
        When a photograph cannot be read or says nothing.
    """
    meter = AgreementMeter(room.grid, partial(solve_band, solver))
    strips = _strips(room, solver, lights, flat_field, height, white, meter, correction)
    with ExitStack() as stack:
        out: dict[str, BandWriter | BandTiff] = {
            name: stack.enter_context(BandWriter(folder / f"{name}.npy", (*room.grid.shape, *more), kind))
            for name, (more, kind) in ARRAYS.items()
        }
        for name in COLOURS:
            out[name] = stack.enter_context(_coloured(folder / f"{name}.tif", room, white))
        for start, stop, images in strips:
            for name, image in images._asdict().items():
                if name == "normals" and bias is not None:
                    image = image - bias[start:stop]
                    image /= np.linalg.norm(image, axis=-1, keepdims=True)
                out[name].write(image)
            progress(stop / room.grid.rows)
    write_agreement(folder, meter.found())
    write_array(folder / "frames.npy", room.views())


def _strips(
    room: Darkroom,
    solver: NormalSolver,
    lights: LightField,
    flat_field: FlatField | None,
    height: Rows | None,
    white: float | None,
    meter: AgreementMeter,
    correction: Correction | None,
) -> Iterator[tuple[int, int, Images]]:
    """Solve strip by strip: by compiled loops where they can, or else by bands."""
    scale = 1.0 if white is None else white
    plain = not room.veil and not lights.ambient.any()
    if available() and flat_field is not None and plain:
        from nlights_core.solving.fused_solving import FusedSolver

        fused = FusedSolver(room, solver, lights, flat_field, height, SHADOW, scale, correction)
        return fused.strips(meter)
    correct = correction.of_band if correction else None
    return _by_bands(room, solver, lights, flat_field, height, scale, meter, correct)


def _coloured(path: Path, room: Darkroom, white: float | None) -> BandTiff:
    """A map in colour, as it leaves the system: the bytes are written once, and linked from then on."""
    said = "linear, relative (there was no flat)"
    if white is not None:
        said = f"linear, 1 is a perfect diffuser (flat of reflectance {white:g})"
    shape = (*room.grid.shape, 3) if room.info.channels == 3 else room.grid.shape
    what = COLOURS[path.stem].format(said)
    return BandTiff(
        path, shape, np.float32, grid=room.grid, description=what, icc=room.info.icc, read_soon=True
    )


def _by_bands(
    room: Darkroom,
    solver: NormalSolver,
    lights: LightField,
    flat_field: FlatField | None,
    height: Rows | None,
    scale: float,
    meter: AgreementMeter,
    correct: Callable[[Band], Band] | None,
) -> Iterator[tuple[int, int, Images]]:
    """Solve where there is no flat field, or ambient light; and without compiled loops."""

    def imaged(raw: Band) -> tuple[Images, Band]:
        band = correct(raw) if correct else raw
        found = solve_band(solver, band)
        shading = _shading(found, band)
        albedo = np.float32(scale) * coloured_albedo(band.images, shading, found.weights)
        images = Images(
            normals=found.normals,
            albedo=albedo,
            reflection=np.float32(scale) * _apparent(raw) - albedo,
            confidence=found.confidence,
            residual=relative_residual(band.grey, shading, found),
            used=_count(found.weights > 0),
            saturated=_count(band.saturated),
            shadow=_count(_shadowed(band)),
        )
        return images, band

    for _, (images, band) in room.bands(imaged, lights, flat_field, height):
        meter.add(band)
        yield band.start, band.stop, images


def solve_band(solver: NormalSolver, band: Band) -> Solution:
    """Solve a band; where there is ambient light, subtract its share and solve again."""
    images = band.grey
    found = verbs.solve(solver, images, band.lights, band.weights)
    if band.ambient is not None:
        for _ in range(AMBIENT_ROUNDS):
            share = band.ambient * np.nan_to_num(found.albedo)
            found = verbs.solve(solver, images - share, band.lights, band.weights)
    return found


def _shading(found: Solution, band: Band) -> Array:
    """Shading of an albedo of 1 under each light, (L, h, w) float32."""
    shading = np.empty(band.weights.shape, np.float32)
    for i, light in enumerate(band.lights):
        shading[i] = np.einsum("hwk,hwk->hw", np.broadcast_to(light, found.normals.shape), found.normals)
    if band.ambient is not None:
        shading += band.ambient
    return shading


def coloured_albedo(images: Array, shading: Array, weights: Array) -> Array:
    """Albedo of every channel, with the normal known.

    ``albedo_c = sum(w s I_c) / sum(w s^2)``, s the shading (numerics, section 2).

    Parameters
    ----------
    images : (L, h, w, C) float32 array
    shading, weights : (L, h, w) float32 arrays
        Weight 0: the sample was discarded.

    Returns
    -------
    (h, w, C) float32 array
        NaN where not known.
    """
    out: Array = np.zeros(images.shape[1:], np.float32)
    total = np.zeros(images.shape[1:3], np.float32)
    for image, s, w in zip(images, shading, weights, strict=True):
        share = np.where(w > 0, w * s, np.float32(0))
        out += share[..., None] * image
        total += np.where(w > 0, share * s, np.float32(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        albedo: Array = out / np.where(total > 0, total, np.float32(np.nan))[..., None]
    return albedo


def relative_residual(images: Array, shading: Array, found: Solution) -> Array:
    """Weighted rms of what the solution does not explain, as a share of the albedo, (h, w)."""
    squares = np.zeros(found.albedo.shape, np.float32)
    total = np.zeros(found.albedo.shape, np.float32)
    for image, s, w in zip(images, shading, found.weights, strict=True):
        missed = np.where(w > 0, image - found.albedo * s, np.float32(0))
        squares += w * missed**2
        total += w
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.where(total > 0, total, np.nan)) / found.albedo)


def _apparent(band: Band) -> Array:
    """Apparent colour: the mean over lamps, as a flat matt surface of that albedo would show it."""
    upward = sum(np.broadcast_to(light[..., 2], band.images.shape[1:3]) for light in band.lights)
    return np.asarray(band.images.sum(axis=0) / np.asarray(upward)[..., None], np.float32)


def _shadowed(band: Band) -> Array:
    """Usable samples below `SHADOW` of the pixel's brightest, whatever the solver did with them."""
    images = band.grey
    brightest = np.max(np.where(band.weights > 0, images, np.float32(0)), axis=0)
    return np.asarray((band.weights > 0) & (images < SHADOW * brightest))


def _count(flags: Array) -> Array:
    count: Array = np.minimum(np.count_nonzero(flags, axis=0), 255).astype(np.uint8)
    return count
