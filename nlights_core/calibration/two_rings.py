"""Two answers: heights by the low and by the high lamps alone, an alarm that needs no model of what is wrong."""

from __future__ import annotations

import warnings

import numpy as np

from nlights_core.calibration.correction import SHADOW, take_out_gloss
from nlights_core.calibration.fitting import Calibration
from nlights_core.calibration.linearisation import CELL, coarse_grid, fill
from nlights_core.calibration.record import TwoAnswers
from nlights_core.calibration.sampling import corrected, flat_field_of, within_flat
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.integration.poisson import simchony
from nlights_core.near_light.overview import ReducedRoom
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving.least_squares import fit, lit

APART_DEG = 10.0
"""Gap between the elevations of lamps by which they are two rings."""

LEAST_LAMPS = 3
"""Of each half."""

CONDITION = 10.0
"""Of the lights of a half, in the middle of the field and in a pixel: a worse one magnifies every error."""

LEAST_PIXELS = 9
"""Of a block, that both halves must know."""

DRAWS = 8
"""Of noise, by which it is told how large the difference of two heights is by chance."""

MOST = 1.2e-4
"""Difference, as a share of the field's longer side, above which something is wrong: 0.06 mm on 500 mm.  Whatever
bends a height scales with the field.  Sound matt captures reach a quarter of it, well calibrated gloss a half."""


def compare_halves(
    room: ReducedRoom, lights: LightField, flat_field: FlatField, found: Calibration
) -> TwoAnswers | None:
    """Compare the heights that two halves of the lamps give, after correction by a calibration.

    Parameters
    ----------
    room : ReducedRoom
        The photographs as means over blocks.
    lights, flat_field : LightField, FlatField
        Near lamps, and what a flat reads, as they were before the calibration.
    found : Calibration
        Of the tile.

    Returns
    -------
    TwoAnswers or None
        None where there are no two halves that can measure, or they share no pixel.
    """
    halves = divide_lamps(lights)
    if halves is None:
        return None
    grey, weights, rays = _corrected_samples(room, lights, flat_field, found)
    slopes = [_slopes(grey[half], weights[half], rays[half]) for half in halves]
    differ = slopes[0] - slopes[1]
    differ[:, found.strange] = np.nan
    means, errors = _on_blocks(differ)
    known = np.isfinite(means[0])
    if not known.any():
        return None
    pixel = coarse_grid(room.grid).pixel_size
    total = _rms(_integrate(means, pixel), known)
    chance = np.random.default_rng(0)
    spread = np.where(known, errors, 0)
    noises = [
        _rms(_integrate(spread * chance.standard_normal(spread.shape), pixel), known) for _ in range(DRAWS)
    ]
    noise = float(np.sqrt(np.mean(np.square(noises))))
    names = [tuple(np.array(lights.lamps)[half].tolist()) for half in halves]
    return TwoAnswers(
        difference=float(np.sqrt(max(total**2 - noise**2, 0))),
        noise=noise,
        low=names[0],
        high=names[1],
        rings=_gap(lights) is not None,
        limit=MOST * max(room.grid.shape) * room.grid.pixel_size,
    )


def divide_lamps(lights: LightField) -> tuple[Array, Array] | None:
    """Indices of the low and of the high lamps; of a stand without rings, of every other lamp around the field.

    None where a half has too few lamps, or stands so that it cannot measure normals.
    """
    at = lights.vectors(np.zeros((3, 1, 1)))[:, 0, 0].astype(np.float64)
    azimuth = np.arctan2(at[:, 1], at[:, 0])
    around = np.argsort(azimuth)
    gap = _gap(lights)
    if gap is None:
        halves = (np.sort(around[::2]), np.sort(around[1::2]))
    else:
        low = _elevations(lights) < gap
        halves = (np.flatnonzero(low), np.flatnonzero(~low))
    if min(map(len, halves)) < LEAST_LAMPS or max(np.linalg.cond(at[half]) for half in halves) > CONDITION:
        return None
    return halves


def _elevations(lights: LightField) -> Array:
    """Elevations of the lamps above the plane, seen from the middle of the field, degrees."""
    at = lights.vectors(np.zeros((3, 1, 1)))[:, 0, 0].astype(np.float64)
    return np.asarray(np.degrees(np.arcsin(at[:, 2] / np.linalg.norm(at, axis=1))))


def _gap(lights: LightField) -> float | None:
    """Elevation between two rings of lamps, degrees; None where there are not two."""
    ordered = np.sort(_elevations(lights))
    steps = np.diff(ordered)[LEAST_LAMPS - 1 : len(ordered) - LEAST_LAMPS]
    if not len(steps) or steps.max() < APART_DEG:
        return None
    below = int(steps.argmax()) + LEAST_LAMPS - 1
    return float(ordered[below : below + 2].mean())


def _corrected_samples(
    room: ReducedRoom, lights: LightField, flat_field: FlatField, found: Calibration
) -> tuple[Array, Array, Array]:
    """Samples of matt paint as far as the calibration goes: grey and weights (L, h, w), and lights (L, h, w, 3)."""
    shared, grid, z = found.shared, room.grid, found.height
    flat = flat_field_of(flat_field, lights, shared)
    raw = room.raw(0, grid.rows, lights)
    scaled = None
    if shared.room:
        band = room.develop(corrected(raw, flat_field, shared, None), lights, flat, z)
        scaled = np.moveaxis(
            fit(band.grey, band.lights, lit(band.grey, band.weights, SHADOW), 100.0).scaled, 0, -1
        )
    band = room.develop(corrected(raw, flat_field, shared, scaled), lights, flat, z)
    band.weights = np.where(
        within_flat(grid, lights, grid.points(0, grid.rows, z)), band.weights, np.float32(0)
    )
    if not shared.reflectance.matt:
        band = take_out_gloss(band, grid, z, shared.reflectance)
    rays = np.broadcast_to(band.lights, (*band.grey.shape, 3))
    return band.grey, lit(band.grey, band.weights, SHADOW), rays


def _slopes(grey: Array, weights: Array, rays: Array) -> Array:
    """Slopes of the surface across and up by some lamps, (2, h, w) float64; NaN where they do not suffice."""
    x, y, z = fit(grey, rays, weights, CONDITION).scaled
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(z > 0, np.stack([-x / z, -y / z]), np.nan))


def _on_blocks(values: Array) -> tuple[Array, Array]:
    """Medians (K, h, w) of blocks, NaN where too few are known, and their standard errors."""
    kinds, rows, columns = values.shape
    down, across = -(-rows // CELL), -(-columns // CELL)
    padded = np.full((kinds, down * CELL, across * CELL), np.nan)
    padded[:, :rows, :columns] = values
    blocks = padded.reshape(kinds, down, CELL, across, CELL).swapaxes(2, 3).reshape(kinds, down, across, -1)
    count = np.isfinite(blocks).sum(axis=-1)
    blocks[count < LEAST_PIXELS] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        means = np.nanmedian(blocks, axis=-1)
        spread = 1.4826 * np.nanmedian(np.abs(blocks - means[..., None]), axis=-1)
    return means, 1.2533 * spread / np.sqrt(np.maximum(count, 1))


def _integrate(slopes: Array, pixel: float) -> Array:
    """Height of mean 0 from slopes across and up, mm."""
    across, up = (fill(part) * pixel for part in slopes)
    return simchony(across, -up)


def _rms(height: Array, known: Array) -> float:
    return float(np.std(height[known]))
