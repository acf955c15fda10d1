"""Height from gradients that are not everywhere known, all that are known counting the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from nlights_core.frames import Array
from nlights_core.integration.cost import announce, warn_unsettled
from nlights_core.integration.masked_poisson import solve_embedded
from nlights_core.integration.multigrid import MULTIGRID, solve_weighted
from nlights_core.integration.poisson import Stencil, add_divergence, add_plane, mean_per_island, mean_steps
from nlights_core.machine.progress import part

SINGLE = 1e-6
"""Where single precision ends: a residual that has fallen to this share."""

LABYRINTH_ITERATIONS = 400
"""Multigrid ends in any case after so many iterations."""


def masked_least_squares(
    per_column: Array,
    per_row: Array,
    *,
    stencil: Stencil = "6-point",
    tolerance: float = 1e-8,
) -> Array:
    """Integrate what is known of a gradient, each connected island by itself.

    The same least squares as `simchony`, over the steps between two known pixels only; solved as
    `solve_masked` says.

    Parameters
    ----------
    per_column, per_row : (H, W) float32 or float64 arrays
        Height steps per pixel; NaN in either where not known.
    stencil : {"6-point", "trapezoid"}
        See `nlights_core.integration.poisson.height_steps`.
    tolerance : float
        As in `solve_masked`.

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
    height = np.zeros(known.shape, np.result_type(per_column, per_row))
    add_divergence(height, per_column, stencil, tilt[0])
    add_divergence(height.T, per_row.T, stencil, tilt[1])
    height = solve_masked(height, known, tolerance)
    return _finished(height, known, tilt, height.dtype)


def solve_masked(source: Array, known: Array, tolerance: float = SINGLE) -> Array:
    """Solve the Poisson equation of what is known, by whatever is fast for its shape.

    By way of the whole rectangle (`nlights_core.integration.masked_poisson`), and what that does not finish
    by multigrid.

    Parameters
    ----------
    source : (H, W) float array
        Of `nlights_core.integration.poisson.add_divergence`.  Overwritten.
    known : (H, W) bool array
    tolerance : float
        It ends when the residual, in the norm of the preconditioner, has fallen to this share of
        its start; in single precision to `SINGLE` at the least.

    Returns
    -------
    (H, W) array
        In the precision of ``source``; any mean on each island, anything where not known.
    """
    if source.dtype == np.float32:
        tolerance = max(tolerance, SINGLE)
    with part(0.0, 0.25):
        height, left = solve_embedded(source, known, tolerance)
    if left > tolerance:
        announce(
            "a field whose known parts are like a labyrinth",
            source.size,
            MULTIGRID,
            0,
            LABYRINTH_ITERATIONS,
        )
        pairs = known[:, 1:] & known[:, :-1], known[1:] & known[:-1]
        weights = [both.astype(np.float32) for both in pairs]
        rest = np.zeros_like(source)
        np.negative(source, out=source)
        residual = source.astype(np.float64)
        with part(0.25, 1.0):
            further = solve_weighted(rest, residual, weights, tolerance / left, LABYRINTH_ITERATIONS)
        if further > tolerance / left:
            warn_unsettled(further * left, tolerance, LABYRINTH_ITERATIONS)
        height += rest
    return height


def _finished(height: Array, known: Array, tilt: tuple[float, float], precision: DTypeLike) -> Array:
    """The plane added again, unknown made NaN, each island's mean taken off."""
    add_plane(height, tilt)
    height[~known] = np.nan
    height -= mean_per_island(height)
    return height.astype(precision)
