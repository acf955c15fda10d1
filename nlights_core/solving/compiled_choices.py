"""Compiled choices: to which of its samples each pixel of a block is fitted, and the fit.

What the normal solvers `progressive` and `rank-trim` say in numpy, over blocks of pixels as
`nlights_core.solving.compiled_fits` has them; and the door to all kernels' fits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, TRIAL, USABLE, VALUE, ZERO, inner
from nlights_core.solving.compiled_fits import (
    DETERMINANT,
    Work,
    count_usable,
    invert_normal_matrices,
    leverage_of,
    normal_equations,
    refine_fits,
    residual_of,
    solve_exactly,
    sure_determinant,
)
from nlights_core.solving.compiled_medians import take_medians
from nlights_core.solving.compiled_reweighting import reweigh_blocks
from nlights_core.solving.rules import Kernel, Limits

_LEAST_REST = np.float32(1e-6)


@inner
def _fit_least_squares(work: Work, limits: Limits) -> None:
    samples, fits = work.samples, work.fits
    for block in range(len(samples)):
        normal_equations(samples[block], fits[block])
        invert_normal_matrices(fits[block])
        refine_fits(samples[block], fits[block])


@inner
def _fit_robustly(work: Work, limits: Limits) -> None:
    samples, fits = work.samples, work.fits
    reweigh_blocks(work)
    for block in range(len(samples)):
        refine_fits(samples[block], fits[block])


@inner
def _fit_progressively(work: Work, limits: Limits) -> None:
    samples, fits = work.samples, work.fits
    for block in range(len(samples)):
        normal_equations(samples[block], fits[block])
        invert_normal_matrices(fits[block])
        _discard(samples[block], fits[block], work.rows, limits.keep, limits.condition)
        refine_fits(samples[block], fits[block])


@inner
def _fit_trimmed(work: Work, limits: Limits) -> None:
    samples, fits = work.samples, work.fits
    for block in range(len(samples)):
        _trim(samples[block], work.rows, limits.darkest, limits.brightest)
        normal_equations(samples[block], fits[block])
        invert_normal_matrices(fits[block])
        refine_fits(samples[block], fits[block])


@inner
def _fit_medians(work: Work, limits: Limits) -> None:
    samples, fits = work.samples, work.fits
    for block in range(len(samples)):
        normal_equations(samples[block], fits[block])
        invert_normal_matrices(fits[block])
        refine_fits(samples[block], fits[block])
        take_medians(samples[block], fits[block], work, limits.condition)


@inner
def _trim(samples: Array, rows: Array, darkest: float, brightest: float) -> None:
    """Trial weights without the darkest and the brightest; see `nlights_core.solving.robust_fitting.trim_by_rank`.

    A sample is at least as bright as the one of a rank if more samples than that are no brighter.
    """
    # Rows: ranks of the first and the last sample that are kept; how many are no brighter than the sample at
    # hand, and how many are darker.  Counts and ranks are whole numbers, which single precision holds exactly.
    first, last, upto, below = rows[0], rows[1], rows[2], rows[3]
    # For the moment the second row holds the number of usable samples.
    count_usable(samples, last)
    for p in range(BLOCK):
        count = np.float64(last[p])
        first[p] = np.float32(np.floor(darkest * count))
        last[p] = np.float32(max(np.floor((1 - brightest) * count) - 1, 0.0))
    for i in range(len(samples)):
        own = samples[i]
        for p in range(BLOCK):
            upto[p], below[p] = ZERO, ZERO
        # Each is compared with all: of a few lights that is cheaper than sorting, which branches.
        for j in range(len(samples)):
            other = samples[j]
            for p in range(BLOCK):
                used = other[USABLE + p] > ZERO
                upto[p] += ONE if used & (other[VALUE + p] <= own[VALUE + p]) else ZERO
                below[p] += ONE if used & (other[VALUE + p] < own[VALUE + p]) else ZERO
        for p in range(BLOCK):
            kept = (upto[p] > first[p]) & (below[p] <= last[p])
            own[TRIAL + p] = own[USABLE + p] if kept else ZERO


@inner
def _discard(samples: Array, fit: Array, rows: Array, keep: int, condition: float) -> None:
    """Discard, one by one, the samples that the others predict worst, until so many are left.

    A discard that would leave badly spread lights is not made.  Whether one is, single precision
    cannot always tell; such pixels are begun anew in double precision.
    """
    # Rows: samples still used; place of the one that goes next, or -1; samples used when single precision last
    # was not sure of the fit, or 0; scratch of `_find_worst`.
    counts, worst, unsure, largest = rows[0], rows[1], rows[2], rows[3]
    sure = sure_determinant(condition)
    count_usable(samples, counts)
    for p in range(BLOCK):
        unsure[p] = ZERO if fit[DETERMINANT + p] > sure else counts[p]
    for _ in range(len(samples) - keep):
        # Which of two alike is worse, the last digits tell.
        refine_fits(samples, fit)
        _find_worst(samples, fit, largest, worst)
        for p in range(BLOCK):
            # A place that no sample has: nothing is discarded.
            worst[p] = worst[p] if counts[p] > keep else -ONE
        for i in range(len(samples)):
            for p in range(BLOCK):
                of = samples[i]
                of[TRIAL + p] = ZERO if worst[p] == i else of[TRIAL + p]
        normal_equations(samples, fit)
        invert_normal_matrices(fit)
        for p in range(BLOCK):
            # Before the count falls: a pixel that has no more than ``keep`` discards nothing, and need not be sure.
            unsure[p] = unsure[p] if fit[DETERMINANT + p] > sure else counts[p]
            counts[p] -= ONE if counts[p] > keep else ZERO
    for p in range(BLOCK):
        if unsure[p] > keep:
            _discard_exactly(samples, fit, p, keep, condition)


@numba.njit(inline="always")
def _deleted_residual(of: Array, fit: Array, p: int) -> Any:
    """Square of what a sample misses, by its weight, when the others predict it."""
    missed = residual_of(of, fit, p) / max(ONE - of[TRIAL + p] * leverage_of(of, fit, p), _LEAST_REST)
    return of[TRIAL + p] * missed * missed


@inner
def _find_worst(samples: Array, fit: Array, largest: Array, worst: Array) -> None:
    """Place of the sample of each pixel that the others predict worst."""
    for p in range(BLOCK):
        # Less than any square, so that the first used sample is taken.
        largest[p], worst[p] = -ONE, ZERO
    for i in range(len(samples)):
        of, which = samples[i], np.float32(i)
        for p in range(BLOCK):
            alone = _deleted_residual(of, fit, p)
            larger = (of[TRIAL + p] > ZERO) & (alone > largest[p])
            worst[p] = which if larger else worst[p]
            largest[p] = alone if larger else largest[p]


@inner
def _discard_exactly(samples: Array, fit: Array, p: int, keep: int, condition: float) -> None:
    """`_discard` of one pixel, every fit in double precision."""
    count = 0
    for i in range(len(samples)):
        samples[i, TRIAL + p] = samples[i, USABLE + p]
        count += 1 if samples[i, USABLE + p] > ZERO else 0
    # Nothing is sure of it, so it is solved exactly in the end too.
    fit[DETERMINANT + p] = ZERO
    known = solve_exactly(samples, fit, p, TRIAL, condition)
    while count > keep:
        worst, largest = 0, -ONE
        for i in range(len(samples) if known else 0):
            alone = _deleted_residual(samples[i], fit, p)
            if samples[i, TRIAL + p] > ZERO and alone > largest:
                worst, largest = i, alone
        weight = samples[worst, TRIAL + p]
        samples[worst, TRIAL + p] = ZERO
        known = solve_exactly(samples, fit, p, TRIAL, condition)
        if not known:
            # Without this sample nothing is determined: it stays, and nobody goes.
            samples[worst, TRIAL + p] = weight
            return
        count -= 1


FITS: dict[Kernel, Callable[[Work, Limits], None]] = {
    "least-squares": _fit_least_squares,
    "robust": _fit_robustly,
    "progressive": _fit_progressively,
    "rank-trim": _fit_trimmed,
    "median-of-triplets": _fit_medians,
}
"""By kernel, how all blocks are fitted; each is compiled only where it is asked for.

``work.samples`` have `VALUE`, `USABLE`, `TRIAL` and the light; `TRIAL` becomes the weight that is used.
``work.fits`` receive `SCALED`, the inverse in `MATRIX`, and `DETERMINANT`.
"""
