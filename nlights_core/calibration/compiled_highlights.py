"""Compiled highlights over a block of pixels: what samples read beyond matt paint, and its slopes.

What `nlights_core.calibration.reflectance` says of arrays, for a block at a time: one lobe after another, the
loop over the pixels inside, so that the compiler makes vector instructions of it (`nlights_core.photographs.blocks`).
`nlights_core.calibration.compiled_reflectance` says it of one sample in double precision, for a calibration.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from nlights_core.calibration.compiled_reflectance import BECKMANN, FAINT, GGX
from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, TINY, ZERO, inner
from nlights_core.photographs.compiled_development import power_of_two

# Of the pixels of a block, in an array (FACE,): unit vector to the camera; scaled normal; unit normal, length of the
# scaled one, cosine between normal and view.
VIEW, SCALED, NORMAL = 0, 3 * BLOCK, 6 * BLOCK
LENGTH, SEEN, FACE = range(9 * BLOCK, 12 * BLOCK, BLOCK)

# Of one lobe and the pixels of a block, in an array (HIDDEN,): the share that is not masked towards the camera, over
# the cosine of that; its derivative by the cosine, as a share of it.
OPEN, STEEPER, HIDDEN = range(0, 3 * BLOCK, BLOCK)

# Of a sample, in an array (RAY,): its weight; light as a unit vector, half vector, cosine between light and view,
# strength of the departure, and that of a mirror; and of the last evaluation what lobes read and its slopes by the
# normal.
WEIGHT, LIGHT, HALF = 0, BLOCK, 4 * BLOCK
WITH_VIEW, ROUGH, MIRROR, SHINE = range(7 * BLOCK, 11 * BLOCK, BLOCK)
SLOPE, RAY = 11 * BLOCK, 14 * BLOCK

# Of the sample under evaluation, in an array (GLANCE,): strength of a mirror, 0 where the surface faces away; cosine
# to the light; cosine to the half vector, and square of its sine; one over the cosine to the half vector, and over
# the sine to the light; then sums over the lobes, and their derivatives by the cosines to half vector, light, view.
_GATE, LIT, _UPRIGHT, _SQUARE, _PER_UPRIGHT, _PER_SINE = range(0, 6 * BLOCK, BLOCK)
TOTAL, TO_HALF, TO_LIGHT, TO_VIEW, GLANCE = range(6 * BLOCK, 11 * BLOCK, BLOCK)

_TWO, _FOUR, _HALF, _QUARTER = np.float32(2), np.float32(4), np.float32(0.5), np.float32(0.25)
_PER_LN2 = np.float32(1 / np.log(2))
_FAINT = np.float32(FAINT / np.log(2))
_FLATTEST = np.float32(1e-12)
# Smith's masking of Beckmann's facets, as a ratio of polynomials (Walter et al., equation 27).
_P1, _P2, _Q1, _Q2, _STEEP = (np.float32(term) for term in (3.535, 2.181, 2.276, 2.577, 1.6))
# Of the binary logarithm, by 2 / ln(2) atanh(t) = 2 / ln(2) (t + t^3 / 3 + ...); the next term is below 1e-7.
_L1, _L3, _L5, _L7 = (np.float32(2 / np.log(2) / n) for n in (1, 3, 5, 7))
_ROOT_HALF = np.int32(0x3F3504F3)
"""Bits of the square root of 1/2."""


@numba.njit(inline="always")
def _logarithm(x: Any) -> Any:
    """Binary logarithm of a positive number: its exponent, and a series about 1 for the rest."""
    bits = np.int32(np.float32(x).view(np.int32))
    whole = np.int32((bits - _ROOT_HALF) >> 23)
    rest = np.int32(bits - np.int32(whole << 23)).view(np.float32)
    t = (rest - ONE) / (rest + ONE)
    square = t * t
    return np.float32(whole) + t * (_L1 + square * (_L3 + square * (_L5 + square * _L7)))


@inner
def turn_faces(of: Array) -> None:
    """Fill in `NORMAL`, `LENGTH` and `SEEN` of the scaled normals."""
    for p in range(BLOCK):
        x, y, z = of[SCALED + p], of[SCALED + BLOCK + p], of[SCALED + 2 * BLOCK + p]
        length = np.sqrt(x * x + y * y + z * z)
        per_length = ONE / length
        x, y, z = x * per_length, y * per_length, z * per_length
        of[NORMAL + p], of[NORMAL + BLOCK + p], of[NORMAL + 2 * BLOCK + p] = x, y, z
        of[LENGTH + p] = length
        of[SEEN + p] = x * of[VIEW + p] + y * of[VIEW + BLOCK + p] + z * of[VIEW + 2 * BLOCK + p]


@inner
def hide_facets(of: Array, alphas: Array, kinds: Array, hidden: Array) -> None:
    """Fill in how much of each lobe the camera sees."""
    for i in range(len(alphas)):
        own, alpha = hidden[i], alphas[i]
        square = alpha * alpha
        rest, per_alpha = ONE - square, ONE / alpha
        if kinds[i] == GGX:
            for p in range(BLOCK):
                seen = of[SEEN + p] if of[SEEN + p] > ZERO else ONE
                root = np.sqrt(square + rest * seen * seen)
                per_sum = ONE / (seen + root)
                own[OPEN + p] = _TWO * per_sum
                own[STEEPER + p] = -(ONE + rest * seen / root) * per_sum
        elif kinds[i] == BECKMANN:
            for p in range(BLOCK):
                seen = of[SEEN + p] if of[SEEN + p] > ZERO else ONE
                per_sine = ONE / np.sqrt(max(ONE - seen * seen, _FLATTEST))
                through, by_cosine = _unmasked(seen, per_sine, per_alpha)
                own[OPEN + p] = through / seen
                own[STEEPER + p] = (by_cosine - ONE) / seen
        else:
            for p in range(BLOCK):
                own[OPEN + p], own[STEEPER + p] = ONE, ZERO


@numba.njit(inline="always")
def _unmasked(cosine: Any, per_sine: Any, per_alpha: Any) -> Any:
    """Share of Beckmann's facets that is not masked, and its derivative by log(cosine) as a share of it."""
    a = cosine * per_sine * per_alpha
    upper, below = _P1 + _P2 * a, ONE + a * (_Q1 + _Q2 * a)
    inverse = ONE / (upper * below)
    by_a = (_P1 + _TWO * _P2 * a) * below * inverse - a * (_Q1 + _TWO * _Q2 * a) * upper * inverse
    steep = a >= _STEEP
    return (ONE if steep else a * upper * upper * inverse), (ZERO if steep else by_a * per_sine * per_sine)


@inner
def glance(of: Array, ray: Array, own: Array) -> None:
    """Fill in the cosines of a sample, and empty its sums."""
    for p in range(BLOCK):
        x, y, z = of[NORMAL + p], of[NORMAL + BLOCK + p], of[NORMAL + 2 * BLOCK + p]
        lit = x * ray[LIGHT + p] + y * ray[LIGHT + BLOCK + p] + z * ray[LIGHT + 2 * BLOCK + p]
        # The sine from the difference of normal and half vector: near the peak 1 - cosine^2 has no digits left.
        x, y, z = x - ray[HALF + p], y - ray[HALF + BLOCK + p], z - ray[HALF + 2 * BLOCK + p]
        apart = x * x + y * y + z * z
        faces = (lit > ZERO) & (of[SEEN + p] > ZERO)
        lit = lit if faces else ONE
        upright = ONE - _HALF * apart if faces else ONE
        sine = np.sqrt(max(ONE - lit * lit, _FLATTEST))
        inverse = ONE / (upright * sine)
        own[_GATE + p] = ray[MIRROR + p] if faces else ZERO
        own[LIT + p] = lit
        own[_UPRIGHT + p] = upright
        own[_SQUARE + p] = apart * (ONE - _QUARTER * apart) if faces else ONE
        own[_PER_UPRIGHT + p] = inverse * sine
        own[_PER_SINE + p] = inverse * upright
        own[TOTAL + p], own[TO_HALF + p], own[TO_LIGHT + p], own[TO_VIEW + p] = ZERO, ZERO, ZERO, ZERO


@inner
def add_lobes(gloss: Array, alphas: Array, kinds: Array, hidden: Array, own: Array) -> None:
    """Add the lobes to the sums of a sample."""
    for i in range(len(alphas)):
        square = alphas[i] * alphas[i]
        if kinds[i] == GGX:
            _add_ggx(gloss[i], square, hidden[i], own)
            continue
        # Most samples of a narrow lobe without tails show nothing of it.  The bound is of the square of the sine.
        reach = -np.float32(FAINT) * square
        if kinds[i] == BECKMANN:
            reach = reach / (ONE + reach)
        else:
            reach = (
                ONE - power_of_two(max(-_PER_LN2 * reach / (ONE - square), _FAINT)) if square < ONE else ONE
            )
        some = 0
        for p in range(BLOCK):
            some += 1 if own[_SQUARE + p] < reach else 0
        if some and kinds[i] == BECKMANN:
            _add_beckmann(gloss[i], alphas[i], reach, hidden[i], own)
        elif some:
            _add_blinn(gloss[i], square, reach, own)


@inner
def _add_ggx(gloss: Any, square: Any, hidden: Array, own: Array) -> None:
    rest = ONE - square
    strength = _TWO * gloss * square
    for p in range(BLOCK):
        lit = own[LIT + p]
        wide = square + rest * own[_SQUARE + p]
        root = np.sqrt(square + rest * lit * lit)
        # One division for all three.
        inverse = ONE / (wide * root * (lit + root))
        narrow, per_both = inverse * root * (lit + root), inverse * wide
        even = strength * own[_GATE + p] * narrow * narrow * per_both * root * hidden[OPEN + p]
        shine = even * lit
        own[TOTAL + p] += shine
        own[TO_HALF + p] += shine * _FOUR * rest * own[_UPRIGHT + p] * narrow
        own[TO_LIGHT + p] += even * (ONE - lit * (root + rest * lit) * per_both)
        own[TO_VIEW + p] += shine * hidden[STEEPER + p]


@inner
def _add_beckmann(gloss: Any, alpha: Any, reach: Any, hidden: Array, own: Array) -> None:
    per_alpha = ONE / alpha
    per_square = per_alpha * per_alpha
    strength = gloss * per_square
    for p in range(BLOCK):
        lit, square = own[LIT + p], own[_SQUARE + p]
        per_flat = own[_PER_UPRIGHT + p] * own[_PER_UPRIGHT + p]
        bent = power_of_two(max(-square * per_flat * per_square * _PER_LN2, _FAINT))
        through, by_cosine = _unmasked(lit, own[_PER_SINE + p], per_alpha)
        shine = strength * own[_GATE + p] * bent * per_flat * per_flat * through * hidden[OPEN + p]
        shine = shine if square < reach else ZERO
        own[TOTAL + p] += shine
        own[TO_HALF + p] += shine * (_TWO * per_flat * per_square - _FOUR) * own[_PER_UPRIGHT + p]
        own[TO_LIGHT + p] += shine * by_cosine / lit
        own[TO_VIEW + p] += shine * hidden[STEEPER + p]


@inner
def _add_blinn(gloss: Any, square: Any, reach: Any, own: Array) -> None:
    power = ONE / square - ONE
    strength = gloss / square
    for p in range(BLOCK):
        exponent = power * _logarithm(max(ONE - own[_SQUARE + p], TINY))
        even = strength * own[_GATE + p] * power_of_two(max(exponent, _FAINT))
        even = even if own[_SQUARE + p] < reach else ZERO
        shine = even * own[LIT + p]
        own[TOTAL + p] += shine
        own[TO_HALF + p] += shine * _TWO * power * own[_PER_UPRIGHT + p]
        own[TO_LIGHT + p] += even


@numba.njit(inline="always")
def cross_term(of: Array, ray: Array, own: Array, p: int) -> Any:
    """Oren and Nayar's cross term times the cosine of incidence; its derivatives by the cosines to light and view."""
    lit, seen = own[LIT + p], of[SEEN + p]
    across = ray[WITH_VIEW + p] - lit * seen
    there = (across > ZERO) & (own[_GATE + p] > ZERO)
    per_larger = ONE / max(lit, seen)
    tilted = lit < seen
    share = lit * per_larger
    term = across * share
    by_light = (across * per_larger - lit) if tilted else -seen
    by_view = -lit * share - (term * per_larger if tilted else ZERO)
    return (term if there else ZERO), (by_light if there else ZERO), (by_view if there else ZERO)
