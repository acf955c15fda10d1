"""Height from gradients that are not everywhere known, or not everywhere equally certain.

A step from one pixel to the next counts by its certainty, which follows from the normals.  The
direction T from a point of the surface to the next is at right angles to the normal n; n is
uncertain by an angle sigma, so ``n.T / |T|``, the sine by which a step misses that, has the standard
deviation sigma whatever the slope.  Between the step t of the solution and the step d that the
normal says the sine is ``f (t - d) / |T(t)|`` with ``f = -n.E`` (`nlights_core.sight_lines`), so
the weight is ``f^2 / (sigma^2 |T(t)|^2)``.  For slopes g and parallel rays that is a standard deviation
of ``sigma (1 + g^2)`` along the slope and ``sigma sqrt(1 + g^2)`` across it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration import (
    Stencil,
    add_plane,
    bands,
    certain_steps,
    height_steps,
    mean_per_island,
    mean_steps,
)
from nlights_core.multigrid import Multigrid, weighted_laplacian
from nlights_core.sight_lines import ray_slopes

PASSES = 4
"""How often weights are found anew from the height that the last ones gave."""

PASS_TOLERANCE, LAST_TOLERANCE = 1e-3, 1e-4
"""A pass, and the last one, ends when the residual has fallen to this share of a plane's."""

OUTLYING = 5.0
"""Steps that miss by more standard deviations count by the size of the miss, not by its square."""

LEAST_ERROR = float(np.radians(0.05))
"""No normal of middling certainty is believed to be better than this angle."""

WEIGHTS = 1e-6, 1e3
"""Shares of the middle weight between which weights are kept, so that the iteration converges."""

UNEVEN = 8.0
"""A slope is far less certain than the middle one when its standard deviation is so many times its."""

SAMPLE = 1_000_000
"""Steps that a median is taken of, about."""


@dataclass(frozen=True)
class _Steps:
    """Steps from pixel to pixel: along the rows (axis 1, H x W-1) or the columns (axis 0, H-1 x W)."""

    axis: int
    step: Array
    """Less the mean plane's; 0 where not known."""
    certainty: Array
    """Inverse variance of the sine by which a step misses; 0 where not known."""
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


def masked_least_squares(
    per_column: Array,
    per_row: Array,
    *,
    stencil: Stencil = "6-point",
    tolerance: float = 1e-8,
    most_iterations: int = 1000,
) -> Array:
    """Integrate what is known of a gradient, each connected island by itself.

    The same least squares as `simchony`, over the steps between two known pixels only; solved by
    conjugate gradients.

    Parameters
    ----------
    per_column, per_row : (H, W) float32 or float64 arrays
        Height steps per pixel; NaN in either where not known.
    stencil : {"6-point", "trapezoid"}
        See `nlights_core.integration.height_steps`.
    tolerance : float
        The iteration ends when the residual, in the norm of the preconditioner, has fallen to
        this share of its start.
    most_iterations : int
        The iteration ends here in any case.

    Returns
    -------
    (H, W) array
        Height in the precision of the gradients, NaN where not known.  The gradients say nothing
        about the height of one island over another: each has mean 0.
    """
    known = np.isfinite(per_column) & np.isfinite(per_row)
    per_column, per_row = (np.where(known, g, np.nan) for g in (per_column, per_row))
    if not known.any():
        return per_column + per_row
    tilt = mean_steps(per_column, per_row)
    directions = [
        _steps(1, height_steps(per_column, stencil), None, tilt[0]),
        _steps(0, height_steps(per_row.T, stencil).T, None, tilt[1]),
    ]
    precision = np.result_type(per_column, per_row)
    del per_column, per_row
    height = np.zeros(known.shape)
    _solve(height, directions, [d.certainty for d in directions], tolerance, most_iterations)
    return _finished(height, known, tilt, precision)


def weighted_least_squares(
    per_column: Array,
    per_row: Array,
    facing: Array,
    uncertainty: Array | None,
    grid: PixelGrid,
    *,
    stencil: Stencil = "6-point",
) -> Array:
    """Integrate what is known of a gradient, each step by its certainty, each island by itself.

    The first pass weighs all steps alike, which takes every slope at its word; then `PASSES` times
    the height gives each step its weight, as the module says, and the weights the height.  A step
    that misses by more than `OUTLYING` standard deviations of all steps (1.48 medians) counts by
    the size of its miss instead of its square (pseudo-Huber): where one part of an object hides
    another the height jumps, and no normal says so.

    Parameters
    ----------
    per_column, per_row : (H, W) float arrays
        Height steps per pixel, as `nlights_core.sight_lines.seen_gradient` gives them.
    facing : (H, W) float array
        As `nlights_core.sight_lines.facing_rays` gives it; NaN where not known.
    uncertainty : (H, W) float array, optional
        Standard deviation of the angle of each normal, relative to the middle one.  None: even.
    grid : PixelGrid
        The same.
    stencil : {"6-point", "trapezoid"}
        See `nlights_core.integration.certain_steps`.

    Returns
    -------
    (H, W) array
        As `masked_least_squares` gives it.

    References
    ----------
    Y. Queau, J.-D. Durou, J.-F. Aujol, "Variational methods for normal integration", J. Math.
    Imaging Vis. 60 (2018) 609-632, for losses that let the height jump.
    """
    known = np.isfinite(facing)
    if not known.any():
        return per_column + per_row
    tilt = mean_steps(per_column, per_row)
    variance = (1 if uncertainty is None else uncertainty**2) / facing**2
    across, down = (
        certain_steps(gradient, spread, stencil)
        for gradient, spread in ((per_column, variance), (per_row.T, variance.T))
    )
    directions = [_steps(1, *across, tilt[0]), _steps(0, down[0].T, down[1].T, tilt[1])]
    del variance, across, down
    height = np.zeros(known.shape)
    weights = [(d.certainty > 0).astype(np.float32) for d in directions]
    _solve(height, directions, weights, PASS_TOLERANCE)
    for left in reversed(range(PASSES)):
        del weights
        weights = _weights(height, directions, grid)
        _solve(height, directions, weights, PASS_TOLERANCE if left else LAST_TOLERANCE)
    return _finished(height, known, tilt, np.result_type(per_column, per_row))


def relative_uncertainty(confidence: Array, known: Array) -> Array:
    """A solver's standard uncertainties as multiples of their median.

    Parameters
    ----------
    confidence : (H, W) float array
        Standard uncertainty of the normal, in any unit; NaN where the solver does not know it.
    known : (H, W) bool array
        Where there is a normal.

    Returns
    -------
    (H, W) float32 array
        From 0.01 to 100; 1 where not stated.
    """
    stated = np.isfinite(confidence) & (confidence > 0)
    if not (stated & known).any():
        return np.ones(confidence.shape, np.float32)
    ratio = confidence / np.median(confidence[stated & known])
    return np.where(stated, np.clip(ratio, 0.01, 100), 1).astype(np.float32)


def evenly_certain(facing: Array, uncertainty: Array | None) -> bool:
    """Whether weights would matter little: at most one slope in a thousand is far less certain.

    Parameters
    ----------
    facing : (H, W) float array
        As `nlights_core.sight_lines.facing_rays` gives it; NaN where not known.
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


def _steps(axis: int, step: Array, variance: Array | None, mean: float) -> _Steps:
    known = np.isfinite(step)
    certainty = known.astype(np.float32)
    if variance is not None:
        np.divide(1, variance, out=certainty, where=known, casting="same_kind")
    return _Steps(axis, np.where(known, step - step.dtype.type(mean), 0), certainty, mean)


def _weights(height: Array, directions: Iterable[_Steps], grid: PixelGrid) -> list[Array]:
    """Weights of all steps for a height, the middle one being 1."""
    missed, weight = _sample(height, directions, grid)
    scale = max(1.4826 * float(np.median(missed)), LEAST_ERROR)
    middle = float(np.median(weight))
    weights = []
    for steps in directions:
        found = np.empty(steps.step.shape, np.float32)
        for lines in bands(len(found)):
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


def _solve(
    height: Array,
    directions: Iterable[_Steps],
    weights: list[Array],
    tolerance: float,
    most_iterations: int = 200,
) -> None:
    """Weighted least squares by flexible conjugate gradients, from ``height`` and in place.

    The preconditioner runs in float32, all else in float64: in float32 the sum of the source
    over an island is not quite zero, and with many small islands that diverges.
    """
    across, down = weights
    preconditioner = Multigrid(across, down)
    residual = _source(directions, weights)
    enough = tolerance**2 * _dot(residual, preconditioner.correct(residual))
    residual -= weighted_laplacian(height, across, down)
    direction, change = np.zeros_like(residual), np.zeros_like(residual)
    stiffness = 1.0
    for _ in range(most_iterations):
        correction = preconditioner.correct(residual)
        if _dot(residual, correction) <= enough:
            break
        direction *= -_dot(correction, change) / stiffness
        direction += correction
        del correction, change
        change = weighted_laplacian(direction, across, down)
        stiffness = _dot(direction, change)
        length = _dot(direction, residual) / stiffness
        for lines in bands(len(height)):
            height[lines] += length * direction[lines]
            residual[lines] -= length * change[lines]


def _source(directions: Iterable[_Steps], weights: list[Array]) -> Array:
    """What `weighted_laplacian` makes of a height that has just these steps."""
    across, down = directions
    source = np.zeros((len(across.step), down.step.shape[1]))
    for steps, weight, out in ((across.step, weights[0], source), (down.step.T, weights[1].T, source.T)):
        for lines in bands(len(steps)):
            weighted = steps[lines].astype(np.float64) * weight[lines]
            out[lines, 1:] += weighted
            out[lines, :-1] -= weighted
    return source


def _finished(height: Array, known: Array, tilt: tuple[float, float], precision: DTypeLike) -> Array:
    """The plane added again, unknown made NaN, each island's mean taken off."""
    add_plane(height, tilt)
    height[~known] = np.nan
    height -= mean_per_island(height)
    return height.astype(precision)


def _dot(a: Array, b: Array) -> float:
    return float(np.einsum("ij,ij->i", a, b).sum(dtype=np.float64))
