"""Linearisation: the normal equations of what all pixels share, with normals and the height's answer eliminated."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nlights_core.calibration.reflectance import FLAT_LOBES, KINDS
from nlights_core.calibration.sampling import Pixels, Samples, develop_pixels, readings_of_constant
from nlights_core.calibration.unknowns import Shared
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.machine.band_threads import in_order
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

DARKEST = 0.1
"""Share of the median albedo below which residuals are not looked at as shares of it."""

PART = 2048
"""Pixels that are worked on together."""

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
    noise : float
        Variance that noise alone gives these.
    noisier : (h, w) float64 array
        Standard deviation of a normal against that of the same paint without gloss, on the same blocks: the light of
        a highlight tells slopes too.
    """

    matrix: Array
    right: Array
    scatter: Array
    bends: Array
    scale: float
    blocks: Array
    noise: float
    noisier: Array


def improve_normals(samples: Samples, shared: Shared, scaled: Array, limit: float, rounds: int) -> Array:
    """Improve scaled normals (N, 3) in place; return the residual of each, in standard deviations."""
    from nlights_core.calibration.compiled_reflectance import solve_normals

    surprise = np.full(len(scaled), np.nan)
    images, weights = (np.ascontiguousarray(a, np.float32) for a in (samples.images, samples.weights))
    lights, views = (np.ascontiguousarray(a, np.float32) for a in (samples.lights, samples.views))

    def some(first: int) -> None:
        last = min(first + 8192, len(scaled))
        solve_normals(
            images, lights, weights, views, shared.gloss, shared.roughnesses, shared.grazing,
            shared.departure, MISFIT, limit,
            rounds, first, last, scaled, surprise,
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
    *,
    places: Array | None = None,
    more: Array | None = None,
    independent: int = INDEPENDENT,
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
    places : (S,) int array, optional
        Of the shared unknowns that are looked at, the level (0) first; default: all.
    more : (N, L, E) float64 array, optional
        Columns of further unknowns, behind those of the shared ones.
    independent : int
        As how many independent pixels they all count.
    """
    from nlights_core.calibration.compiled_elimination import linearise_samples

    here = develop_pixels(room, pixels, lights, flat_field, z)
    above = develop_pixels(room, pixels, lights, flat_field, z + np.float32(STEP))
    constant = readings_of_constant(room, pixels, lights, flat_field, z)
    with np.errstate(divide="ignore", invalid="ignore"):
        dimmer = np.where(here.images != 0, above.images / here.images, 1).astype(np.float32)
    count, size = here.images.shape
    columns = np.empty((size, count, 4 + count + len(KINDS) + len(FLAT_LOBES)))
    slopes, residuals, precisions = np.empty((size, count, 3)), *np.empty((2, size, count))
    given = (here.images, here.lights, here.weights, here.views, above.lights, above.views, dimmer, constant)
    a, b, c, d, e, f, g, h = (np.ascontiguousarray(array, np.float32) for array in given)
    sought = np.arange(len(KINDS))
    if places is not None:
        sought = sought[np.isin(sought + 1 + count, places)]
    values = (
        scaled, shared.gloss, shared.roughnesses, shared.grazing, shared.departure, shared.flat_gloss, sought,
        MISFIT, STEP,
    )  # fmt: skip

    def some(first: int, last: int) -> None:
        linearise_samples(
            a, b, c, d, e, f, g, h, *values, first, last, columns, slopes, residuals, precisions
        )

    in_parts(size, some)
    if places is not None:
        columns = np.take(columns, places, axis=2)
    if more is not None:
        columns = np.concatenate([columns, more], axis=2)
    matt = not shared.gloss.any() and not shared.departure
    rays = None if matt else np.moveaxis(here.lights, 1, 0)
    return _eliminate(room.grid, pixels, columns, slopes, residuals, precisions, scaled, rays, independent)


def _eliminate(
    grid: PixelGrid,
    pixels: Pixels,
    columns: Array,
    slopes: Array,
    residuals: Array,
    precisions: Array,
    scaled: Array,
    rays: Array | None,
    independent: int,
) -> Equations:
    """Eliminate the normals, and add to each column the bend of the height that it makes.

    ``rays`` (N, L, 3) are the derivatives by the scaled normal if the paint were matt; None: it is.
    """
    from nlights_core.calibration.compiled_elimination import add_equations, eliminate_normals

    size, count, unknowns = columns.shape
    usable: Array = np.asarray((precisions > 0).sum(axis=1) > 3)
    precisions[~usable] = 0
    scale = residual_spread(residuals, precisions)
    surprise = residuals**2 * precisions / (TUNING * scale) ** 2
    albedo = np.linalg.norm(scaled, axis=1)
    # As shares of the albedo nearly black pixels would say most.
    albedo[albedo < DARKEST * np.nanmedian(albedo)] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        variances = np.where(precisions > 0, min(scale, 1.0) ** 2 / precisions, np.nan) / albedo[:, None] ** 2
    precisions = precisions / (1 + surprise)
    inverses, tilts = np.empty((size, 6)), np.empty((2, unknowns, size))

    def eliminate(first: int, last: int) -> None:
        eliminate_normals(columns, slopes, precisions, scaled, first, last, inverses, tilts)

    in_parts(size, eliminate)
    usable = np.asarray(precisions.any(axis=1))
    bends, at_pixels = _bends(grid, pixels, tilts, usable)
    scores, matrices = np.empty((size, unknowns)), []

    def add(first: int, last: int) -> None:
        matrix = np.zeros((unknowns, unknowns))
        add_equations(
            columns, slopes, precisions, residuals, inverses, at_pixels, first, last, matrix, scores
        )
        matrices.append((first, matrix))

    in_parts(size, add)
    share = min(1.0, independent / max(int(usable.sum()), 1)) / scale**2
    # In their order, so that the sum is the same however many threads there are.
    matrix = share * np.sum([part for _, part in sorted(matrices, key=lambda one: one[0])], axis=0)
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    right = share * scores.sum(axis=0)
    scatter = _scatter(grid, pixels, share * scores)
    rest = np.where(precisions > 0, residuals / albedo[:, None], np.nan)
    blocks = np.stack([_on_blocks(grid, pixels, rest[:, k], usable) for k in range(count)])
    noise = _noise(grid, pixels, variances, usable)
    noisier = np.ones(bends.shape[1:])
    if rays is not None:
        ratio = _noise_against_matt(inverses, rays, precisions, scaled)
        if np.isfinite(ratio[usable]).any():  # else `fill` would say that there is no noise at all
            noisier = fill(_on_blocks(grid, pixels, ratio, usable))
    return Equations(matrix, right, scatter, bends, scale, blocks, noise, noisier)


def _noise_against_matt(inverses: Array, rays: Array, precisions: Array, scaled: Array) -> Array:
    """Standard deviation of normals over that which matt paint would have, (N,); NaN where not known."""
    upper = np.zeros((len(scaled), 3, 3))
    upper[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] = inverses
    glossy = upper + np.triu(upper, 1).swapaxes(1, 2)
    matrix = np.einsum("nl,nli,nlj->nij", precisions, rays, rays, optimize=True)
    known = (inverses[:, 0] > 0) & (np.linalg.cond(matrix) < 1e9)
    matt = np.full_like(matrix, np.nan)
    matt[known] = np.linalg.inv(matrix[known])
    normals = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    # Only what lies across a normal turns it.
    across = [
        np.trace(one, axis1=1, axis2=2) - np.einsum("nij,ni,nj->n", one, normals, normals)
        for one in (glossy, matt)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(across[0] / across[1]))


def in_parts(size: int, work: Callable[[int, int], None]) -> None:
    """Work on parts of the pixels in threads."""

    def some(first: int) -> None:
        work(first, min(first + PART, size))

    for _ in in_order(some, range(0, size, PART)):
        pass


def residual_spread(residuals: Array, precisions: Array) -> float:
    """Spread of residuals in standard deviations, made up for what the normals have taken."""
    used = precisions > 0
    if not used.any():
        return 1.0
    count = used.sum() / max(int(used.any(axis=1).sum()), 1)
    typical = np.median(np.abs(residuals[used]) * np.sqrt(precisions[used])) / 0.6745
    return max(float(typical * np.sqrt(count / max(count - 3, 0.5))), 1e-6)


def coarse_grid(grid: PixelGrid) -> PixelGrid:
    """The grid of blocks of `CELL` pixels, the last ones in part beside the field."""
    return grid.reduced(CELL, whole=False)


def _on_blocks(grid: PixelGrid, pixels: Pixels, values: Array, usable: Array) -> Array:
    """Mean values of the pixels of each block, (h, w); NaN where there is none."""
    coarse = coarse_grid(grid)
    places = (pixels.rows // CELL) * coarse.columns + pixels.columns // CELL
    fine = usable & np.isfinite(values)
    total = np.bincount(places[fine], values[fine], coarse.rows * coarse.columns)
    number = np.bincount(places[fine], minlength=coarse.rows * coarse.columns)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(number > 0, number, np.nan)).reshape(coarse.shape)


def _noise(grid: PixelGrid, pixels: Pixels, variances: Array, usable: Array) -> float:
    """Variance of the mean residual of a block by noise, of the typical sample."""
    coarse = coarse_grid(grid)
    places = (pixels.rows // CELL) * coarse.columns + pixels.columns // CELL
    number = np.bincount(places[usable], minlength=coarse.rows * coarse.columns)
    if not number.any():
        return 0.0
    free = max(variances.shape[1] - 3, 0) / variances.shape[1]
    return float(np.nanmedian(variances) * np.mean(1 / number[number > 0]) * free)


def _bends(grid: PixelGrid, pixels: Pixels, tilts: Array, usable: Array) -> tuple[Array, Array]:
    """Bends of the integrated height by a unit of each unknown: on blocks (M, h, w), and at the pixels (N, M)."""
    coarse = coarse_grid(grid)
    bends = np.empty((tilts.shape[1], *coarse.shape))
    for m in range(len(bends)):
        across, up = (fill(_on_blocks(grid, pixels, part[m], usable)) for part in tilts)
        bends[m] = simchony(across * coarse.pixel_size, -up * coarse.pixel_size)
    return bends, _between_blocks(bends, pixels)


def _between_blocks(bends: Array, pixels: Pixels) -> Array:
    """Values at the pixels, (N, M), linearly between the blocks' middles; beyond the outermost, theirs."""
    down, across = bends.shape[1:]
    row, column = (
        np.clip((place + 0.5) / CELL - 0.5, 0, length - 1)
        for place, length in ((pixels.rows, down), (pixels.columns, across))
    )
    above, left = row.astype(np.intp), column.astype(np.intp)
    below, right = np.minimum(above + 1, down - 1), np.minimum(left + 1, across - 1)
    s, t = (row - above)[:, None], (column - left)[:, None]
    of = np.ascontiguousarray(np.moveaxis(bends, 0, -1))
    upper = of[above, left] * (1 - t) + of[above, right] * t
    return np.asarray(upper * (1 - s) + (of[below, left] * (1 - t) + of[below, right] * t) * s)


SMOOTH = 1.0
"""Over how many blocks residuals are smoothed."""


def smooth_blocks(equations: Equations) -> Array:
    """Smoothed mean residuals on blocks, (L, h, w), as shares of the albedo."""
    from scipy.ndimage import gaussian_filter

    return np.stack([gaussian_filter(fill(block), SMOOTH, mode="nearest") for block in equations.blocks])


def smooth_residual(equations: Equations) -> float:
    """Smoothed residual beyond noise, which the model misses: rms over the blocks, as a share of the albedo."""
    square = float(np.mean(smooth_blocks(equations) ** 2))
    return float(np.sqrt(max(square - smooth_noise(equations) ** 2, 0.0)))


def smooth_noise(equations: Equations) -> float:
    """Part of a smoothed residual that noise alone leaves, as a share of the albedo."""
    return float(np.sqrt(equations.noise / (4 * np.pi * SMOOTH**2)))


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
