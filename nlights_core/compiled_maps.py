"""Compiled loops over the pixels of maps: their correction, codes for viewing, reduction and sums.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from nlights_core.frames import Array

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")

BEFORE, AFTER = 2, 3
"""Pixels that a step's formula reaches to before and behind its first pixel."""


@compiled
def slopes(
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
            scale = size / (nz + p * x[j] - q * y[i])
            if not nz > cosine:
                scale = np.nan
            across[i, BEFORE + j] = p * scale
            down[BEFORE + i, j] = q * scale


@compiled
def _six_point(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """The step from c to d by the formula of `integration.height_steps`, "6-point"."""
    return (802 * (c + d) - 93 * (b + e) + 11 * (a + f)) / 1440


@compiled
def _fewer_points(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """The step from c to d by its next formula whose pixels are all known."""
    step = (13 * (c + d) - (b + e)) / 24
    if step != step:
        step = (9 * c + 19 * d - 5 * e + f) / 24
    if step != step:
        step = (9 * d + 19 * c - 5 * b + a) / 24
    if step != step:
        step = (c + d) / 2
    return step


@compiled
def _height_step(first: float, second: float, distance: float) -> float:
    """From a pixel's height to the next one's; of the logarithm of the depth where there is a camera.

    The logarithm of the ratio of the depths is the area tangent's series, whose first four terms are
    exact to 1e-15 for steps of up to a twentieth of the depth.
    """
    if distance == 0:
        return second - first
    s = (second - first) / (2 * distance - first - second)
    square = s * s
    return 2 * distance * s * (1 + square * (1 / 3 + square * (1 / 5 + square / 7)))


@compiled
def surplus(slope: Array, height: Array, distance: float, rise: int, out: Array) -> None:
    """What slopes say beyond the height's own steps, between the pixels; 0 where not known.

    With ``rise`` 0 the steps go from column to column: ``slope`` (n, BEFORE + W + AFTER) is
    ``across`` of `slopes`, ``out`` (n, 3 + W + 2) float32.  With 1 they go from row to row:
    ``slope`` (BEFORE + n + AFTER, W) is ``down``, ``out`` (3 + n + 2, W).  The margins of ``out`` are
    0: no step crosses a border.  ``height`` is (n, W) float32, ``distance`` the camera's, 0 without
    perspective.
    """
    rows, columns = height.shape
    run = 1 - rise
    out[:] = 0
    for i in range(rows - rise):
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


@compiled
def corrected(
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
                scale = 1 / math.sqrt(p * p + q * q + facing * facing)
                out[k, j, 0] = -p * scale
                out[k, j, 1] = q * scale
                out[k, j, 2] = facing * scale
            else:
                out[k, j, 0] = normals[i, j, 0]
                out[k, j, 1] = normals[i, j, 1]
                out[k, j, 2] = normals[i, j, 2]


@compiled
def smoothed_uncertainty(confidence: Array, first: int, own: float, around: float, out: Array) -> None:
    """Root of ``own`` x variance + ``around`` x mean variance of the known among 3 x 3 pixels.

    ``out`` (m, W) float32 gets the rows of ``confidence`` from ``first`` on; border pixels count
    for those beyond them.
    """
    rows, columns = confidence.shape
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


@compiled
def encoded(
    linear: Array,
    bits: Array,
    table: Array,
    lowest: np.float32,
    first: int,
    shift: int,
    largest: np.float32,
    out: Array,
) -> None:
    """Values (N,) float32 through a curve from 0..1 to 0..1, as whole numbers up to ``largest``.

    ``bits`` (int32) are the values' own bits, which run linearly with the value from one power of
    two to the next, and so does the curve from one entry of ``table`` to the next: entry k is the
    curve at the bits ``first + (k << shift)``, the last one at 1.  Below ``lowest``, whose bits are
    ``first``, the curve is a line to 0.  Values outside 0..1 count as its ends, NaN as 0.
    """
    share = np.float32(1 / (1 << shift))
    steep = table[0] / lowest
    for i in range(linear.size):
        value = linear[i]
        place = bits[i] - first
        if value >= 1:
            curve = table[-1]
        elif value > 0:
            if place < 0:
                curve = steep * value
            else:
                k = place >> shift
                curve = table[k] + (table[k + 1] - table[k]) * (share * np.float32(place - (k << shift)))
        else:
            curve = np.float32(0)
        out[i] = np.int32(curve * np.float32(largest) + np.float32(0.5))


@compiled
def normal_colours(normals: Array, out: Array) -> None:
    """Unit normals (n, W, 3) as 8-bit colours ``round(127.5 n + 127.5)``; not known: 0."""
    half = np.float32(127.5)
    for i in range(normals.shape[0]):
        for j in range(normals.shape[1]):
            x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            known = x + y + z == x + y + z
            for k in range(3):
                # The conversion cuts off what follows the point, so half a step more rounds.
                value = min(max(half * normals[i, j, k] + np.float32(128), np.float32(0)), np.float32(255))
                out[i, j, k] = np.uint8(value) if known else np.uint8(0)


@compiled
def differences(colours: Array, out: Array) -> None:
    """Rows of colours (n, B) as PNG filters them: each less the one above it, modulo 256.

    ``out`` (n, 1 + B) has the filter's number in front of each row: 2, "up", and 0, "none", for the
    first row, which so depends on no other.
    """
    out[0, 0] = 0
    out[0, 1:] = colours[0]
    for i in range(1, colours.shape[0]):
        out[i, 0] = 2
        for j in range(colours.shape[1]):
            out[i, 1 + j] = colours[i, j] - colours[i - 1, j]


@compiled
def block_means(array: Array, factor: int, out: Array) -> None:
    """Means of what is known in blocks of pixels (n * factor, W, C), NaN where under half of a block is."""
    total, known = np.empty(out.shape[1:]), np.empty(out.shape[1:])
    for k in range(out.shape[0]):
        total[:] = 0
        known[:] = 0
        for i in range(k * factor, (k + 1) * factor):
            for m in range(out.shape[1]):
                for j in range(m * factor, (m + 1) * factor):
                    for channel in range(out.shape[2]):
                        value = np.float64(array[i, j, channel])
                        valid = np.isfinite(value)
                        total[m, channel] += value if valid else 0.0
                        known[m, channel] += 1.0 if valid else 0.0
        for m in range(out.shape[1]):
            for channel in range(out.shape[2]):
                enough = 2 * known[m, channel] >= factor * factor
                out[k, m, channel] = total[m, channel] / known[m, channel] if enough else np.nan


@compiled
def line_means(
    numbers: Array, scale: float, level: float, largest: float, means: Array, saturated: Array
) -> None:
    """Means of the light of some lines of a photograph (n, w * block, C), block by block.

    Parameters
    ----------
    numbers : (n, W, C) array of uint8 or uint16
        What the file holds.
    scale, level, largest : float
        Light per number, the number at which the sensor saturates, the largest light there is.
    means : (w, C) float32 array
        Receives them.
    saturated : (w,) float32 array
        Receives the share of pixels of which any colour is saturated.
    """
    lines, count = numbers.shape[0], means.shape[0]
    block = numbers.shape[1] // count
    sums = np.zeros(numbers.shape[2])
    for m in range(count):
        sums[:] = 0
        over = 0
        for i in range(lines):
            for j in range(m * block, (m + 1) * block):
                high = 0.0
                for channel in range(sums.size):
                    number = np.float64(numbers[i, j, channel])
                    sums[channel] += min(number * scale, largest)
                    high = max(high, number)
                over += high >= level
        means[m] = sums / (lines * block)
        saturated[m] = over / (lines * block)


@compiled
def sum_of_known(values: Array) -> tuple[float, int]:
    """Sum, in float64, and number of the finite ones of some values (N,)."""
    total, known = 0.0, 0
    for i in range(values.size):
        if np.isfinite(values[i]):
            total += values[i]
            known += 1
    return total, known


@compiled
def misclosure(normals: Array, steepest: float) -> tuple[float, int]:
    """Sum of the squares, and number, of `map_statistics.misclosure` over (n, W, 3), per pixel size.

    Slopes are limited to ``steepest``, as in `NormalField.gradient`.
    """
    columns = normals.shape[1]
    p, q = np.empty((2, columns), np.float32), np.empty((2, columns), np.float32)
    total, known = 0.0, 0
    for i in range(normals.shape[0]):
        above, here = (i + 1) % 2, i % 2
        for j in range(columns):
            nz = normals[i, j, 2]
            across, down = -normals[i, j, 0] / nz, normals[i, j, 1] / nz
            slope = math.sqrt(across * across + down * down)
            limit = steepest / slope if slope > steepest else 1.0
            p[here, j] = across * limit if nz > 0 else np.nan
            q[here, j] = down * limit if nz > 0 else np.nan
        if i == 0:
            continue
        for j in range(columns - 1):
            missed = np.float64(p[above, j] + p[above, j + 1] - p[here, j] - p[here, j + 1])
            missed = (missed + q[above, j + 1] + q[here, j + 1] - q[above, j] - q[here, j]) / 2
            if np.isfinite(missed):
                total += missed * missed
                known += 1
    return total, known


@compiled
def plane_sums(height: Array, x: Array, y: Array, matrix: Array, right: Array) -> None:
    """Sums over the known pixels of (n, W) for a least-squares plane z = a x + b y + c.

    ``matrix`` (3, 3) gets those of the products of x, y and 1, ``right`` (3,) those with z.
    """
    matrix[:] = 0
    right[:] = 0
    for i in range(height.shape[0]):
        n, sx, sxx, sz, sxz = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(height.shape[1]):
            z = np.float64(height[i, j])
            if np.isfinite(z):
                n += 1
                sx += x[j]
                sxx += x[j] * x[j]
                sz += z
                sxz += x[j] * z
        matrix[0] += np.array((sxx, sx * y[i], sx))
        matrix[1] += np.array((sx * y[i], n * y[i] * y[i], n * y[i]))
        matrix[2] += np.array((sx, n * y[i], n))
        right += np.array((sxz, sz * y[i], sz))
