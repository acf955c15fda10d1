"""Compiled delivery: developed blocks of pixels are solved and become the normal stage's images.

See `nlights_core.solving.compiled_fits` for the blocks and `nlights_core.solving.band_solving` for the images.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, TRIAL, VALUE, ZERO, X, Y, Z, copy, inner, kernel
from nlights_core.photographs.compiled_development import (
    INVERSE,
    LIGHT,
    SATURATED,
    SCRATCH,
    SHADOWED,
    develop,
)
from nlights_core.photographs.strips import Blocks, Optics, Strip
from nlights_core.solving.compiled_choices import FITS
from nlights_core.solving.compiled_fits import Work
from nlights_core.solving.compiled_solutions import ALBEDO, NORMAL, RESIDUAL, UNCERTAINTY, solve_blocks
from nlights_core.solving.kernels import Images
from nlights_core.solving.rules import Kernel, Limits

# Of the scratch of a block: sums of w s^2 and of what a flat surface would show; number of used lights.
_TOTAL, _UPWARD, _USED = 0, BLOCK, 2 * BLOCK


@kernel
def deliver(blocks: Blocks, found: Array, first: int, white: np.float32, images: Images) -> None:
    """Write solved blocks to the rows of a strip.

    Parameters
    ----------
    blocks : Blocks
        Developed and solved.
    found : (S, FOUND) array
        From `nlights_core.solving.compiled_solutions.solve_blocks`.
    first : int
        Number of the first block.
    white : float32
        Albedo of the flat.
    images : Images
        Receives them.
    """
    rows, columns = images.confidence.shape
    across = (columns + BLOCK - 1) // BLOCK
    of = blocks.scratch
    for block in range(len(found)):
        row, column = (first + block) // across, (first + block) % across * BLOCK
        if row >= rows:
            # Of the last blocks that are worked on together, some may lie past the strip's end.
            return
        size = min(columns - column, BLOCK)
        here = slice(column, column + size)
        _colour(blocks.samples[block], blocks.colours[block], found[block], white, of)
        _put(of[LIGHT:], images.albedo[row, here])
        _put(of[INVERSE:], images.reflection[row, here])
        _put(found[block, NORMAL:], images.normals[row, here])
        copy(found[block, UNCERTAINTY:], images.confidence[row, here])
        copy(found[block, RESIDUAL:], images.residual[row, here])
        _count(of[_USED:], images.used[row, here])
        _count(blocks.counts[block, SATURATED:], images.saturated[row, here])
        _count(blocks.counts[block, SHADOWED:], images.shadow[row, here])


@kernel
def take_solution(
    samples: Array, normals: Array, albedo: Array, confidence: Array, weights: Array, found: Array
) -> None:
    """Put what a solver of plain arrays found into blocks, as `deliver` wants it.

    Parameters
    ----------
    samples : (S, L, SAMPLE) array
        Developed.  Their `TRIAL` becomes the weight that the solver says.
    normals, albedo, confidence, weights : (h, w, 3), (h, w), (h, w), (L, h, w) float32 arrays
        See `nlights_core.algorithms.Solution`.
    found : (S, FOUND) array
        Receives the solution, and its residual.
    """
    columns = albedo.shape[1]
    across = (columns + BLOCK - 1) // BLOCK
    for block in range(len(found)):
        row, column = block // across, block % across * BLOCK
        of = found[block]
        # Also past the end of a row, where no pixel says anything.
        of[:] = np.float32(np.nan)
        for p in range(min(columns - column, BLOCK)):
            for k in range(3):
                of[NORMAL + k * BLOCK + p] = normals[row, column + p, k]
            of[ALBEDO + p] = albedo[row, column + p]
            of[UNCERTAINTY + p] = confidence[row, column + p]
            total, squares = ZERO, ZERO
            for i in range(len(weights)):
                sample, weight = samples[block, i], weights[i, row, column + p]
                shown = sample[X + p] * of[NORMAL + p] + sample[Y + p] * of[NORMAL + BLOCK + p]
                shown += sample[Z + p] * of[NORMAL + 2 * BLOCK + p]
                missed = sample[VALUE + p] - of[ALBEDO + p] * shown
                sample[TRIAL + p] = weight
                total += weight
                squares += weight * missed * missed if weight > ZERO else ZERO
            of[RESIDUAL + p] = np.sqrt(squares / total) / of[ALBEDO + p]


@inner
def _colour(samples: Array, colours: Array, found: Array, white: np.float32, of: Array) -> None:
    """Albedo (`LIGHT`) and reflection (`INVERSE`) of every channel, number of used lights."""
    # The photographs' light and flat field are done with: of each colour `LIGHT` becomes the sum of w s I, s being
    # the shading, and `INVERSE` the sum of I over all lights, used or not.
    for k in range(LIGHT, SCRATCH):
        of[k] = ZERO
    for p in range(BLOCK):
        of[_TOTAL + p], of[_UPWARD + p], of[_USED + p] = ZERO, ZERO, ZERO
    for i in range(len(samples)):
        sample, image = samples[i], colours[i]
        for p in range(BLOCK):
            shading = sample[X + p] * found[NORMAL + p] + sample[Y + p] * found[NORMAL + BLOCK + p]
            shading += sample[Z + p] * found[NORMAL + 2 * BLOCK + p]
            used = sample[TRIAL + p] > ZERO
            shading = shading if used else ZERO
            share = sample[TRIAL + p] * shading
            of[_TOTAL + p] += share * shading
            of[_UPWARD + p] += sample[Z + p]
            of[_USED + p] += ONE if used else ZERO
            red, green, blue = image[p], image[BLOCK + p], image[2 * BLOCK + p]
            of[LIGHT + p] += share * red
            of[LIGHT + BLOCK + p] += share * green
            of[LIGHT + 2 * BLOCK + p] += share * blue
            of[INVERSE + p] += red
            of[INVERSE + BLOCK + p] += green
            of[INVERSE + 2 * BLOCK + p] += blue
    for p in range(BLOCK):
        known = of[_TOTAL + p] > ZERO
        # Least squares with the normal known: sum of w s I over that of w s^2; NaN where no light was used.
        per_total = white / of[_TOTAL + p] if known else np.float32(np.nan)
        per_upward = white / of[_UPWARD + p]
        red, green, blue = (
            of[LIGHT + p] * per_total,
            of[LIGHT + BLOCK + p] * per_total,
            of[LIGHT + 2 * BLOCK + p] * per_total,
        )
        of[INVERSE + p] = of[INVERSE + p] * per_upward - red
        of[INVERSE + BLOCK + p] = of[INVERSE + BLOCK + p] * per_upward - green
        of[INVERSE + 2 * BLOCK + p] = of[INVERSE + 2 * BLOCK + p] * per_upward - blue
        of[LIGHT + p], of[LIGHT + BLOCK + p], of[LIGHT + 2 * BLOCK + p] = red, green, blue


@inner
def _put(planes: Array, pixels: Array) -> None:
    """Interleave the planes of a block into pixels (n, C)."""
    size, channels = pixels.shape
    if channels == 3:
        line = pixels.reshape(3 * size)
        for p in range(size):
            line[3 * p], line[3 * p + 1] = planes[p], planes[BLOCK + p]
            line[3 * p + 2] = planes[2 * BLOCK + p]
    else:
        copy(planes, pixels.reshape(size))


@inner
def _count(numbers: Array, out: Array) -> None:
    """Write counts as bytes."""
    for p in range(len(out)):
        out[p] = np.uint8(min(numbers[p], np.float32(255)))


@cache
def strip_solver(kernel_name: Kernel) -> Callable[..., None]:
    """Make the loop that develops and solves strips as one of the kernels does.

    Returns
    -------
    callable
        ``(strip, optics, shadow, lit, limits, white, blocks, work, images)``: the first four and ``blocks`` as for
        `develop`; ``white`` as for `deliver`; ``work`` with the samples of ``blocks``; ``images`` receive the
        strip.
    """
    fit = FITS[kernel_name]

    def solve_strip(
        strip: Strip,
        optics: Optics,
        shadow: np.float32,
        lit: np.float32,
        limits: Limits,
        white: np.float32,
        blocks: Blocks,
        work: Work,
        images: Images,
    ) -> None:
        across = (len(strip.x) + BLOCK - 1) // BLOCK
        # All of a strip's blocks at once would not stay in the processor's cache: as many as ``work`` has room for.
        for first in range(0, len(strip.y) * across, len(work.samples)):
            develop(strip, optics, first, shadow, lit, blocks)
            fit(work, limits)
            solve_blocks(work, limits.condition)
            deliver(blocks, work.found, first, white, images)

    solve_strip.__qualname__ = f"solve_strip.{kernel_name}"  # by which it is found again
    return kernel(solve_strip)
