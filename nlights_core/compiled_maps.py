"""Compiled loops over the pixels of maps: their correction, codes for viewing and reduction.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.compiling import compiled
from nlights_core.frames import Array

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
def levels(values: Array, low: float, high: float, span: float, out: Array) -> None:
    """Places of values (h, w) on a scale of 256 steps from ``low`` to ``high``, ``span`` apart; not known: 0."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            share = (min(max(value, low), high) - low) / span
            out[i, j] = np.uint8(share * 255 + 0.5) if abs(value) < np.inf else np.uint8(0)


@compiled
def hatched(colours: Array, known: Array, times: int, out: Array) -> None:
    """Colours (h, w, 3), each ``times`` x ``times`` pixels of ``out``, and grey stripes where not known."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            stripe = np.uint8(196 if (i + j) // 5 % 2 else 164)
            valid = known[i // times, j // times]
            for k in range(3):
                out[i, j, k] = colours[i // times, j // times, k] if valid else stripe


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
    rows, width, channels = out.shape
    # Down first, along the memory: so a core adds several neighbours at once.
    total, known = np.empty(width * factor * channels), np.empty(width * factor * channels)
    for k in range(rows):
        total[:] = 0
        known[:] = 0
        for i in range(k * factor, (k + 1) * factor):
            line = array[i].reshape(-1)
            for j in range(total.size):
                value = np.float64(line[j])
                valid = abs(value) < np.inf
                total[j] += value if valid else 0.0
                known[j] += 1.0 if valid else 0.0
        for m in range(width):
            for channel in range(channels):
                mean = count = 0.0
                for j in range(m * factor, (m + 1) * factor):
                    mean += total[j * channels + channel]
                    count += known[j * channels + channel]
                out[k, m, channel] = mean / count if 2 * count >= factor * factor else np.nan


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
