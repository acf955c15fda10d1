"""Compiled development: the numbers of photographs become samples, and solutions the stage's images.

What `development.Darkroom.develop` and `solving` say in numpy, for blocks of pixels as
`nlights_core.solving.compiled_fits` has them.  A block is a part of a row of the photographs; the last one of
a row is filled up with pixels of weight 0.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.frames import Array
from nlights_core.photographs.blocks import (
    BLOCK,
    ONE,
    TINY,
    TRIAL,
    USABLE,
    VALUE,
    ZERO,
    X,
    Y,
    Z,
    copy,
    inner,
    kernel,
)
from nlights_core.photographs.strips import Blocks, Optics, Strip

# Of the counts of a block, in an array (COUNTED,):
SATURATED, SHADOWED, COUNTED = 0, BLOCK, 2 * BLOCK

# Of the scratch of a block, in an array (SCRATCH,): the pixel's point, 1 + its distance^2 from the
# camera's axis over z^2, where it is in its cell of the flat field, the exponent that the vignetting adds, the
# mask; the number of lights that are saturated; three colours of the dark frame, of the photograph, and of
# minus the binary logarithm of the flat field.
_X, _Y, _Z, _SEEN, _FURTHER, _RIGHT, _DOWN, _CELL, _LENS, _INSIDE, _LOST = range(0, 11 * BLOCK, BLOCK)
_DARK, LIGHT, INVERSE, SCRATCH = range(11 * BLOCK, 23 * BLOCK, 3 * BLOCK)

GROUP = 16
"""Pixels for which the flat field is interpolated together; seldom are they in more than two of its cells."""

_ALL_PHOTONS = np.float32(PHOTONS)
_THIRD, _FIFTH = np.float32(1 / 3), np.float32(1 / 5)
_WHOLE = np.float32(1.5 * 2**23)
"""Added to a number of single precision, it leaves no room for a fraction."""
# fmt: off
_E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(term) for term in (
    0.6931471805599453, 0.2402265069591007, 0.05550410866482158,
    0.009618129107628477, 0.0013333558146428443, 0.0001540353039338161,
))
# fmt: on
"""Terms of the series of 2^r, ln(2)^n / n!; up to |r| = 1/2 the next one is below 1e-7."""


@kernel
def develop(
    strip: Strip, optics: Optics, first: int, shadow: np.float32, lit: np.float32, blocks: Blocks
) -> None:
    """Develop blocks of a strip, beginning with a given one.

    Parameters
    ----------
    strip, optics : Strip, Optics
    first : int
        Number of the first block; past the last one, blocks get weight 0.
    shadow : float32
        Share of the brightest sample below which one is counted as shadow.
    lit : float32
        Share of the brightest sample that one must exceed to be usable, if it is not 0.
    blocks : Blocks
        Receives them.
    """
    count = len(optics.lamps)
    rows, columns = len(strip.y), len(strip.x)
    across = (columns + BLOCK - 1) // BLOCK
    numbers, channels = strip.numbers, strip.numbers.shape[2] // columns
    surface, dark = strip.height.size > 0, len(numbers) > count
    positions, near = optics.positions, optics.near[0]
    of = blocks.scratch
    for block in range(len(blocks.samples)):
        row, column = (first + block) // across, (first + block) % across * BLOCK
        counts = blocks.counts[block]
        counts[:] = ZERO
        if row >= rows:
            blocks.samples[block] = ZERO
            blocks.colours[block] = ZERO
            continue
        size = min(columns - column, BLOCK)
        _stand(strip, optics, row, column, size, of)
        # What is not read below, past the end of a row or the colours of grey photographs, is dark.
        of[_DARK : LIGHT + 3 * BLOCK] = ZERO
        if dark:
            # What it counts in the first lamp's place is not kept.
            here = numbers[count, row, channels * column : channels * (column + size)]
            _read(
                here,
                size,
                optics.scale,
                optics.lamps[0, 3],
                of,
                blocks.totals[count],
                blocks.samples[block, 0],
            )
            copy(of[LIGHT : LIGHT + 3 * BLOCK], of[_DARK : _DARK + 3 * BLOCK])
        of[_LOST : _LOST + BLOCK] = ZERO
        for i in range(count):
            sample = blocks.samples[block, i]
            here = numbers[i, row, channels * column : channels * (column + size)]
            _read(here, size, optics.scale, optics.lamps[i, 3], of, blocks.totals[i], sample)
            if surface or i == 0:
                _meet(positions[i], near, optics.place, optics.flat_field_shape, optics.lens, of)
            _aim(positions[i], near, of, sample)
            _interpolate(optics.flat_field[i], of)
            _divide(optics.lamps[i], optics.limits[0], of, sample, blocks.colours[block, i])
        copy(of[_LOST:], counts[SATURATED : SATURATED + BLOCK])
        _weigh(blocks.samples[block], optics.limits[1], counts, shadow, lit, of)


@kernel
def cells(values: Array, columns: int, found: Array) -> None:
    """Compute the cells of `Optics.flat_field`.

    Parameters
    ----------
    values : (L, H W, C) float32 array
        Minus the binary logarithm of the flat field; of one channel or three.
    columns : int
        W.
    found : (L, H W, 12) float32 array
        Receives the cells; those that begin at the right and lower border are left as they are.
    """
    for i in range(len(values)):
        value = values[i]
        for at in range(len(value) - columns):
            if at % columns == columns - 1:
                continue
            for c in range(3):
                k = c if value.shape[1] > 1 else 0
                first, right, down = value[at, k], value[at + 1, k], value[at + columns, k]
                found[i, at, 4 * c] = first
                found[i, at, 4 * c + 1] = right - first
                found[i, at, 4 * c + 2] = down - first
                found[i, at, 4 * c + 3] = value[at + columns + 1, k] - down - (right - first)


@inner
def _stand(strip: Strip, optics: Optics, row: int, column: int, size: int, of: Array) -> None:
    """Locate the pixels of a block on the surface; whether they are inside the mask."""
    y = strip.y[row]
    of[_X : _X + BLOCK] = strip.x[column]
    of[_Y : _Y + BLOCK] = y
    of[_Z : _Z + BLOCK] = ZERO
    of[_INSIDE : _INSIDE + BLOCK] = ZERO
    of[_LENS : _LENS + BLOCK] = ZERO
    for p in range(size):
        of[_X + p] = strip.x[column + p]
        of[_INSIDE + p] = ONE
    if strip.inside.size:
        for p in range(size):
            of[_INSIDE + p] = ONE if strip.inside[row, column + p] > 0 else ZERO
    for p in range(BLOCK):
        right, up = of[_X + p] - optics.lens[0], y - optics.lens[1]
        of[_SEEN + p] = ONE + (right * right + up * up) * optics.lens[2]
    if strip.height.size:
        for p in range(size):
            z = strip.height[row, column + p]
            # Only a number that is known and finite is 0 less itself.
            of[_Z + p] = z if z - z == ZERO else ZERO
        for p in range(BLOCK):
            shift = of[_Z + p] / optics.camera[2]
            of[_X + p] += (optics.camera[0] - of[_X + p]) * shift
            of[_Y + p] += (optics.camera[1] - of[_Y + p]) * shift


@inner
def _read(
    numbers: Array,
    size: int,
    scales: Array,
    shares: Array,
    of: Array,
    totals: Array,
    sample: Array,
) -> None:
    """Light of one photograph without that of the dark frame; `USABLE` is 1 where neither saturated nor masked.

    Grey values and saturated pixels inside the mask are added to totals.
    """
    scale, level, largest = scales
    red_share, green_share, blue_share = shares
    if len(numbers) == 3 * size:
        for p in range(size):
            red, green, blue = (
                np.float32(numbers[3 * p]),
                np.float32(numbers[3 * p + 1]),
                np.float32(numbers[3 * p + 2]),
            )
            saturated = of[_INSIDE + p] if max(red, max(green, blue)) >= level else ZERO
            red = min(red * scale, largest) - of[_DARK + p]
            green = min(green * scale, largest) - of[_DARK + BLOCK + p]
            blue = min(blue * scale, largest) - of[_DARK + 2 * BLOCK + p]
            of[LIGHT + p], of[LIGHT + BLOCK + p], of[LIGHT + 2 * BLOCK + p] = red, green, blue
            totals[p] += (red_share * red + green_share * green + blue_share * blue) * of[_INSIDE + p]
            sample[USABLE + p] = of[_INSIDE + p] - saturated
            totals[BLOCK + p] += saturated
            of[_LOST + p] += saturated
    else:
        for p in range(size):
            grey = np.float32(numbers[p])
            saturated = of[_INSIDE + p] if grey >= level else ZERO
            grey = min(grey * scale, largest) - of[_DARK + p]
            of[LIGHT + p] = grey
            totals[p] += red_share * grey * of[_INSIDE + p]
            sample[USABLE + p] = of[_INSIDE + p] - saturated
            totals[BLOCK + p] += saturated
            of[_LOST + p] += saturated
    sample[USABLE + size : USABLE + BLOCK] = ZERO


@inner
def _meet(
    position: Array,
    near: np.float32,
    place: Array,
    shape: tuple[int, int],
    lens: Array,
    of: Array,
) -> None:
    """Find where a lamp's ray meets the plane, as a cell of the flat field and a place in it; the vignetting."""
    sx, sy, sz = position
    left, top, per_step = place[0], place[1], ONE / place[2]
    most_right, most_down = np.float32(shape[1] - 1), np.float32(shape[0] - 1)
    lens_x, lens_y, per_square, vignetting = lens
    for p in range(BLOCK):
        # S_z / (S_z - z) - 1; none for distant lamps.
        further = near * of[_Z + p] / (sz - of[_Z + p])
        of[_FURTHER + p] = further
        x = of[_X + p] + (of[_X + p] - sx) * further
        y = of[_Y + p] + (of[_Y + p] - sy) * further
        right, down = (x - left) * per_step, (top - y) * per_step
        # Written so that even what is no number stays within the flat field.
        right = min(right if right > ZERO else ZERO, most_right)
        down = min(down if down > ZERO else ZERO, most_down)
        column, row = min(np.floor(right), most_right - ONE), min(np.floor(down), most_down - ONE)
        of[_RIGHT + p], of[_DOWN + p] = right - column, down - row
        of[_CELL + p] = row * (most_right + ONE) + column
        across, along = x - lens_x, y - lens_y
        met = ONE + (across * across + along * along) * per_square
        # log(met / seen) = 2 atanh(s)
        s = (met - of[_SEEN + p]) / (met + of[_SEEN + p])
        square = s * s
        of[_LENS + p] = -vignetting * s * (ONE + square * (_THIRD + square * _FIFTH))


@inner
def _aim(position: Array, near: np.float32, of: Array, sample: Array) -> None:
    """Light relative to the flat field, ``ray (S_z / (S_z - z))^3 / S_z`` (numerics, section 1)."""
    sx, sy, sz = position
    if near == ZERO:
        for p in range(BLOCK):
            sample[X + p], sample[Y + p], sample[Z + p] = sx, sy, sz
        return
    per_height = ONE / sz
    for p in range(BLOCK):
        stretch = ONE + of[_FURTHER + p]
        square = stretch * stretch
        factor = square * stretch * per_height
        sample[X + p] = (sx - of[_X + p]) * factor
        sample[Y + p] = (sy - of[_Y + p]) * factor
        sample[Z + p] = square


@inner
def _interpolate(cells: Array, of: Array) -> None:
    """Minus the binary logarithm of the flat field, without the vignetting.

    Group by group, every cell that its pixels lie in is evaluated for all of them, and each takes
    its own: that is cheaper than looking the cell up for every pixel.
    """
    for first in range(0, BLOCK, GROUP):
        group = of[first : first + SCRATCH - BLOCK + GROUP]
        number = group[_CELL]
        cell = cells[np.int64(number)]
        others = 0
        for p in range(GROUP):
            right, down = group[_RIGHT + p], group[_DOWN + p]
            others += 1 if group[_CELL + p] != number else 0
            group[INVERSE + p] = _bilinear(cell, 0, right, down)
            group[INVERSE + BLOCK + p] = _bilinear(cell, 4, right, down)
            group[INVERSE + 2 * BLOCK + p] = _bilinear(cell, 8, right, down)
        for start in range(1, GROUP if others else 0):
            if group[_CELL + start] != number:
                number = group[_CELL + start]
                cell = cells[np.int64(number)]
                for p in range(GROUP):
                    right, down, own = group[_RIGHT + p], group[_DOWN + p], group[_CELL + p] == number
                    value = _bilinear(cell, 0, right, down)
                    group[INVERSE + p] = value if own else group[INVERSE + p]
                    value = _bilinear(cell, 4, right, down)
                    group[INVERSE + BLOCK + p] = value if own else group[INVERSE + BLOCK + p]
                    value = _bilinear(cell, 8, right, down)
                    group[INVERSE + 2 * BLOCK + p] = value if own else group[INVERSE + 2 * BLOCK + p]


@numba.njit(inline="always")
def _bilinear(cell: Array, at: int, right: Any, down: Any) -> Any:
    """One colour of a cell of the flat field: value at its first corner, slopes to the right and downwards, twist."""
    return cell[at] + right * cell[at + 1] + down * (cell[at + 2] + right * cell[at + 3])


@numba.njit(inline="always")
def power_of_two(exponent: Any) -> Any:
    """2^exponent: the whole part goes into the exponent of the number, the rest into a series."""
    # The sum has no place for a fraction: it is rounded, and its lowest bits are the whole part.
    shifted = np.float32(exponent + _WHOLE)
    r = exponent - (shifted - _WHOLE)
    rest = np.float32(ONE + r * (_E1 + r * (_E2 + r * (_E3 + r * (_E4 + r * (_E5 + r * _E6))))))
    # Moved up by 23 bits, the whole part adds to the exponent of ``rest``, which is near 1.
    return np.int32(rest.view(np.int32) + np.int32(shifted.view(np.int32) << 23)).view(np.float32)


@inner
def _divide(lamp: Array, most: np.float32, of: Array, sample: Array, colours: Array) -> None:
    """Divide by power and flat field; mix grey; the variance by photons, 0 where not usable."""
    red_power, green_power, blue_power = lamp[0]
    red_share, green_share, blue_share = lamp[1]
    red_noise, green_noise, blue_noise = lamp[2]
    for p in range(BLOCK):
        red = power_of_two(of[INVERSE + p] + of[_LENS + p])
        green = power_of_two(of[INVERSE + BLOCK + p] + of[_LENS + p])
        blue = power_of_two(of[INVERSE + 2 * BLOCK + p] + of[_LENS + p])
        variance = red_noise * red + green_noise * green + blue_noise * blue
        known = max(red, max(green, blue)) < most
        # Between here and `_weigh`, `USABLE` is the variance by photons.
        sample[USABLE + p] = variance * sample[USABLE + p] if known else ZERO
        red = of[LIGHT + p] * red_power * (red if known else ONE)
        green = of[LIGHT + BLOCK + p] * green_power * (green if known else ONE)
        blue = of[LIGHT + 2 * BLOCK + p] * blue_power * (blue if known else ONE)
        sample[VALUE + p] = red_share * red + green_share * green + blue_share * blue
        colours[p], colours[BLOCK + p], colours[2 * BLOCK + p] = red, green, blue


@inner
def _weigh(
    samples: Array, readout: np.float32, counts: Array, shadow: np.float32, lit: np.float32, of: Array
) -> None:
    """Turn variances into weights that know the readout too; count shadows; leave out what is not lit.

    What is left out has value and weights 0, as `nlights_core.solving.compiled_solutions.mark_usable` leaves it.
    """
    for p in range(BLOCK):
        # Places in the flat field are done with: now sum, number and largest of the used values,
        of[_RIGHT + p], of[_DOWN + p], of[_CELL + p] = ZERO, ZERO, ZERO
    for i in range(len(samples)):
        sample = samples[i]
        for p in range(BLOCK):
            used = sample[USABLE + p] > ZERO
            value = sample[VALUE + p] if used else ZERO
            of[_RIGHT + p] += value
            of[_DOWN + p] += ONE if used else ZERO
            of[_CELL + p] = max(of[_CELL + p], value)
    for p in range(BLOCK):
        reading = max(of[_RIGHT + p] / max(of[_DOWN + p], ONE), TINY)
        # then the readout's part beside the photons', and the values up to which a sample is not lit, or in shadow.
        of[_RIGHT + p] = readout / reading
        of[_DOWN + p] = of[_CELL + p] * lit if lit > ZERO else -np.float32(np.inf)
        of[_CELL + p] *= shadow
    for i in range(len(samples)):
        sample = samples[i]
        for p in range(BLOCK):
            variance, value = sample[USABLE + p], sample[VALUE + p]
            used = variance > ZERO
            # The readout of a black pixel is infinite beside its light; the weight becomes 0.
            weight = ONE / (variance * (ONE + variance * of[_RIGHT + p]) * _ALL_PHOTONS)
            counts[SHADOWED + p] += ONE if used & (value < of[_CELL + p]) else ZERO
            # NaN and infinity less themselves are not 0.
            shown = used & (weight > ZERO) & (value > of[_DOWN + p]) & (value - value == ZERO)
            sample[VALUE + p] = value if shown else ZERO
            sample[USABLE + p] = weight if shown else ZERO
            sample[TRIAL + p] = weight if shown else ZERO
