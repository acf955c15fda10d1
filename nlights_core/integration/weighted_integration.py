"""Height from normals that are not everywhere equally certain.

A step from one pixel to the next counts by its certainty, which follows from the normals.  The
direction T from a point of the surface to the next is at right angles to the normal n; n is
uncertain by an angle sigma, so ``n.T / |T|``, the sine by which a step misses that, has the standard
deviation sigma whatever the slope.  Between the step t of the solution and the step d that the
normal says the sine is ``f (t - d) / |T(t)|`` with ``f = -n.E`` (`nlights_core.integration.sight_lines`), so
the weight is ``f^2 / (sigma^2 |T(t)|^2)``.  For slopes g and parallel rays that is a standard deviation
of ``sigma (1 + g^2)`` along the slope and ``sigma sqrt(1 + g^2)`` across it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.cost import announce, warn_unsettled
from nlights_core.integration.multigrid import MULTIGRID, solve_weighted
from nlights_core.integration.normal_integration import HALO, SAMPLE, sample_rows, sampled_tilt
from nlights_core.integration.poisson import Stencil, certain_steps, row_slices
from nlights_core.integration.sight_lines import facing_rays, ray_slopes, seen_gradient, seen_surface
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import part

LINES = 32
"""Rows that are turned into steps at once."""

STEEPEST_DEG = 89.5
"""Slopes are limited to this angle to the viewing ray."""

PASSES = 4
"""How often weights are found anew from the height that the last ones gave."""

PASS_TOLERANCE, LAST_TOLERANCE = 1e-3, 1e-4
"""A pass, and the last one, ends when the residual has fallen to this share of a plane's."""

PASS_ITERATIONS, LAST_ITERATIONS = 40, 120
"""A pass, and the last one, ends in any case after so many iterations.

Real fields need 2 to 24, and 5 to 70 at the end.  The next pass goes on from where one ended, so
only the last one's matter.
"""

OUTLYING = 5.0
"""Steps that miss by more standard deviations count by the size of the miss, not by its square."""

LEAST_ERROR = float(np.radians(0.05))
"""No normal of middling certainty is believed to be better than this angle."""

WEIGHTS = 1e-6, 1e3
"""Shares of the middle weight between which weights are kept, so that the iteration converges."""

CERTAINTY = 1e-6, 6e4
"""Range of the certainty, the middle one being about 1: what half precision holds."""

UNEVEN = 8.0
"""A slope is far less certain than the middle one when its standard deviation is so many times its."""


@dataclass(frozen=True)
class _Steps:
    """Steps from pixel to pixel: along the rows (axis 1, H x W-1) or the columns (axis 0, H-1 x W)."""

    axis: int
    step: Array
    """Less the mean plane's; 0 where not known."""
    certainty: Array
    """Inverse variance of the sine by which a step misses, float16; 0 where not known."""
    mean: float
    """The mean plane's step."""

    def misses(self, height: Array, grid: PixelGrid, lines: slice) -> tuple[Array, Array]:
        """Standard deviations by which a height misses a band of steps, and what each would weigh."""
        fitted = np.diff(height[lines.start : lines.stop + 1 - self.axis], axis=self.axis)
        fitted = fitted.astype(np.float32)
        steepness = (fitted + np.float32(self.mean)) / np.float32(grid.pixel_size)
        x, y = ray_slopes(grid, lines, np.float32)
        x = x[: fitted.shape[1]]
        squared_tangent = (1 + x**2 + y**2) * steepness**2 - 2 * steepness * (x if self.axis else -y) + 1
        weight = self.certainty[lines] / squared_tangent
        missed = (fitted - self.step[lines]) / np.float32(grid.pixel_size)
        return np.abs(missed) * np.sqrt(weight), weight


def weighted_height(
    normals: Array, grid: PixelGrid, confidence: Array | None = None, *, stencil: Stencil = "6-point"
) -> Array:
    """Integrate what is known of a field of normals, each step by its certainty, each island by itself.

    The first pass weighs all steps alike, which takes every slope at its word; then `PASSES` times
    the height gives each step its weight, as the module says, and the weights the height.  A step
    that misses by more than `OUTLYING` standard deviations of all steps (1.48 medians) counts by
    the size of its miss instead of its square (pseudo-Huber): where one part of an object hides
    another the height jumps, and no normal says so.

    Parameters
    ----------
    normals : (H, W, 3) float array
        Unit vectors in the plane frame, NaN where not known; read in bands.
    grid : PixelGrid
        With a camera its rays are followed.
    confidence : (H, W) float array, optional
        Standard uncertainty of each normal, of which only ratios count; NaN or 0 where it is not
        stated, which is taken as middling.  None: even.
    stencil : {"6-point", "trapezoid"}
        See `nlights_core.integration.poisson.certain_steps`.

    Returns
    -------
    (H, W) array
        z in the grid's unit and the precision of the normals, mean 0 on each island of known
        pixels; NaN where not known.

    Raises
    ------
    TileError
        When there is not the memory for it.

    References
    ----------
    Y. Queau, J.-D. Durou, J.-F. Aujol, "Variational methods for normal integration", J. Math.
    Imaging Vis. 60 (2018) 609-632, for losses that let the height jump.
    """
    most = PASS_ITERATIONS * PASSES + LAST_ITERATIONS
    announce("normals of very different certainty", grid.rows * grid.columns, MULTIGRID, 0, most)
    tilt = sampled_tilt(normals, grid, STEEPEST_DEG)
    directions, known = _directions(normals, grid, confidence, stencil, tilt)
    height = np.zeros(known.shape, normals.dtype)
    if known.any():
        weights = [(d.certainty > 0).astype(np.float32) for d in directions]
        for k in range(PASSES + 1):
            if k:
                del weights
                weights = _weights(height, directions, grid)
            last = k == PASSES
            tolerance = LAST_TOLERANCE if last else PASS_TOLERANCE
            iterations = LAST_ITERATIONS if last else PASS_ITERATIONS
            # The last pass takes as long as all the others.
            with part(k / (2 * PASSES), 1.0 if last else (k + 1) / (2 * PASSES)):
                left = solve_weighted(height, _source(directions, weights), weights, tolerance, iterations)
        del weights
        if left > tolerance:
            warn_unsettled(left, tolerance, iterations)
    del directions
    height[~known] = np.nan
    seen_surface(height, tilt, None if grid.camera is None else grid.camera[2])
    return height


def relative_uncertainty(confidence: Array, middle: float) -> Array:
    """Standard uncertainties as multiples of the middle one, from 0.01 to 100; 1 where not stated."""
    stated = np.isfinite(confidence) & (confidence > 0) & np.isfinite(middle)
    ratio = np.clip(confidence / middle, 0.01, 100)
    return np.where(stated, ratio, 1).astype(np.float32)


def middle_uncertainty(confidence: Array, known: Array) -> float:
    """Median of the uncertainties that are stated (above 0) for known normals; NaN where none is."""
    stated = np.isfinite(confidence) & (confidence > 0) & known
    return float(np.median(confidence[stated])) if stated.any() else np.nan


def evenly_certain(facing: Array, uncertainty: Array | None) -> bool:
    """Test whether weights would matter little: at most one slope in a thousand is far less certain.

    Parameters
    ----------
    facing : (H, W) float array
        As `nlights_core.integration.sight_lines.facing_rays` gives it; NaN where not known.
    uncertainty : (H, W) float array, optional
        Standard deviation of the angle of each normal, relative to the middle one.  None: even.

    Returns
    -------
    bool
        False where ``uncertainty / facing^2``, the standard deviation of the slope, is more than
        `UNEVEN` times its median at more than one known pixel in a thousand.
    """
    spread = (1 if uncertainty is None else uncertainty) / facing**2
    spread = spread[np.isfinite(spread)]
    return spread.size == 0 or bool(np.mean(spread > UNEVEN * np.median(spread)) <= 1e-3)


def _directions(
    normals: Array,
    grid: PixelGrid,
    confidence: Array | None,
    stencil: Stencil,
    tilt: tuple[float, float],
) -> tuple[list[_Steps], Array]:
    """Steps along rows and columns, and where normals are known."""
    rows, columns = grid.shape
    shapes = (rows, columns - 1), (rows - 1, columns)
    step = [np.empty(shape, normals.dtype) for shape in shapes]
    certainty = [np.empty(shape, np.float16) for shape in shapes]
    known = np.empty(grid.shape, bool)
    middle = np.nan
    if confidence is not None:
        some = sample_rows(grid)
        facing = facing_rays(normals[some], grid, some)
        middle = middle_uncertainty(confidence[some], np.isfinite(facing))

    def work(lines: slice) -> None:
        around = slice(max(lines.start - HALO, 0), min(lines.stop + HALO, rows))
        own = slice(lines.start - around.start, lines.stop - around.start)
        below = slice(lines.start, min(lines.stop, rows - 1))
        facing = facing_rays(normals[around], grid, around)
        known[lines] = np.isfinite(facing[own])
        gradient = seen_gradient(normals[around], facing, grid, STEEPEST_DEG, around)
        sigma = 1 / facing
        if confidence is not None:
            sigma *= relative_uncertainty(confidence[around], middle)
        along = certain_steps(gradient[0][own], sigma[own] ** 2, stencil)
        down = certain_steps(gradient[1].T, sigma.T**2, stencil)
        part = slice(own.start, own.start + below.stop - below.start)
        found = along, tuple(a.T[part] for a in down)
        for k, place in enumerate((lines, below)):
            step[k][place] = np.nan_to_num(found[k][0] - found[k][0].dtype.type(tilt[k]))
            certainty[k][place] = np.nan_to_num(np.clip(1 / found[k][1], *CERTAINTY))

    list(in_order(work, row_slices(rows, LINES)))
    return [_Steps(axis, step[k], certainty[k], tilt[k]) for k, axis in enumerate((1, 0))], known


def _weights(height: Array, directions: Iterable[_Steps], grid: PixelGrid) -> list[Array]:
    """Weights of all steps for a height, the middle one being 1."""
    missed, weight = _sample(height, directions, grid)
    scale = max(1.4826 * float(np.median(missed)), LEAST_ERROR)
    middle = float(np.median(weight))
    weights = []
    for steps in directions:
        found = np.empty(steps.step.shape, np.float32)
        for lines in row_slices(len(found)):
            missed, weight = steps.misses(height, grid, lines)
            weight /= np.sqrt(1 + (missed / (OUTLYING * scale)) ** 2)
            kept = np.clip(weight / middle, *WEIGHTS)
            found[lines] = np.where(steps.certainty[lines] > 0, kept, 0)
        weights.append(found)
    return weights


def _sample(height: Array, directions: Iterable[_Steps], grid: PixelGrid) -> tuple[Array, Array]:
    """Misses and weights of known steps on evenly spread lines."""
    every = -(-2 * height.size // SAMPLE)
    samples = []
    for steps in directions:
        for line in range(0, len(steps.step), every):
            known = steps.certainty[line] > 0
            one = slice(line, line + 1)
            samples.append(np.stack([v[0, known] for v in steps.misses(height, grid, one)]))
    missed, weight = np.concatenate(samples, axis=1) if samples else np.ones((2, 1), np.float32)
    return (missed, weight) if missed.size else (np.ones(1), np.ones(1))


def _source(directions: Iterable[_Steps], weights: list[Array]) -> Array:
    """`weighted_laplacian` of a height that has just these steps."""
    across, down = directions
    source = np.zeros((len(across.step), down.step.shape[1]))
    for steps, weight, out in ((across.step, weights[0], source), (down.step.T, weights[1].T, source.T)):
        for lines in row_slices(len(steps)):
            weighted = steps[lines].astype(np.float64) * weight[lines]
            out[lines, 1:] += weighted
            out[lines, :-1] -= weighted
    return source
