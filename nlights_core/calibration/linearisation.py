"""Linearisation: the normal equations of what all pixels share, with normals and the height's answer eliminated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nlights_core.calibration.compiled_reflectance import linearise_samples, solve_normals
from nlights_core.calibration.reflectance import ROUGHNESS
from nlights_core.calibration.sampling import Pixels, Samples, develop_pixels, readings_of_constant
from nlights_core.calibration.unknowns import Shared
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.machine.band_threads import cores, in_order
from nlights_core.photographs.development import Darkroom
from nlights_core.photographs.flat_fields import FlatField

STEP = 0.05
"""Difference of height that derivatives are taken over, mm."""

MISFIT = 0.002
"""Share of a reading that the model may miss in every sample."""

TUNING = 2.385
"""Cauchy's loss with this times the spread keeps 95 % of the efficiency of least squares on clean data."""

INDEPENDENT = 1000
"""As how many independent pixels they all count: what is wrong with the flat is wrong for all neighbours."""

CELL = 12
"""Edge, px of the reduced photographs, of the blocks on which what shared unknowns do to the height is computed."""

STRANGE = 8.0
"""Pixels whose residual is so many times the median pixel's are of another material, and have no say."""

CELLS = (6, 8)
"""Parts of the field between which the scatter of the equations is taken."""


class Equations(NamedTuple):
    """Normal equations of what all pixels share.

    Attributes
    ----------
    matrix, right : (M, M) and (M,) float64 arrays
        For a step from the present values, in units of the residuals' variance, as `INDEPENDENT` pixels.
    scatter : (M, M) float64 array
        Covariance of the right-hand side, from its scatter between parts of the field.
    bends : (M, h, w) float64 array
        What a unit of each does to the height, on coarse blocks, mm.
    scale : float
        Spread of the residuals in standard deviations.
    blocks : (L, h, w) float64 array
        Mean residuals as shares of the albedo, on the same blocks; NaN where none is known.
    """

    matrix: Array
    right: Array
    scatter: Array
    bends: Array
    scale: float
    blocks: Array


def improve_normals(samples: Samples, shared: Shared, scaled: Array, limit: float, rounds: int) -> Array:
    """Improve scaled normals (N, 3) in place; return the residual of each, in standard deviations."""
    surprise = np.full(len(scaled), np.nan)
    images, weights = (np.ascontiguousarray(a, np.float32) for a in (samples.images, samples.weights))
    lights, views = (np.ascontiguousarray(a, np.float32) for a in (samples.lights, samples.views))

    def some(first: int) -> None:
        last = min(first + 8192, len(scaled))
        solve_normals(
            images, lights, weights, views, shared.gloss, shared.departure, MISFIT, limit, rounds, first, last,
            scaled, surprise,
        )  # fmt: skip

    for _ in in_order(some, range(0, len(scaled), 8192)):
        pass
    return surprise


def linearise(
    room: Darkroom,
    pixels: Pixels,
    lights: LightField,
    flat_field: FlatField,
    z: Array,
    scaled: Array,
    shared: Shared,
) -> Equations:
    """Linearise the samples of some pixels about the present values.

    Parameters
    ----------
    room : Darkroom
    pixels : Pixels
    lights, flat_field : LightField, FlatField
        As they are believed to be.
    z : (N,) array
        Heights, mm.
    scaled : (N, 3) float64 array
        Scaled normals; NaN: has no say.
    shared : Shared
        Present values.
    """
    here = develop_pixels(room, pixels, lights, flat_field, z)
    above = develop_pixels(room, pixels, lights, flat_field, z + np.float32(STEP))
    constant = readings_of_constant(room, pixels, lights, flat_field, z)
    with np.errstate(divide="ignore", invalid="ignore"):
        dimmer = np.where(here.images != 0, above.images / here.images, 1).astype(np.float32)
    count, size = here.images.shape
    columns = np.empty((size, count, 1 + count + 2 * len(ROUGHNESS) + 3))
    slopes, residuals, precisions = np.empty((size, count, 3)), *np.empty((2, size, count))
    step = -(-size // (4 * cores()))

    def some(first: int) -> None:
        linearise_samples(
            *(np.ascontiguousarray(a, np.float32) for a in (here.images, here.lights, here.weights, here.views)),
            *(np.ascontiguousarray(a, np.float32) for a in (above.lights, above.views, dimmer, constant)),
            scaled, shared.gloss, shared.departure, shared.flat_gloss, MISFIT, STEP, first, min(first + step, size),
            columns, slopes, residuals, precisions,
        )  # fmt: skip

    for _ in in_order(some, range(0, size, step)):
        pass
    return _eliminate(room.grid, pixels, columns, slopes, residuals, precisions, scaled)


def _eliminate(
    grid: PixelGrid,
    pixels: Pixels,
    columns: Array,
    slopes: Array,
    residuals: Array,
    precisions: Array,
    scaled: Array,
) -> Equations:
    """Eliminate the normals, and add to each column the bend of the height that it makes."""
    count = columns.shape[1]
    usable = (precisions > 0).sum(axis=1) > 3
    precisions[~usable] = 0
    scale = residual_spread(residuals, precisions)
    surprise = residuals**2 * precisions / (TUNING * scale) ** 2
    precisions = precisions / (1 + surprise)
    inverse, turned = _inverse(slopes, precisions)
    # Change of the scaled normal per unit of each.
    by_unit = -np.einsum("nab,nbm->nam", inverse, np.swapaxes(turned, 1, 2) @ columns)
    bends, at_pixels = _bends(grid, pixels, scaled, by_unit, usable)
    columns = columns + columns[:, :, :1] * at_pixels[:, None, :]
    by_unit = -np.einsum("nab,nbm->nam", inverse, np.swapaxes(turned, 1, 2) @ columns)
    seen = columns + slopes @ by_unit
    weighted = seen * precisions[:, :, None]
    flat = seen.reshape(-1, seen.shape[-1])
    share = min(1.0, INDEPENDENT / max(int(usable.sum()), 1)) / scale**2
    matrix = share * (flat.T @ weighted.reshape(flat.shape))
    scores = np.einsum("nlm,nl->nm", weighted, residuals)
    right = share * scores.sum(axis=0)
    scatter = _scatter(grid, pixels, share * scores)
    albedo = np.linalg.norm(scaled, axis=1)
    rest = np.where(precisions > 0, residuals / albedo[:, None], np.nan)
    blocks = np.stack([_on_blocks(grid, pixels, rest[:, k], usable) for k in range(count)])
    return Equations(matrix, right, scatter, bends, scale, blocks)


def residual_spread(residuals: Array, precisions: Array) -> float:
    """Spread of residuals in standard deviations, made up for what the normals have taken."""
    used = precisions > 0
    if not used.any():
        return 1.0
    count = used.sum() / max(int(used.any(axis=1).sum()), 1)
    typical = np.median(np.abs(residuals[used]) * np.sqrt(precisions[used])) / 0.6745
    return max(float(typical * np.sqrt(count / max(count - 3, 0.5))), 1e-6)


def _inverse(slopes: Array, precisions: Array) -> tuple[Array, Array]:
    """Covariance of the scaled normals (N, 3, 3), 0 where not known; and slopes times precision."""
    turned = slopes * precisions[:, :, None]
    matrix = np.swapaxes(slopes, 1, 2) @ turned
    trace = np.einsum("nkk->n", matrix)
    known = np.linalg.det(matrix) > 1e-9 * trace**3
    matrix[~known] = np.eye(3)
    inverse = np.linalg.inv(matrix)
    inverse[~known] = 0
    precisions[~known] = 0
    return inverse, np.where(known[:, None, None], turned, 0)


def coarse_grid(grid: PixelGrid) -> PixelGrid:
    """The grid of blocks of `CELL` pixels, the last ones in part beside the field."""
    return PixelGrid(-(-grid.rows // CELL), -(-grid.columns // CELL), grid.pixel_size * CELL)


def _on_blocks(grid: PixelGrid, pixels: Pixels, values: Array, usable: Array) -> Array:
    """Mean values of the pixels of each block, (h, w); NaN where there is none."""
    coarse = coarse_grid(grid)
    places = (pixels.rows // CELL) * coarse.columns + pixels.columns // CELL
    fine = usable & np.isfinite(values)
    total = np.bincount(places[fine], values[fine], coarse.rows * coarse.columns)
    number = np.bincount(places[fine], minlength=coarse.rows * coarse.columns)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(number > 0, number, np.nan)).reshape(coarse.shape)


def _bends(
    grid: PixelGrid, pixels: Pixels, scaled: Array, by_unit: Array, usable: Array
) -> tuple[Array, Array]:
    """What a unit of each unknown does to the integrated height: on blocks (M, h, w), and at the pixels (N, M)."""
    coarse = coarse_grid(grid)
    bx, by, bz = (scaled[:, k, None] for k in range(3))
    with np.errstate(invalid="ignore"):
        across = -(by_unit[:, 0] - bx / bz * by_unit[:, 2]) / bz
        up = -(by_unit[:, 1] - by / bz * by_unit[:, 2]) / bz
    bends = np.empty((by_unit.shape[2], *coarse.shape))
    for m in range(len(bends)):
        steps = [fill(_on_blocks(grid, pixels, part[:, m], usable)) for part in (across, -up)]
        bends[m] = simchony(steps[0] * coarse.pixel_size, steps[1] * coarse.pixel_size)
    # A height that is integrated has no level of its own.
    bends[0] -= bends[0].mean()
    places = np.stack([(pixels.rows + 0.5) / CELL - 0.5, (pixels.columns + 0.5) / CELL - 0.5])
    from scipy.ndimage import map_coordinates

    return bends, np.stack([map_coordinates(bend, places, order=1, mode="nearest") for bend in bends], axis=1)


def fill(values: Array) -> Array:
    """Values with the nearest known one where there is none; 0 where none is known."""
    from scipy.ndimage import distance_transform_edt

    unknown = np.isnan(values)
    if unknown.all():
        return np.zeros_like(values)
    if unknown.any():
        values = values[tuple(distance_transform_edt(unknown, return_distances=False, return_indices=True))]
    return values


def _scatter(grid: PixelGrid, pixels: Pixels, scores: Array) -> Array:
    """Covariance of the scores' sum, from its scatter between parts of the field."""
    down, across = CELLS
    part = (pixels.rows * down // grid.rows) * across + pixels.columns * across // grid.columns
    sums = np.stack([np.bincount(part, column, down * across) for column in scores.T], axis=1)
    apart = sums - sums.mean(axis=0)
    return np.asarray(apart.T @ apart)

