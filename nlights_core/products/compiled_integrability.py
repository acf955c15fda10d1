"""Compiled loops over the pixels of maps: normals made integrable, and their uncertainty.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

BEFORE, AFTER = 2, 3
"""Pixels that a step's formula reaches to before and behind its first pixel."""


@kernel
def steps_of_normals(
    normals: Array, size: float, cosine: float, x: Array, y: Array, across: Array, down: Array
) -> None:
    """Height steps per column and per row of normals (n, W, 3), along the camera's rays.

    ``x`` (W,) and ``y`` (n,) are how far the rays lean: sideways by the camera's distance,
    0 without perspective.  Steps are NaN where n_z is not above ``cosine``.  ``across``
    (n, BEFORE + W + AFTER) and ``down`` (BEFORE + n + AFTER, W), float32, have margins of NaN.
    """
    across[:, :BEFORE] = np.nan
    across[:, -AFTER:] = np.nan
    down[:BEFORE] = np.nan
    down[-AFTER:] = np.nan
    for i in range(normals.shape[0]):
        for j in range(normals.shape[1]):
            nz = np.float64(normals[i, j, 2])
            p, q = -np.float64(normals[i, j, 0]), np.float64(normals[i, j, 1])
            # Divided by how far the normal faces the ray, see `integration.sight_lines.facing_rays`.
            scale = size / (nz + p * x[j] - q * y[i])
            # So asked that NaN is not above it either.
            if not nz > cosine:
                scale = np.nan
            across[i, BEFORE + j] = p * scale
            down[BEFORE + i, j] = q * scale


@inner
def _six_point(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """The step from c to d by the formula of `integration.height_steps`, "6-point"."""
    return (802 * (c + d) - 93 * (b + e) + 11 * (a + f)) / 1440


@inner
def _fewer_points(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """The step from c to d by its next formula whose pixels are all known."""
    # A sum with NaN is NaN: so each formula tells by itself whether all of its pixels are known.
    step = (13 * (c + d) - (b + e)) / 24
    if step != step:
        step = (9 * c + 19 * d - 5 * e + f) / 24
    if step != step:
        step = (9 * d + 19 * c - 5 * b + a) / 24
    if step != step:
        step = (c + d) / 2
    return step


@inner
def _height_step(first: float, second: float, distance: float) -> float:
    """Step from a pixel's height to the next one's; of the logarithm of the depth where there is a camera.

    The logarithm of the ratio of the depths is the area tangent's series, whose first four terms are
    exact to 1e-15 for steps of up to a twentieth of the depth.
    """
    if distance == 0:
        return second - first
    s = (second - first) / (2 * distance - first - second)
    square = s * s
    return 2 * distance * s * (1 + square * (1 / 3 + square * (1 / 5 + square / 7)))


@kernel
def subtract_height_steps(slope: Array, height: Array, distance: float, rise: int, out: Array) -> None:
    """Surplus of slopes over the height's own steps, between the pixels; 0 where not known.

    With ``rise`` 0 the steps go from column to column: ``slope`` (n, BEFORE + W + AFTER) is
    ``across`` of `steps_of_normals`, ``out`` (n, 3 + W + 2) float32.  With 1 they go from row to row:
    ``slope`` (BEFORE + n + AFTER, W) is ``down``, ``out`` (3 + n + 2, W).  The margins of ``out`` are
    0: no step crosses a border.  ``height`` is (n, W) float32, ``distance`` the camera's, 0 without
    perspective.
    """
    rows, columns = height.shape
    run = 1 - rise
    out[:] = 0
    for i in range(rows - rise):
        # With the margin of two in front, a step's six pixels begin at the number of its first one.
        a, b, c = slope[i], slope[i + rise], slope[i + 2 * rise]
        d, e, f = slope[i + 3 * rise], slope[i + 4 * rise], slope[i + 5 * rise]
        first, second, found = height[i], height[i + rise], out[i + 3 * rise]
        for j in range(columns - run):
            step = _six_point(
                np.float64(a[j]),
                np.float64(b[j + run]),
                np.float64(c[j + 2 * run]),
                np.float64(d[j + 3 * run]),
                np.float64(e[j + 4 * run]),
                np.float64(f[j + 5 * run]),
            )
            rest = step - _height_step(np.float64(first[j]), np.float64(second[j + run]), distance)
            # Behind a margin of three: the step from pixel j to the next stands at j + 3.
            found[j + 3 * run] = rest
        # A loop without branches runs on several pixels at once; the few left over come after it.
        for j in range(columns - run):
            if found[j + 3 * run] == found[j + 3 * run]:
                continue
            step = _fewer_points(
                np.float64(a[j]),
                np.float64(b[j + run]),
                np.float64(c[j + 2 * run]),
                np.float64(d[j + 3 * run]),
                np.float64(e[j + 4 * run]),
                np.float64(f[j + 5 * run]),
            )
            rest = step - _height_step(np.float64(first[j]), np.float64(second[j + run]), distance)
            found[j + 3 * run] = rest if rest == rest else 0.0


@kernel
def correct_normals(
    normals: Array,
    across: Array,
    down: Array,
    beside: Array,
    below: Array,
    size: float,
    x: Array,
    y: Array,
    out: Array,
    first: int,
) -> None:
    """Normals less their surplus, brought back onto the pixels by the six-point midway interpolation.

    ``out`` (m, W, 3) float32 gets the rows from ``first`` on; where a slope is not known the normal
    stays as it is.
    """
    for k in range(out.shape[0]):
        i = first + k
        for j in range(out.shape[1]):
            # Of the margins' numbering: the step to pixel j stands at j + 2, the one from it at j + 3.
            p = (
                np.float64(across[i, BEFORE + j])
                - (
                    150 * (beside[i, j + 2] + beside[i, j + 3])
                    - 25 * (beside[i, j + 1] + beside[i, j + 4])
                    + 3 * (beside[i, j] + beside[i, j + 5])
                )
                / 256
            )
            q = (
                np.float64(down[BEFORE + i, j])
                - (
                    150 * (below[i + 2, j] + below[i + 3, j])
                    - 25 * (below[i + 1, j] + below[i + 4, j])
                    + 3 * (below[i, j] + below[i + 5, j])
                )
                / 256
            )
            facing = size - p * x[j] + q * y[i]
            if p == p:
                # The slopes, and how far the normal faces the ray, are the normal but for its length.
                scale = 1 / math.sqrt(p * p + q * q + facing * facing)
                out[k, j, 0] = -p * scale
                out[k, j, 1] = q * scale
                out[k, j, 2] = facing * scale
            else:
                out[k, j, 0] = normals[i, j, 0]
                out[k, j, 1] = normals[i, j, 1]
                out[k, j, 2] = normals[i, j, 2]


@kernel
def smoothed_uncertainty(confidence: Array, first: int, own: float, around: float, out: Array) -> None:
    """Root of ``own`` x variance + ``around`` x mean variance of the known among 3 x 3 pixels.

    ``out`` (m, W) float32 gets the rows of ``confidence`` from ``first`` on; border pixels count
    for those beyond them.
    """
    rows, columns = confidence.shape
    # By column, over three rows: sum of the known variances, and their number.
    total, known = np.empty(columns), np.empty(columns)
    for k in range(out.shape[0]):
        total[:] = 0
        known[:] = 0
        for i in range(first + k - 1, first + k + 2):
            line = confidence[min(max(i, 0), rows - 1)]
            for j in range(columns):
                value = np.float64(line[j])
                valid = value == value
                total[j] += value * value if valid else 0.0
                known[j] += 1.0 if valid else 0.0
        for j in range(columns):
            before, after = max(j - 1, 0), min(j + 1, columns - 1)
            mean = (total[before] + total[j] + total[after]) / max(
                known[before] + known[j] + known[after], 1.0
            )
            value = np.float64(confidence[first + k, j])
            out[k, j] = math.sqrt(own * value * value + around * mean)
