"""Compiled fits: weighted least squares over blocks of pixels, for numba.

A fit is a row of numbers, in which each quantity has its place; see `nlights_core.photographs.blocks`.

Import this module only through `nlights_core.solving.kernels`: it needs numba.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, TINY, TRIAL, USABLE, VALUE, ZERO, X, Y, Z, inner

# Of a fit, in an array (FIT,):
SCALED, MATRIX, RIGHT, DETERMINANT = 0, 3 * BLOCK, 9 * BLOCK, 12 * BLOCK
FIT = 13 * BLOCK
"""Albedo times normal; normal matrix or its inverse, upper triangle; right-hand side; determinant of the
matrix scaled to a trace of 1; size of all."""

INFINITE_BITS = np.int32(0x7F800000)

SURE = np.float32(1e-3)
"""Determinant of a normal matrix of trace 1 from which single precision is good enough."""


class Work(NamedTuple):
    """State of the pixels of some blocks, and room to work in.

    Attributes
    ----------
    samples : (S, L, SAMPLE) float32 array
    fits : (S, FIT) float32 array
    found : (S, FOUND) float32 array
        See `nlights_core.solving.compiled_solutions`.
    quantiles : (L + 1,) float32 array
        From `nlights_core.solving.robust_fitting.scale_quantiles`.
    some : (L, SAMPLE) float32 array
        Pixels from several blocks; without NaN from the beginning.
    fit : (FIT,) float32 array
        Their fit.
    noise : (3, L, BLOCK) float32 array
        The inverse of the standard deviation of each sample, and residuals in its units.
    rows : (10, BLOCK) float32 array
    places : (3, BLOCK) int64 array
        Scratch: who works with them says what each row holds.
    triplets : (T, 3) int64 array
        Places of lights.
    said : (4, T, BLOCK) float32 array
        What each triplet says, and its share.
    """

    samples: Array
    fits: Array
    found: Array
    quantiles: Array
    some: Array
    fit: Array
    noise: Array
    rows: Array
    places: Array
    triplets: Array
    said: Array


@inner
def count_usable(samples: Array, counts: Array) -> None:
    """Count the usable samples of each pixel."""
    for p in range(BLOCK):
        counts[p] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            counts[p] += ONE if of[USABLE + p] > ZERO else ZERO


@inner
def normal_equations(samples: Array, fit: Array) -> None:
    """Sums of ``w l l^T`` and ``w I l`` with the trial weights: `MATRIX` and `RIGHT` of a fit."""
    # Matrix and right-hand side stand side by side: one loop empties both.
    for k in range(MATRIX, DETERMINANT):
        fit[k] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            add_sample(of, fit, p)


@numba.njit(inline="always")
def add_sample(of: Array, fit: Array, p: int) -> None:
    """Add one sample to the normal equations of its pixel."""
    x, y, z = of[X + p], of[Y + p], of[Z + p]
    weight = of[TRIAL + p]
    right = weight * of[VALUE + p]
    add_square(fit, p, weight * x, weight * y, weight * z, x, y, z)
    fit[RIGHT + p] += right * x
    fit[RIGHT + BLOCK + p] += right * y
    fit[RIGHT + 2 * BLOCK + p] += right * z


@numba.njit(inline="always")
def add_square(fit: Array, p: int, wx: Any, wy: Any, wz: Any, x: Any, y: Any, z: Any) -> None:
    """Add a sample's derivatives to the normal matrix of its pixel; ``wx`` and so on are the weighted ones."""
    fit[MATRIX + p] += wx * x
    fit[MATRIX + BLOCK + p] += wx * y
    fit[MATRIX + 2 * BLOCK + p] += wx * z
    fit[MATRIX + 3 * BLOCK + p] += wy * y
    fit[MATRIX + 4 * BLOCK + p] += wy * z
    fit[MATRIX + 5 * BLOCK + p] += wz * z


@inner
def invert_normal_matrices(fit: Array) -> None:
    """Put the inverse in the place of `MATRIX`, and `SCALED` = inverse times `RIGHT`.

    The matrix is first scaled to a trace of 1, so that weights in any unit neither overflow nor
    vanish.
    """
    for p in range(BLOCK):
        xx, xy, xz = fit[MATRIX + p], fit[MATRIX + BLOCK + p], fit[MATRIX + 2 * BLOCK + p]
        yy, yz, zz = fit[MATRIX + 3 * BLOCK + p], fit[MATRIX + 4 * BLOCK + p], fit[MATRIX + 5 * BLOCK + p]
        # A pixel without any sample has a matrix of 0: `TINY` keeps it finite, its determinant of 0 tells it apart.
        unit = ONE / max(xx + yy + zz, TINY)
        xx, xy, xz, yy, yz, zz = xx * unit, xy * unit, xz * unit, yy * unit, yz * unit, zz * unit
        # The adjugate, from now on of the matrix with a trace of 1.
        ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        found = xx * ixx + xy * ixy + xz * ixz
        fit[DETERMINANT + p] = found
        # The inverse of the matrix as it was given: ``unit`` undoes the scaling.
        scale = unit / max(found, TINY)
        fit[MATRIX + p], fit[MATRIX + BLOCK + p] = ixx * scale, ixy * scale
        fit[MATRIX + 2 * BLOCK + p], fit[MATRIX + 3 * BLOCK + p] = ixz * scale, iyy * scale
        fit[MATRIX + 4 * BLOCK + p], fit[MATRIX + 5 * BLOCK + p] = iyz * scale, izz * scale
        # From 0 on, so that the solution is the first correction.
        fit[SCALED + p], fit[SCALED + BLOCK + p], fit[SCALED + 2 * BLOCK + p] = ZERO, ZERO, ZERO
    add_correction(fit)


@inner
def add_correction(fit: Array) -> None:
    """Add inverse times `RIGHT` to `SCALED`."""
    for p in range(BLOCK):
        xx, xy, xz = fit[MATRIX + p], fit[MATRIX + BLOCK + p], fit[MATRIX + 2 * BLOCK + p]
        yy, yz, zz = fit[MATRIX + 3 * BLOCK + p], fit[MATRIX + 4 * BLOCK + p], fit[MATRIX + 5 * BLOCK + p]
        x, y, z = fit[RIGHT + p], fit[RIGHT + BLOCK + p], fit[RIGHT + 2 * BLOCK + p]
        fit[SCALED + p] += xx * x + xy * y + xz * z
        fit[SCALED + BLOCK + p] += xy * x + yy * y + yz * z
        fit[SCALED + 2 * BLOCK + p] += xz * x + yz * y + zz * z


@inner
def sure_determinant(condition: float) -> Any:
    """Determinant of a normal matrix of trace 1 above which it is conditioned well enough."""
    # Of eigenvalues that sum up to 1 no two have a product above 1/4: so the smallest is at least four
    # times the determinant, and the largest at most 1.
    return max(SURE, np.float32(0.3 / condition**2))


@numba.njit(inline="always")
def residual_of(of: Array, fit: Array, p: int) -> Any:
    """Residual of a sample from a fit."""
    shown = of[X + p] * fit[SCALED + p] + of[Y + p] * fit[SCALED + BLOCK + p]
    return of[VALUE + p] - (shown + of[Z + p] * fit[SCALED + 2 * BLOCK + p])


@numba.njit(inline="always")
def leverage_of(of: Array, fit: Array, p: int) -> Any:
    """Leverage of a sample of weight 1: how strongly it would determine its own prediction, by a fit's inverse."""
    x, y, z = of[X + p], of[Y + p], of[Z + p]
    xx, xy, xz = fit[MATRIX + p], fit[MATRIX + BLOCK + p], fit[MATRIX + 2 * BLOCK + p]
    yy, yz, zz = fit[MATRIX + 3 * BLOCK + p], fit[MATRIX + 4 * BLOCK + p], fit[MATRIX + 5 * BLOCK + p]
    # Of a symmetric matrix each element beside the diagonal counts twice.
    own = xx * x * x + yy * y * y + zz * z * z
    return own + np.float32(2) * (xy * x * y + xz * x * z + yz * y * z)


@inner
def refine_fits(samples: Array, fit: Array) -> None:
    """One step of iterative refinement: single precision becomes as good as double would be."""
    # `RIGHT` becomes that of the residuals; `MATRIX` holds the inverse and stays.
    for k in range(RIGHT, DETERMINANT):
        fit[k] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            missed = of[TRIAL + p] * residual_of(of, fit, p)
            fit[RIGHT + p] += missed * of[X + p]
            fit[RIGHT + BLOCK + p] += missed * of[Y + p]
            fit[RIGHT + 2 * BLOCK + p] += missed * of[Z + p]
    add_correction(fit)


@inner
def solve_exactly(samples: Array, fit: Array, p: int, which: int, condition: float) -> bool:
    """Solve one pixel in double precision with the weights that begin at ``which``.

    False, and nothing is changed, where it cannot be known: of fewer than three samples, or badly spread ones.
    """
    # Sums over the samples of w l l^T, and (v) of w I l.
    xx = xy = xz = yy = yz = zz = vx = vy = vz = 0.0
    count = 0
    for i in range(len(samples)):
        weight = np.float64(samples[i, which + p])
        x, y, z = np.float64(samples[i, X + p]), np.float64(samples[i, Y + p]), np.float64(samples[i, Z + p])
        value = weight * samples[i, VALUE + p]
        count += 1 if weight > 0 else 0
        xx += weight * x * x
        xy += weight * x * y
        xz += weight * x * z
        yy += weight * y * y
        yz += weight * y * z
        zz += weight * z * z
        vx += value * x
        vy += value * y
        vz += value * z
    ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * ixx + xy * ixy + xz * ixz
    if count < 3 or not determinant > 0 or not _is_well_conditioned(xx, xy, xz, yy, yz, zz, condition):
        return False
    # The inverse's upper triangle in two rows of three: xx, xy, xz and yy, yz, zz.
    inverse = (ixx / determinant, ixy / determinant, ixz / determinant)
    lower = (iyy / determinant, iyz / determinant, izz / determinant)
    for k in range(3):
        fit[MATRIX + k * BLOCK + p] = inverse[k]
        fit[MATRIX + (k + 3) * BLOCK + p] = lower[k]
    fit[SCALED + p] = inverse[0] * vx + inverse[1] * vy + inverse[2] * vz
    fit[SCALED + BLOCK + p] = inverse[1] * vx + lower[0] * vy + lower[1] * vz
    fit[SCALED + 2 * BLOCK + p] = inverse[2] * vx + lower[1] * vy + lower[2] * vz
    return True


@inner
def _is_well_conditioned(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, condition: float
) -> Any:
    """Test whether a matrix is conditioned well enough: `least_squares.eigenvalues`, of one matrix."""
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = determinant / (2 * spread**3) if spread > 0 else 1.0
    angle = np.arccos(min(max(cosine, -1.0), 1.0)) / 3
    # Three roots, a third of a circle apart: this angle gives the largest, a third more the smallest.
    smallest = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    return smallest > 0 and mean + 2 * spread * np.cos(angle) <= condition**2 * smallest
