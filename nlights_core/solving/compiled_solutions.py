"""Compiled solutions: pixels become blocks, and the fits of blocks normals, albedo and uncertainty.

See `nlights_core.solving.compiled_fits` for the blocks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numba
import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.frames import Array
from nlights_core.photographs.blocks import (
    BLOCK,
    ONE,
    SAMPLE,
    TRIAL,
    USABLE,
    VALUE,
    ZERO,
    X,
    Y,
    Z,
    inner,
    kernel,
)
from nlights_core.solving.compiled_choices import FITS
from nlights_core.solving.compiled_fits import (
    DETERMINANT,
    MATRIX,
    SCALED,
    Work,
    solve_exactly,
    sure_determinant,
)
from nlights_core.solving.least_squares import COVERING, FORESEEN
from nlights_core.solving.rules import Kernel, Limits

# Of a solution, in an array (FOUND,):
NORMAL, ALBEDO, UNCERTAINTY, RESIDUAL = 0, 3 * BLOCK, 4 * BLOCK, 5 * BLOCK
FOUND = 6 * BLOCK
"""Unit normal; albedo; uncertainty, degrees; weighted rms residual as a share of the albedo; size."""

_FORESEEN, _PHOTONS = np.float32(FORESEEN), np.float32(PHOTONS)
_DEGREES = np.float32(np.degrees(COVERING) / np.sqrt(2))
_NAN = np.float32(np.nan)


@inner
def mark_usable(work: Work, shadow: np.float32) -> None:
    """Leave out what is not finite or in shadow: value and weights 0.

    Parameters
    ----------
    work : Work
        Its samples have `VALUE` and `USABLE` as given; `TRIAL` is set too.
    shadow : float32
        As `nlights_core.solving.least_squares.lit` has it.
    """
    # Of each pixel the brightest value that is known: a shadow can be told only after all lights were seen.
    samples, brightest = work.samples, work.rows[0]
    for block in range(len(samples)):
        brightest[:] = -np.inf
        for i in range(samples.shape[1]):
            of = samples[block, i]
            for p in range(BLOCK):
                value = of[VALUE + p]
                # NaN and infinity less themselves are not 0.
                known = (of[USABLE + p] > ZERO) & (value - value == ZERO)
                of[VALUE + p] = value if known else ZERO
                of[USABLE + p] = of[USABLE + p] if known else ZERO
                brightest[p] = max(brightest[p], value if known else np.float32(-np.inf))
        for i in range(samples.shape[1]):
            of = samples[block, i]
            for p in range(BLOCK):
                # ``|`` and ``&`` do not branch, as ``or`` and ``and`` would: so the loop becomes vector instructions.
                shown = (of[VALUE + p] > shadow * brightest[p]) | (shadow == ZERO)
                of[VALUE + p] = of[VALUE + p] if shown else ZERO
                weight = of[USABLE + p] if shown else ZERO
                of[USABLE + p] = weight
                of[TRIAL + p] = weight


@inner
def load(images: Array, lights: Array, weights: Array, start: int, shadow: np.float32, work: Work) -> None:
    """Put pixels into blocks, those past the end with weight 0, and tell which are usable.

    Parameters
    ----------
    images, weights : (L, n) float32 arrays
    lights : (L, n, 3) or (L, 1, 3) float32 array
    start : int
        The first pixel.
    shadow : float32
        As for `mark_usable`.
    work : Work
        Receives them.
    """
    samples = work.samples
    shared = lights.shape[1] == 1
    for block in range(len(samples)):
        first = start + block * BLOCK
        size = min(max(images.shape[1] - first, 0), BLOCK)
        for i in range(len(images)):
            of = samples[block, i]
            for p in range(size):
                of[VALUE + p] = images[i, first + p]
                of[USABLE + p] = weights[i, first + p]
            if shared:
                of[X : X + size], of[Y : Y + size], of[Z : Z + size] = lights[i, 0]
            else:
                rays = lights[i, first : first + size]
                for p in range(size):
                    of[X + p], of[Y + p], of[Z + p] = rays[p, 0], rays[p, 1], rays[p, 2]
            # Past the end everything is 0, weights too: such pixels are worked on like the others and never written.
            for k in range(0, SAMPLE, BLOCK):
                of[k + size : k + BLOCK] = ZERO
    mark_usable(work, shadow)


@inner
def solve_blocks(work: Work, condition: float) -> None:
    """Normals, albedo and uncertainty of all blocks.

    Parameters
    ----------
    work : Work
        With the fits of `nlights_core.solving.compiled_choices.FITS`.  `TRIAL` of a sample becomes 0 where
        the normal is not known; ``found`` receives the solution, NaN where not known.
    condition : float
        As for `nlights_core.solving.least_squares.fit`.
    """
    sure = sure_determinant(condition)
    # Nobody needs the gathered pixels' fit (`work.fit`) any more: four of its rows become those of `_sums`.
    samples, fits, found, rows = work.samples, work.fits, work.found, work.fit
    for block in range(len(samples)):
        of, fit = samples[block], fits[block]
        _sums(of, fit, rows)
        for p in range(BLOCK):
            # Only few pixels are badly determined; for them single precision says neither whether nor what.
            if not (rows[p] >= 3 and fit[DETERMINANT + p] > sure):
                _solve_pixel_exactly(of, fit, p, condition)
                _sum_pixel(of, fit, rows, p)
        _finish(fit, rows, found[block])
        # The first row, done with, becomes a mark: 1 where the normal is known.
        for p in range(BLOCK):
            rows[p] = ONE if found[block, ALBEDO + p] > ZERO else ZERO
        for i in range(len(of)):
            light = of[i]
            for p in range(BLOCK):
                light[TRIAL + p] = light[TRIAL + p] if rows[p] > ZERO else ZERO


@numba.njit(inline="always")
def _add(of: Array, fit: Array, rows: Array, p: int) -> None:
    """Add one sample to the sums that the uncertainty is made of."""
    weight = of[TRIAL + p]
    shown = of[X + p] * fit[SCALED + p] + of[Y + p] * fit[SCALED + BLOCK + p]
    shown += of[Z + p] * fit[SCALED + 2 * BLOCK + p]
    missed = of[VALUE + p] - shown
    # Rows: number of used lights; sums of w, of w times the prediction, and of w times the squared residual.
    rows[p] += ONE if weight > ZERO else ZERO
    rows[BLOCK + p] += weight
    rows[2 * BLOCK + p] += weight * shown
    rows[3 * BLOCK + p] += weight * missed * missed


@inner
def _sums(samples: Array, fit: Array, rows: Array) -> None:
    """Number of lights, and sums over them of w, w times what the fit shows, w missed^2."""
    for k in range(4 * BLOCK):
        rows[k] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            _add(of, fit, rows, p)


@inner
def _sum_pixel(samples: Array, fit: Array, rows: Array, p: int) -> None:
    """`_sums` of one pixel."""
    for k in range(4):
        rows[k * BLOCK + p] = ZERO
    for i in range(len(samples)):
        _add(samples[i], fit, rows, p)


@inner
def _finish(fit: Array, rows: Array, found: Array) -> None:
    """Split fits into normal, albedo, uncertainty and residual; see `least_squares.solution`."""
    for p in range(BLOCK):
        x, y, z = fit[SCALED + p], fit[SCALED + BLOCK + p], fit[SCALED + 2 * BLOCK + p]
        xx, xy, xz = fit[MATRIX + p], fit[MATRIX + BLOCK + p], fit[MATRIX + 2 * BLOCK + p]
        yy, yz, zz = fit[MATRIX + 3 * BLOCK + p], fit[MATRIX + 4 * BLOCK + p], fit[MATRIX + 5 * BLOCK + p]
        albedo = np.sqrt(x * x + y * y + z * z)
        known = (albedo > ZERO) & (albedo < np.float32(np.inf)) & (z > ZERO)
        albedo = albedo if known else _NAN
        x, y, z = x / albedo, y / albedo, z / albedo
        found[NORMAL + p], found[NORMAL + BLOCK + p], found[NORMAL + 2 * BLOCK + p] = x, y, z
        found[ALBEDO + p] = albedo
        # Variance of a sample of weight 1 that photons alone would have: the mean reading over `PHOTONS`.
        foreseen = rows[2 * BLOCK + p] / (rows[BLOCK + p] * _PHOTONS)
        surprise = rows[3 * BLOCK + p] / foreseen
        freedom = max(rows[p] - np.float32(3), ZERO)
        variance = foreseen * (_FORESEEN + surprise) / (_FORESEEN + freedom)
        # The inverse times the normal: what lies along the normal is the albedo's; the rest turns it.
        nx, ny, nz = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
        across = max(xx + yy + zz - (x * nx + y * ny + z * nz), ZERO)
        uncertainty = _DEGREES * np.sqrt(variance * across) / albedo
        found[UNCERTAINTY + p] = uncertainty if known else _NAN
        found[RESIDUAL + p] = np.sqrt(rows[3 * BLOCK + p] / rows[BLOCK + p]) / albedo


@inner
def _solve_pixel_exactly(samples: Array, fit: Array, p: int, condition: float) -> None:
    """Solve one pixel in double precision, by the trial weights or else by all usable samples."""
    if solve_exactly(samples, fit, p, TRIAL, condition):
        return
    differ = False
    for i in range(len(samples)):
        differ |= samples[i, TRIAL + p] != samples[i, USABLE + p]
        samples[i, TRIAL + p] = samples[i, USABLE + p]
    # All usable samples are another attempt only where some of them had been discarded.
    if not (differ and solve_exactly(samples, fit, p, USABLE, condition)):
        for k in range(3):
            fit[SCALED + k * BLOCK + p] = _NAN


@inner
def unload(
    samples: Array,
    found: Array,
    start: int,
    normals: Array,
    albedo: Array,
    confidence: Array,
    weights: Array,
) -> None:
    """Put the pixels of blocks back in their row.

    Parameters
    ----------
    samples, found : arrays
        From `solve_blocks`.
    start : int
        The first pixel.
    normals, albedo, confidence, weights : (n, 3), (n,), (n,), (L, n) float32 arrays
        Receive the solution, see `nlights_core.algorithms.Solution`.
    """
    for block in range(len(found)):
        first = start + block * BLOCK
        size = min(max(len(albedo) - first, 0), BLOCK)
        of = found[block]
        for p in range(size):
            for k in range(3):
                normals[first + p, k] = of[NORMAL + k * BLOCK + p]
            albedo[first + p] = of[ALBEDO + p]
            confidence[first + p] = of[UNCERTAINTY + p]
        for i in range(len(weights)):
            for p in range(size):
                weights[i, first + p] = samples[block, i, TRIAL + p]


@cache
def pixel_solver(kernel_name: Kernel) -> Callable[..., None]:
    """Make the loop that solves pixels as one of the kernels does: only what is asked for is compiled.

    Returns
    -------
    callable
        ``(images, lights, weights, first, last, shadow, limits, work, normals, albedo, confidence, used)``:
        pixels ``first`` to ``last`` of a row; the others as for `load`, `solve_blocks` and `unload`.
    """
    fit = FITS[kernel_name]

    def solve_pixels(
        images: Array,
        lights: Array,
        weights: Array,
        first: int,
        last: int,
        shadow: np.float32,
        limits: Limits,
        work: Work,
        normals: Array,
        albedo: Array,
        confidence: Array,
        used: Array,
    ) -> None:
        for start in range(first, min(last, len(albedo)), len(work.samples) * BLOCK):
            load(images, lights, weights, start, shadow, work)
            fit(work, limits)
            solve_blocks(work, limits.condition)
            unload(work.samples, work.found, start, normals, albedo, confidence, used)

    solve_pixels.__qualname__ = f"solve_pixels.{kernel_name}"  # by which it is found again
    return kernel(solve_pixels)
