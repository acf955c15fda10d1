"""Compiled loops for the level of reduced photographs, a fixed cost of a tile.

What `levelling` and `linearisation` of this department say in numpy, pixel after pixel, with the same
 results up to rounding.  Import this only where it is used: Numba takes half a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

NORMAL = 9
"""Numbers of a pixel's solution: scaled normal, upper triangle of the inverse normal matrix."""


@inner
def _smallest_and_largest(m: Any, trace: float) -> tuple[float, float]:
    """Eigenvalues of a symmetric 3 x 3 matrix, as `least_squares.eigenvalues` finds them."""
    mean = trace / 3
    # The matrix as its upper triangle: xx, xy, xz, yy, yz, zz.
    a, b, c = m[0] - mean, m[3] - mean, m[5] - mean
    spread = math.sqrt((a * a + b * b + c * c + 2 * (m[1] * m[1] + m[2] * m[2] + m[4] * m[4])) / 6)
    off = a * (b * c - m[4] * m[4]) - m[1] * (m[1] * c - m[4] * m[2]) + m[2] * (m[1] * m[4] - b * m[2])
    cosine = off / (2 * spread**3) if spread > 0 else 1.0
    angle = math.acos(min(max(cosine, -1.0), 1.0)) / 3
    return mean + 2 * spread * math.cos(angle + 2 * math.pi / 3), mean + 2 * spread * math.cos(angle)


@kernel
def fit_normals(
    images: Array, lights: Array, weights: Array, condition: float, solution: Array, surprise: Array
) -> None:
    """Fit a scaled normal to the samples of every pixel, and say how surprising each sample is.

    Parameters
    ----------
    images, weights : (L, N) float64 arrays
    lights : (L, N, 3) float32 array
    condition : float
        As for `nlights_core.solving.least_squares.fit`.
    solution : (NORMAL, N) float64 array
        Receives the scaled normal, NaN where not known, and the inverse normal matrix.
    surprise : (L, N) float64 array
        Receives the residual in standard deviations, NaN where a sample is not used.
    """
    count, pixels = images.shape
    limit = condition * condition
    for p in range(pixels):
        # Sums over the samples of w l l^T, and (b) of w I l.
        xx = xy = xz = yy = yz = zz = bx = by = bz = 0.0
        used = 0
        for i in range(count):
            w = weights[i, p]
            if w > 0:
                used += 1
                x, y, z = (
                    np.float64(lights[i, p, 0]),
                    np.float64(lights[i, p, 1]),
                    np.float64(lights[i, p, 2]),
                )
                wx, wy, wz, value = w * x, w * y, w * z, w * images[i, p]
                xx, xy, xz = xx + wx * x, xy + wx * y, xz + wx * z
                yy, yz, zz = yy + wy * y, yz + wy * z, zz + wz * z
                bx, by, bz = bx + value * x, by + value * y, bz + value * z
        # The adjugate, whose product with the first row is the determinant.
        ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant, trace = xx * ixx + xy * ixy + xz * ixz, xx + yy + zz
        # The two larger eigenvalues' product is at most trace^2 / 4: mostly that settles it.
        well = used >= 3 and determinant > 0
        if well and trace * trace * trace > 4 * limit * determinant:
            smallest, largest = _smallest_and_largest((xx, xy, xz, yy, yz, zz), trace)
            well = smallest > 0 and largest <= limit * smallest
        if not well:
            solution[:, p] = np.nan
            surprise[:, p] = np.nan
            continue
        inverse = (
            ixx / determinant,
            ixy / determinant,
            ixz / determinant,
            iyy / determinant,
            iyz / determinant,
            izz / determinant,
        )
        nx, ny, nz = _times(inverse, bx, by, bz)
        solution[0, p], solution[1, p], solution[2, p] = nx, ny, nz
        for k in range(6):
            solution[3 + k, p] = inverse[k]
        albedo = math.sqrt(nx * nx + ny * ny + nz * nz)
        for i in range(count):
            w = weights[i, p]
            if w > 0:
                shown = lights[i, p, 0] * nx + lights[i, p, 1] * ny + lights[i, p, 2] * nz
                surprise[i, p] = abs(images[i, p] - shown) * math.sqrt(w / albedo)
            else:
                surprise[i, p] = np.nan


@inner
def _times(m: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A symmetric matrix, its upper triangle given, times a vector."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[1] * x + m[3] * y + m[4] * z,
        m[2] * x + m[4] * y + m[5] * z,
    )


@kernel
def predict_changes(
    images: Array, lights: Array, above: Array, lights_above: Array, solution: Array, step: float, out: Array
) -> None:
    """Changes of the predicted images against those at a height that is higher by a step, per mm.

    Parameters
    ----------
    images, above : (L, N) float64 arrays
    lights, lights_above : (L, N, 3) float32 arrays
    solution : (NORMAL, N) float64 array
        Of `fit_normals`.
    step : float
        mm.
    out : (L, N) float64 array
        Receives them, 0 where a pixel is not known.
    """
    for i in range(len(images)):
        for p in range(images.shape[1]):
            nx, ny, nz = solution[0, p], solution[1, p], solution[2, p]
            if nx != nx:
                out[i, p] = 0.0
                continue
            shown = lights[i, p, 0] * nx + lights[i, p, 1] * ny + lights[i, p, 2] * nz
            then = lights_above[i, p, 0] * nx + lights_above[i, p, 1] * ny + lights_above[i, p, 2] * nz
            # What the other height does to the same photograph: its flat field is read elsewhere.
            brighter = above[i, p] / images[i, p] if images[i, p] != 0 else 1.0
            out[i, p] = (shown * brighter - then) / step


@kernel
def add_normal_equations(
    images: Array,
    lights: Array,
    weights: Array,
    by_offset: Array,
    bends: Array,
    solution: Array,
    scale: float,
    matrix: Array,
    right: Array,
) -> int:
    """Add the pixels' share of the normal equations of offset and strengths; return how many are known.

    Parameters
    ----------
    images, weights, by_offset, bends : (L, N) float64 arrays
    lights : (L, N, 3) float32 array
    solution : (NORMAL, N) float64 array
        Of `fit_normals`.
    scale : float
        Spread of the surprise.
    matrix, right : (L + 1, L + 1) and (L + 1,) float64 arrays
        Added to; of the matrix the upper triangle only.
    """
    count, pixels = images.shape
    # Of each lamp: light, its product with the inverse, image shown, its weight, mixed product.
    of = np.empty((count, 9))
    known = 0
    for p in range(pixels):
        nx, ny, nz = solution[0, p], solution[1, p], solution[2, p]
        if nx != nx:
            continue
        known += 1
        inverse = (
            solution[3, p],
            solution[4, p],
            solution[5, p],
            solution[6, p],
            solution[7, p],
            solution[8, p],
        )
        per_variance = 1 / (scale * scale * math.sqrt(nx * nx + ny * ny + nz * nz))
        # Sum of w l times the change by an offset, later the change of the normal that explains most of that.
        bx = by = bz = 0.0
        for i in range(count):
            x, y, z = np.float64(lights[i, p, 0]), np.float64(lights[i, p, 1]), np.float64(lights[i, p, 2])
            of[i, 0], of[i, 1], of[i, 2] = x, y, z
            of[i, 3], of[i, 4], of[i, 5] = _times(inverse, x, y, z)
            of[i, 6] = x * nx + y * ny + z * nz
            of[i, 7] = weights[i, p] * per_variance
            value = weights[i, p] * by_offset[i, p] if weights[i, p] > 0 else 0.0
            bx, by, bz = bx + value * x, by + value * y, bz + value * z
        bx, by, bz = _times(inverse, bx, by, bz)
        own = rest = 0.0
        for i in range(count):
            # What no change of the normal explains of the change by an offset.
            across = by_offset[i, p] - (of[i, 0] * bx + of[i, 1] * by + of[i, 2] * bz)
            weighted = of[i, 7] * across
            if of[i, 7] > 0:
                own += weighted * by_offset[i, p]
                rest += weighted * (images[i, p] - of[i, 6])
            # Slot 8, the mixed product: of offset and this lamp's strength.
            of[i, 8] = -weighted * of[i, 6]
        # Unknown 0 is the offset, k + 1 the logarithm of lamp k's strength.
        matrix[0, 0] += own
        right[0] -= rest
        for k in range(count):
            bend, lit = bends[k, p], of[k, 7] * of[k, 6]
            matrix[0, k + 1] += of[k, 8] - bend * own
            missed = images[k, p] - of[k, 6] if of[k, 7] > 0 else 0.0
            right[k + 1] += lit * missed + bend * rest
            matrix[k + 1, k + 1] += lit * of[k, 6]
            for m in range(k, count):
                shared = of[k, 0] * of[m, 3] + of[k, 1] * of[m, 4] + of[k, 2] * of[m, 5]
                other = bends[m, p]
                # A strength bends the height too, and so has a share in the offset's products.
                both = bend * of[m, 8] + other * of[k, 8] - bend * other * own
                matrix[k + 1, m + 1] -= lit * shared * weights[m, p] * of[m, 6] + both
    return known
