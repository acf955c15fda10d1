"""Compiled development: the numbers of photographs become samples, and solutions the stage's images.

What `development.Darkroom.develop` and `solving` say in numpy, for blocks of pixels as
`nlights_core.compiled_fits` has them.  A block is a part of a row of the photographs; the last one of
a row is filled up with pixels of weight 0.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.compiled_fits import (
    BLOCK,
    ONE,
    TINY,
    USABLE,
    VALUE,
    ZERO,
    X,
    Y,
    Z,
    compiled,
    copy,
)
from nlights_core.frames import Array
from nlights_core.strips import Blocks, Optics, Strip

# Of the counts of a block, in an array (COUNTED,):
SATURATED, SHADOWED, COUNTED = 0, BLOCK, 2 * BLOCK

# Of the scratch of a block, in an array (SCRATCH,): the pixel's point, 1 + its distance^2 from the
# camera's axis over z^2, where it is between the samples of the plate, the exponent that the vignetting
# adds, the variance; the mask; three colours of the dark frame, of the photograph, and of one over the
# plate.
_X, _Y, _Z, _SEEN, _FURTHER, _RIGHT, _DOWN, _CELL, _LENS, _SATURATED, _INSIDE = range(0, 11 * BLOCK, BLOCK)
_DARK, LIGHT, INVERSE, SCRATCH = range(11 * BLOCK, 23 * BLOCK, 3 * BLOCK)

GROUP = 16
"""Pixels for which the plate is interpolated together; seldom are they in more than two of its cells."""

_ALL_PHOTONS = np.float32(PHOTONS)
_HALF, _TWO, _THIRD, _FIFTH = np.float32(0.5), np.float32(2), np.float32(1 / 3), np.float32(1 / 5)
# fmt: off
_E1, _E2, _E3, _E4, _E5, _E6 = (np.float32(term) for term in (
    0.6931471805599453, 0.2402265069591007, 0.05550410866482158,
    0.009618129107628477, 0.0013333558146428443, 0.0001540353039338161,
))
# fmt: on
"""Terms of the series of 2^r, ln(2)^n / n!; up to |r| = 1/2 the next one is below 1e-7."""


@compiled
def develop(strip: Strip, optics: Optics, first: int, shadow: np.float32, blocks: Blocks) -> None:
    """Develop blocks of a strip, beginning with a given one.

    Parameters
    ----------
    strip, optics : Strip, Optics
    first : int
        Number of the first block; past the last one, blocks get weight 0.
    shadow : float32
        Share of the brightest sample below which one is counted as shadow.
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
            _read(numbers[count, row], channels, column, size, optics.scale, of)
            _expose(optics.lamps[0, 3], of, blocks.totals[count])
            copy(of[LIGHT : LIGHT + 3 * BLOCK], of[_DARK : _DARK + 3 * BLOCK])
        for i in range(count):
            sample = blocks.samples[block, i]
            _read(numbers[i, row], channels, column, size, optics.scale, of)
            _expose(optics.lamps[i, 3], of, blocks.totals[i])
            _leave_out(of, sample, counts)
            if surface or i == 0:
                _meet(positions[i], near, optics.place, optics.plate_shape, optics.lens, of)
            _aim(positions[i], near, of, sample)
            _interpolate(optics.plate[i], optics.plate_shape[1], of)
            _divide(optics.lamps[i], optics.limits[0], of, sample, blocks.colours[block, i])
        _weigh(blocks.samples[block], optics.limits[1], counts, shadow, of)


@compiled
def _stand(strip: Strip, optics: Optics, row: int, column: int, size: int, of: Array) -> None:
    """Where the pixels of a block are on the surface, and whether inside the mask."""
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


@compiled
def _read(numbers: Array, channels: int, column: int, size: int, scales: Array, of: Array) -> None:
    """Light of one photograph, and whether it is saturated."""
    part = numbers[channels * column : channels * (column + size)]
    scale, level, largest = scales
    if channels == 3:
        for p in range(size):
            red, green, blue = (
                np.float32(part[3 * p]),
                np.float32(part[3 * p + 1]),
                np.float32(part[3 * p + 2]),
            )
            of[_SATURATED + p] = ONE if max(red, max(green, blue)) >= level else ZERO
            of[LIGHT + p] = min(red * scale, largest)
            of[LIGHT + BLOCK + p] = min(green * scale, largest)
            of[LIGHT + 2 * BLOCK + p] = min(blue * scale, largest)
    else:
        for p in range(size):
            number = np.float32(part[p])
            of[_SATURATED + p] = ONE if number >= level else ZERO
            of[LIGHT + p] = min(number * scale, largest)


@compiled
def _expose(shares: Array, of: Array, totals: Array) -> None:
    """Subtract the dark frame; add grey values and saturated pixels inside the mask to totals."""
    red_share, green_share, blue_share = shares
    greys, saturated = totals[0], totals[1]
    for p in range(BLOCK):
        red = of[LIGHT + p] - of[_DARK + p]
        green = of[LIGHT + BLOCK + p] - of[_DARK + BLOCK + p]
        blue = of[LIGHT + 2 * BLOCK + p] - of[_DARK + 2 * BLOCK + p]
        of[LIGHT + p], of[LIGHT + BLOCK + p], of[LIGHT + 2 * BLOCK + p] = red, green, blue
        greys[p] += (red_share * red + green_share * green + blue_share * blue) * of[_INSIDE + p]
        saturated[p] += of[_SATURATED + p] * of[_INSIDE + p]


@compiled
def _leave_out(of: Array, sample: Array, counts: Array) -> None:
    """`USABLE` is 1 where neither saturated nor masked."""
    for p in range(BLOCK):
        saturated = of[_SATURATED + p] * of[_INSIDE + p]
        counts[SATURATED + p] += saturated
        sample[USABLE + p] = of[_INSIDE + p] - saturated


@compiled
def _meet(
    position: Array,
    near: np.float32,
    place: Array,
    shape: tuple[int, int],
    lens: Array,
    of: Array,
) -> None:
    """Where a lamp's ray meets the plane, as a cell of the plate and a place in it; the vignetting."""
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
        # Written so that even what is no number stays within the plate.
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


@compiled
def _aim(position: Array, near: np.float32, of: Array, sample: Array) -> None:
    """Light relative to the plate, ``ray (S_z / (S_z - z))^3 / S_z`` (numerics, section 1)."""
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


@compiled
def _interpolate(corners: Array, columns: int, of: Array) -> None:
    """One over the plate's reading.

    Group by group, every cell that its pixels lie in is evaluated for all of them, and each takes
    its own: that is cheaper than looking four corners up for every pixel.
    """
    size = len(corners) // 3
    for first in range(0, BLOCK, GROUP):
        group = of[first : first + SCRATCH - BLOCK + GROUP]
        start = 0
        while start < GROUP:
            cell = group[_CELL + start]
            at = np.int64(cell)
            red, red_right, red_down, red_twist = _bilinear(corners, at, columns)
            green, green_right, green_down, green_twist = _bilinear(corners, size + at, columns)
            blue, blue_right, blue_down, blue_twist = _bilinear(corners, 2 * size + at, columns)
            for p in range(GROUP):
                x, y, own = group[_RIGHT + p], group[_DOWN + p], group[_CELL + p] == cell
                value = red + x * red_right + y * (red_down + x * red_twist)
                group[INVERSE + p] = value if own else group[INVERSE + p]
                value = green + x * green_right + y * (green_down + x * green_twist)
                group[INVERSE + BLOCK + p] = value if own else group[INVERSE + BLOCK + p]
                value = blue + x * blue_right + y * (blue_down + x * blue_twist)
                group[INVERSE + 2 * BLOCK + p] = value if own else group[INVERSE + 2 * BLOCK + p]
            start += 1
            while start < GROUP and group[_CELL + start] == cell:
                start += 1
    for c in range(3):
        out = of[INVERSE + c * BLOCK : INVERSE + (c + 1) * BLOCK]
        for p in range(BLOCK):
            # 2^e: the whole part goes into the exponent of the number, the rest into a series.
            exponent = out[p] + of[_LENS + p]
            whole = np.floor(exponent + _HALF)
            r = exponent - whole
            rest = ONE + r * (_E1 + r * (_E2 + r * (_E3 + r * (_E4 + r * (_E5 + r * _E6)))))
            out[p] = rest * np.int32((np.int32(whole) + 127) << 23).view(np.float32)


@numba.njit(inline="always")
def _bilinear(corners: Array, at: Any, columns: int) -> tuple[Any, Any, Any, Any]:
    """Value at a cell's first corner, slopes to the right and downwards, twist."""
    first, right, down = corners[at], corners[at + 1], corners[at + columns]
    return first, right - first, down - first, corners[at + columns + 1] - down - (right - first)


@compiled
def _divide(lamp: Array, most: np.float32, of: Array, sample: Array, colours: Array) -> None:
    """Divide by power and plate; mix grey; the variance by photons, 0 where not usable."""
    red_power, green_power, blue_power = lamp[0]
    red_share, green_share, blue_share = lamp[1]
    red_noise, green_noise, blue_noise = lamp[2]
    for p in range(BLOCK):
        red, green, blue = (
            of[INVERSE + p],
            of[INVERSE + BLOCK + p],
            of[INVERSE + 2 * BLOCK + p],
        )
        variance = red_noise * red + green_noise * green + blue_noise * blue
        known = max(red, max(green, blue)) < most
        sample[USABLE + p] = variance * sample[USABLE + p] if known else ZERO
        red = of[LIGHT + p] * red_power * (red if known else ONE)
        green = of[LIGHT + BLOCK + p] * green_power * (green if known else ONE)
        blue = of[LIGHT + 2 * BLOCK + p] * blue_power * (blue if known else ONE)
        sample[VALUE + p] = red_share * red + green_share * green + blue_share * blue
        colours[p], colours[BLOCK + p], colours[2 * BLOCK + p] = red, green, blue


@compiled
def _weigh(samples: Array, readout: np.float32, counts: Array, shadow: np.float32, of: Array) -> None:
    """Turn variances into weights that know the readout too; count shadows."""
    for p in range(BLOCK):
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
        of[_RIGHT + p] = readout / reading
        of[_CELL + p] *= shadow
    for i in range(len(samples)):
        sample = samples[i]
        for p in range(BLOCK):
            variance = sample[USABLE + p]
            used = variance > ZERO
            # The readout of a black pixel is infinite beside its light; the weight becomes 0.
            weight = ONE / (variance * (ONE + variance * of[_RIGHT + p]) * _ALL_PHOTONS)
            counts[SHADOWED + p] += ONE if used & (sample[VALUE + p] < of[_CELL + p]) else ZERO
            sample[USABLE + p] = weight if used else ZERO
