"""Compiled loops over the pixels of maps that are made into pictures for viewing.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel


@kernel
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
        # Negative below ``lowest``, where the curve is a line.
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


@kernel
def normal_colours(normals: Array, out: Array) -> None:
    """Unit normals (n, W, 3) as 8-bit colours ``round(127.5 n + 127.5)``; not known: 0."""
    half = np.float32(127.5)
    for i in range(normals.shape[0]):
        for j in range(normals.shape[1]):
            x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
            # NaN is not equal to itself.
            known = x + y + z == x + y + z
            for k in range(3):
                # The conversion cuts off what follows the point, so half a step more rounds.
                value = min(max(half * normals[i, j, k] + np.float32(128), np.float32(0)), np.float32(255))
                out[i, j, k] = np.uint8(value) if known else np.uint8(0)


@kernel
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
