"""Compiled medians: what most triplets of lights say, as `triplets.median_of_triplets` has it.

See `nlights_core.solving.compiled_fits` for the blocks of pixels.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, TRIAL, USABLE, VALUE, ZERO, X, Y, Z, inner
from nlights_core.solving.compiled_fits import DETERMINANT, SCALED, Work, solve_exactly, sure_determinant

_SIGN, _OTHERS = np.int32(-(2**31)), np.int32(2**31 - 1)
_HALF = np.float32(0.5)


@inner
def take_medians(samples: Array, fit: Array, work: Work, condition: float) -> None:
    """Put medians in the place of what least squares found; NaN where that is not determined.

    Parameters
    ----------
    samples, fit : arrays
        A block with its fit, inverted and refined.
    work : Work
        With the triplets, and room for what they say.
    condition : float
        As for `nlights_core.solving.least_squares.fit`.
    """
    _solve_triplets(samples, work.triplets, work.said)
    sure = sure_determinant(condition)
    for p in range(BLOCK):
        if not fit[DETERMINANT + p] > sure:
            # Whoever looks at it later need not solve it again.
            # So it holds 1 or -1 here, and no determinant: known, or not.
            fit[DETERMINANT + p] = ONE if solve_exactly(samples, fit, p, TRIAL, condition) else -ONE
    # Rows: sum of all shares; sum of those below the number on trial; the median.
    total, below, found = work.rows[0], work.rows[1], work.rows[2]
    for p in range(BLOCK):
        total[p] = ZERO
    for t in range(len(work.triplets)):
        for p in range(BLOCK):
            total[p] += work.said[3, t, p]
    for k in range(3):
        _median(work.said[k], work.said[3], total, below, found)
        for p in range(BLOCK):
            known = (total[p] > ZERO) & (fit[DETERMINANT + p] > ZERO)
            fit[SCALED + k * BLOCK + p] = found[p] if known else np.float32(np.nan)


@inner
def _solve_triplets(samples: Array, triplets: Array, said: Array) -> None:
    """Albedo times normal that each triplet says, and its share."""
    for t in range(len(triplets)):
        a, b, c = samples[triplets[t, 0]], samples[triplets[t, 1]], samples[triplets[t, 2]]
        for p in range(BLOCK):
            ax, ay, az = a[X + p], a[Y + p], a[Z + p]
            bx, by, bz = b[X + p], b[Y + p], b[Z + p]
            cx, cy, cz = c[X + p], c[Y + p], c[Z + p]
            # Cramer's rule: cross products of two lights over the volume that the three span.
            bcx, bcy, bcz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
            volume = ax * bcx + ay * bcy + az * bcz
            divisor = ONE if volume == ZERO else volume
            va, vb, vc = a[VALUE + p], b[VALUE + p], c[VALUE + p]
            said[0, t, p] = (va * bcx + vb * (cy * az - cz * ay) + vc * (ay * bz - az * by)) / divisor
            said[1, t, p] = (va * bcy + vb * (cz * ax - cx * az) + vc * (az * bx - ax * bz)) / divisor
            said[2, t, p] = (va * bcz + vb * (cx * ay - cy * ax) + vc * (ax * by - ay * bx)) / divisor
            # The squared volume makes a triplet in one plane, whose three numbers mean nothing, count nothing.
            said[3, t, p] = volume * volume * a[USABLE + p] * b[USABLE + p] * c[USABLE + p]


@inner
def _median(values: Array, shares: Array, total: Array, below: Array, median: Array) -> None:
    """Median of the values of each pixel, each counting by its share; the values are lost.

    The bits of numbers are ordered like the numbers once those of negative ones are turned round.  So
    the median is found bit by bit, from the highest: it is the largest number below which there is less
    than half of all shares.
    """
    bits, found = values.view(np.int32), median.view(np.int32)
    for t in range(len(bits)):
        for p in range(BLOCK):
            # The shift repeats the sign: all other bits of a negative number are turned round, those of others stay.
            bits[t, p] ^= (bits[t, p] >> 31) & _OTHERS
    for p in range(BLOCK):
        found[p] = _SIGN
    for shift in range(31, -1, -1):
        bit = np.int32(1 << shift) if shift < 31 else _SIGN
        for p in range(BLOCK):
            below[p] = ZERO
        for t in range(len(bits)):
            for p in range(BLOCK):
                # The highest bit is the sign: to set it means to take it away.
                below[p] += shares[t, p] if bits[t, p] < np.int32(found[p] ^ bit) else ZERO
        for p in range(BLOCK):
            found[p] ^= bit if below[p] < _HALF * total[p] else np.int32(0)
    for p in range(BLOCK):
        found[p] ^= (found[p] >> 31) & _OTHERS
