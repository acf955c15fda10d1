"""Compiled loops over the pixels of maps that leave nothing but sums.

Import this only where it is used: Numba takes half a second.  A sum runs in float64 in so many
lanes side by side, which a core adds at once; their order is fixed, so that results are the same
with any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

LANES = 512
"""Sums that run side by side: they fit into a core's innermost cache."""

SERIES = tuple(
    np.float32(term)
    for term in (
        -0.3333314528,
        0.1999355085,
        -0.1420889944,
        0.1065626393,
        -0.0752896400,
        0.0429096138,
        -0.0161657367,
        0.0028662257,
    )
)
"""Of the arc tangent's share of its argument, in powers of its square from the first."""


@kernel
def known_sum(values: Array) -> tuple[float, int]:
    """Sum and number of the finite ones of some values (N,)."""
    # Lane k has every `LANES`-th value, from value k on.
    total, known = np.zeros(LANES), np.zeros(LANES, np.int64)
    for start in range(0, values.size, LANES):
        part = values[start : start + LANES]
        for k in range(part.size):
            value = np.float64(part[k])
            valid = abs(value) < np.inf
            total[k] += value if valid else 0.0
            known[k] += valid
    return total.sum(), known.sum()


@kernel
def sum_counts(values: Array, least: int) -> tuple[int, int]:
    """Sum of whole numbers (N,), and how many are at least ``least``."""
    total, enough = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    for start in range(0, values.size, LANES):
        part = values[start : start + LANES]
        for k in range(part.size):
            total[k] += part[k]
            enough[k] += part[k] >= least
    return total.sum(), enough.sum()


@inner
def _parted(normals: Array, x: Array, y: Array, z: Array) -> None:
    """Components of normals (N, 3), each by itself: a core takes several neighbours at once."""
    for j in range(len(normals)):
        x[j], y[j], z[j] = normals[j, 0], normals[j, 1], normals[j, 2]


@kernel
def inclinations(normals: Array) -> tuple[float, int]:
    """Sum of the angles between normals (N, 3) and z, radians, and number of the known ones.

    The angle is twice the arc tangent of sin / (1 + cos), by the polynomial 4.4.49 of [1]_, which is
    right to 2e-8 of the angle.

    References
    ----------
    .. [1] M. Abramowitz and I. A. Stegun, "Handbook of mathematical functions", 1964.
    """
    total, known = np.zeros(LANES), np.zeros(LANES, np.int64)
    first, second = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    third = np.empty(LANES, np.float32)
    for start in range(0, len(normals), LANES):
        part = normals[start : start + LANES]
        _parted(part, first, second, third)
        for k in range(len(part)):
            x, y, z = first[k], second[k], third[k]
            across = math.sqrt(x * x + y * y)
            along = math.sqrt(x * x + y * y + z * z) + z
            # Beyond a right angle the series gets the reciprocal, and the angle is pi less what it gives.
            turned = across > along
            half = (along if turned else across) / (across if turned else along)
            square = half * half
            # From the highest power down, two terms at a time.
            series = SERIES[7]
            series = SERIES[5] + square * (SERIES[6] + square * series)
            series = SERIES[3] + square * (SERIES[4] + square * series)
            series = SERIES[1] + square * (SERIES[2] + square * series)
            angle = 2 * np.float64(half + half * square * (SERIES[0] + square * series))
            angle = math.pi - angle if turned else angle
            valid = angle == angle
            total[k] += angle if valid else 0.0
            known[k] += valid
    return total.sum(), known.sum()


@kernel
def sum_misclosures(normals: Array, steepest: np.float32) -> tuple[float, int]:
    """Sum of the squares, and number, of `map_statistics.misclosure` over (n, W, 3), per pixel size.

    Slopes are limited to ``steepest``, as in `NormalField.gradient`.
    """
    columns = normals.shape[1]
    first, second = np.empty(columns, np.float32), np.empty(columns, np.float32)
    third = np.empty(columns, np.float32)
    # Slopes of the row at hand, per column and per row.
    p, q = np.empty(columns, np.float32), np.empty(columns, np.float32)
    # The part of the walk along the row above.
    below = np.empty(columns - 1)
    total, known = np.zeros(columns - 1), np.zeros(columns - 1, np.int64)
    for i in range(normals.shape[0]):
        _parted(normals[i], first, second, third)
        for j in range(columns):
            nz = third[j]
            across, down = -first[j] / nz, second[j] / nz
            slope = math.sqrt(across * across + down * down)
            limit = steepest / slope if slope > steepest else np.float32(1)
            limit = limit if nz > 0 else np.float32(np.nan)
            p[j] = across * limit
            q[j] = down * limit
        if i > 0:
            for j in range(columns - 1):
                along, turn = np.float64(p[j]) + np.float64(p[j + 1]), np.float64(q[j + 1]) - np.float64(q[j])
                # The walk, twice m: the row above, the right side down, this row back, the left side up.
                missed = (below[j] - along + turn) / 2
                valid = abs(missed) < np.inf
                total[j] += missed * missed if valid else 0.0
                known[j] += valid
        for j in range(columns - 1):
            below[j] = np.float64(p[j]) + np.float64(p[j + 1]) + np.float64(q[j + 1]) - np.float64(q[j])
    return total.sum(), known.sum()


@kernel
def height_sums(height: Array, level: float, x: Array, y: Array, matrix: Array, right: Array) -> float:
    """Sums over the known pixels of (n, W) for its moments and a least-squares plane z = a x + b y + c.

    Heights z count from ``level``.  ``matrix`` (3, 3) gets the sums of the products of x, y and 1,
    ``right`` (3,) those with z; the sum of the squares of z is returned.
    """
    columns = height.shape[1]
    # By column: how many, and the sums of y, y y, z, y z and z z.
    sums = np.zeros((6, columns))
    n, ys, yys, zs, yzs, zzs = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    for i in range(height.shape[0]):
        line, here = height[i], y[i]
        for j in range(columns):
            given = np.float64(line[j]) - level
            valid = abs(given) < np.inf
            z = given if valid else 0.0
            n[j] += 1.0 if valid else 0.0
            ys[j] += here if valid else 0.0
            yys[j] += here * here if valid else 0.0
            zs[j] += z
            yzs[j] += here * z
            zzs[j] += z * z
    matrix[0] = (x * x * n).sum(), (x * ys).sum(), (x * n).sum()
    matrix[1] = (x * ys).sum(), yys.sum(), ys.sum()
    matrix[2] = (x * n).sum(), ys.sum(), n.sum()
    right[0], right[1], right[2] = (x * zs).sum(), yzs.sum(), zs.sum()
    return float(zzs.sum())
