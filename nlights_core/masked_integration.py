"""Height from gradients that are known only in parts of a rectangle: least squares with a mask."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import DTypeLike

from nlights_core.frames import Array
from nlights_core.integration import (
    Stencil,
    add_divergence,
    add_plane,
    bands,
    mean_per_island,
    mean_steps,
    solve_poisson,
)


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
    conjugate gradients, preconditioned by the solution for the whole rectangle.

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
    precision = np.result_type(per_column, per_row)
    tilt = mean_steps(per_column, per_row)
    source = np.zeros(known.shape)
    add_divergence(source, per_column, stencil, tilt[0])
    add_divergence(source.T, per_row.T, stencil, tilt[1])
    del per_column, per_row
    height = _conjugate_gradients(source, known, precision, tolerance, most_iterations)
    add_plane(height, tilt)
    height[~known] = np.nan
    height -= mean_per_island(height)
    return height.astype(precision)


def _conjugate_gradients(
    source: Array, known: Array, precision: DTypeLike, tolerance: float, most_iterations: int
) -> Array:
    """Solve ``laplacian(height) = source`` on the known pixels, from height 0.

    The preconditioner runs in the given ``precision``, all else in float64: in float32 the sum
    of the source over an island is not quite zero, and with many small islands that diverges.
    """
    across, down = known[:, 1:] & known[:, :-1], known[1:] & known[:-1]
    residual = -source
    height, direction = np.zeros_like(residual), np.zeros_like(residual)
    enough = previous = 0.0
    for _ in range(most_iterations):
        correction = _precondition(residual, known, precision)
        power = _dot(residual, correction)
        enough = enough or tolerance**2 * power
        if power <= enough:
            break
        direction *= power / previous if previous else 0.0
        direction += correction
        del correction
        change = _negative_laplacian(direction, across, down)
        length = power / _dot(direction, change)
        for lines in bands(len(height)):
            height[lines] += length * direction[lines]
            residual[lines] -= length * change[lines]
        del change
        previous = power
    return height


def _precondition(residual: Array, known: Array, precision: DTypeLike) -> Array:
    """The rectangle's height for this residual: right but for what the mask's borders do.

    Unknown pixels are added at the far ends until the transforms are fast.
    """
    rows, columns = residual.shape
    extended = [scipy.fft.next_fast_len(side, real=True) for side in residual.shape]
    source = np.zeros(extended, precision)
    source[:rows, :columns] = -residual
    height: Array = solve_poisson(source)[:rows, :columns] * known
    return height


def _negative_laplacian(height: Array, across: Array, down: Array) -> Array:
    """What each pixel's height exceeds its known neighbours' by; ``across``, ``down``: known steps."""
    excess = np.zeros_like(height)
    for steps_known, z, out in ((across, height, excess), (down.T, height.T, excess.T)):
        for lines in bands(len(z)):
            steps = (z[lines, 1:] - z[lines, :-1]) * steps_known[lines]
            out[lines, 1:] += steps
            out[lines, :-1] -= steps
    return excess


def _dot(a: Array, b: Array) -> float:
    return float(np.einsum("ij,ij->i", a, b).sum(dtype=np.float64))
