"""Compiled reweighting: what `nlights_core.solving.robust_fitting` says in numpy, over blocks of pixels.

See `nlights_core.solving.compiled_fits` for the blocks.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, SAMPLE, TRIAL, USABLE, ZERO, copy, inner
from nlights_core.solving.compiled_fits import (
    DETERMINANT,
    FIT,
    MATRIX,
    SCALED,
    Work,
    add_sample,
    count_usable,
    invert_normal_matrices,
    leverage_of,
    normal_equations,
    residual_of,
)
from nlights_core.solving.robust_fitting import (
    ABSOLUTE_ROUNDS,
    BIWEIGHT_ROUNDS,
    DARKEST,
    FEW,
    FEWEST,
    MODEL_ERROR,
    SUSPICIOUS,
    TUKEY,
)

_PHOTONS, _DARKEST = np.float32(PHOTONS), np.float32(DARKEST)
_MODEL_VARIANCE = np.float32(MODEL_ERROR**2)
_SUSPICIOUS = np.float32(SUSPICIOUS**2)
_TUKEY, _SMALLEST_REST = np.float32(TUKEY), np.float32(0.01)


@numba.njit(inline="always")
def _albedo_squared(fit: Array, p: int) -> Any:
    x, y, z = fit[SCALED + p], fit[SCALED + BLOCK + p], fit[SCALED + 2 * BLOCK + p]
    return x * x + y * y + z * z


@inner
def find_doubtful(samples: Array, fit: Array, worst: Array, counts: Array, chosen: Array) -> int:
    """Find the pixels in which least squares are contradicted by a sample.

    Parameters
    ----------
    samples, fit : arrays
        The fit with all usable samples.
    worst, counts : (BLOCK,) arrays
        Scratch.
    chosen : (BLOCK,) int array
        Receives the pixels.

    Returns
    -------
    int
        How many they are.
    """
    for p in range(BLOCK):
        # The largest squared residual in units of its variance, and the number of usable samples.
        worst[p] = ZERO
        counts[p] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            squared = _albedo_squared(fit, p)
            weight = of[USABLE + p]
            # The variance times the weight: so an unused sample needs no division by 0.
            variance = _photon_variance(squared) + weight * _MODEL_VARIANCE * squared
            missed = residual_of(of, fit, p)
            surprise = missed * missed * weight / variance
            worst[p] = surprise if surprise > worst[p] else worst[p]
            counts[p] += ONE if weight > ZERO else ZERO
    found = 0
    for p in range(BLOCK):
        if worst[p] > _SUSPICIOUS and counts[p] >= FEWEST and _albedo_squared(fit, p) > ZERO:
            chosen[found] = p
            found += 1
    return found


@numba.njit(inline="always")
def _photon_variance(squared: Any) -> Any:
    """Variance of a sample of weight 1 at an albedo whose square is given."""
    return squared / (max(np.sqrt(squared), _DARKEST) * _PHOTONS)


@inner
def reweigh_by_biweight(samples: Array, fit: Array, noise: Array, rows: Array, quantiles: Array) -> None:
    """Trial weights by Tukey's biweight about the L1 fit; see `robust_fitting.reweigh`.

    Parameters
    ----------
    samples, fit : arrays
        The least-squares fit of doubtful pixels; at the end `MATRIX` and `RIGHT` hold the normal
        equations with the weights that were found.
    noise : (3, L, BLOCK) array
        Scratch: inverse of the standard deviation of each sample, and residuals in its units.
    rows : (10, BLOCK) array
        Scratch.
    quantiles : (L + 1,) array
        By the number of usable lights, the quantile of `robust_fitting.scale_quantiles`.
    """
    # Of each sample: one over its expected standard deviation; its residual, in units of that, from the L1 fit,
    # later from the best one; and from the fit without the worst sample.
    precision, missed, other = noise[0], noise[1], noise[2]
    # Rows: scale of the residuals, and of those without the worst sample; albedo times normal by least squares.
    # Rows 5 and 6 are for `_fit_without_worst`, 7 to 9 for `_estimate_scales`.
    scale, other_scale, start = rows[0], rows[1], rows[2:5]
    for k in range(3):
        copy(fit[SCALED + k * BLOCK : SCALED + (k + 1) * BLOCK], start[k])
    # Once, from the least-squares fit: all rounds measure residuals in the same units.
    _compute_precision(samples, fit, precision)
    for _ in range(ABSOLUTE_ROUNDS):
        _least_absolute_step(samples, fit, precision)
        invert_normal_matrices(fit)
    _standardise_residuals(samples, fit, precision, missed)
    _estimate_scales(samples, missed, quantiles, scale, rows[7:])
    if len(samples) <= FEW:
        _fit_without_worst(samples, fit, precision, start, rows[5], rows[6])
        _standardise_residuals(samples, fit, precision, other)
        _estimate_scales(samples, other, quantiles, other_scale, rows[7:])
        _keep_better(missed, other, scale, other_scale)
    for p in range(BLOCK):
        # From here on the first row is one over the residual at which a weight becomes 0.
        scale[p] = ONE / (_TUKEY * max(scale[p], ONE))
    _biweigh(samples, missed, scale)
    for _ in range(BIWEIGHT_ROUNDS - 1):
        normal_equations(samples, fit)
        invert_normal_matrices(fit)
        _standardise_residuals(samples, fit, precision, missed)
        _biweigh(samples, missed, scale)
    normal_equations(samples, fit)


@inner
def _compute_precision(samples: Array, fit: Array, precision: Array) -> None:
    """Inverse of the standard deviation that each sample is expected to have; 0 if not used."""
    for i in range(len(samples)):
        of, out = samples[i], precision[i]
        for p in range(BLOCK):
            squared = _albedo_squared(fit, p)
            weight = of[USABLE + p]
            variance = _photon_variance(squared) + weight * _MODEL_VARIANCE * squared
            out[p] = np.sqrt(weight / variance)


@inner
def _least_absolute_step(samples: Array, fit: Array, precision: Array) -> None:
    """Normal equations with weights that make squares of residuals absolute ones."""
    for k in range(MATRIX, DETERMINANT):
        fit[k] = ZERO
    for i in range(len(samples)):
        of, expected = samples[i], precision[i]
        for p in range(BLOCK):
            # Below one standard deviation squares are kept: so weights stay finite.
            of[TRIAL + p] = of[USABLE + p] / max(abs(residual_of(of, fit, p)) * expected[p], ONE)
            add_sample(of, fit, p)


@inner
def _standardise_residuals(samples: Array, fit: Array, precision: Array, missed: Array) -> None:
    """Absolute residuals in units of the expected noise; infinite where a sample is not used."""
    for i in range(len(samples)):
        of, expected, out = samples[i], precision[i], missed[i]
        for p in range(BLOCK):
            surprise = abs(residual_of(of, fit, p)) * expected[p]
            out[p] = surprise if of[USABLE + p] > ZERO else np.float32(np.inf)


@inner
def _estimate_scales(samples: Array, missed: Array, quantiles: Array, scale: Array, rows: Array) -> None:
    """Robust scale of the residuals of an L1 fit, as `robust_fitting` has it.

    The bits of numbers that are not negative are ordered like the numbers.  So the one of a given
    rank is found bit by bit, from the highest: a bit is set if fewer than that many numbers are
    below what would result.
    """
    # The same memory as whole numbers: the bits that are found are the scale.
    bits, found = missed.view(np.int32), scale.view(np.int32)
    # Rows: number of usable samples; rank of the median of those that a fit of three unknowns does not make
    # vanish; how many samples are below the number on trial.  Unused samples, infinite, come last.
    counts, ranks, below = rows[0], rows[1].view(np.int32), rows[2].view(np.int32)
    count_usable(samples, counts)
    for p in range(BLOCK):
        found[p] = 0
        ranks[p] = (np.int32(counts[p]) + 4) >> 1
    # Bit 31 is the sign, which no absolute value has.
    for shift in range(30, -1, -1):
        bit = np.int32(1 << shift)
        for p in range(BLOCK):
            below[p] = 0
        for i in range(len(samples)):
            of_light = bits[i]
            for p in range(BLOCK):
                below[p] += of_light[p] < (found[p] | bit)
        for p in range(BLOCK):
            found[p] = found[p] | (bit if below[p] < ranks[p] else np.int32(0))
    for p in range(BLOCK):
        scale[p] /= quantiles[np.int64(counts[p])]


@inner
def _fit_without_worst(
    samples: Array, fit: Array, precision: Array, start: Array, largest: Array, worst: Array
) -> None:
    """Fit without the sample whose absence lets the sum of squares fall most."""
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            of[TRIAL + p] = of[USABLE + p]
    for p in range(BLOCK):
        largest[p] = -ONE
        worst[p] = -ONE
    normal_equations(samples, fit)
    invert_normal_matrices(fit)
    # The inverse gives the leverages; the residuals are those of the fit that was begun with.
    for k in range(3):
        copy(start[k], fit[SCALED + k * BLOCK : SCALED + (k + 1) * BLOCK])
    for i in range(len(samples)):
        of, expected, which = samples[i], precision[i], np.float32(i)
        for p in range(BLOCK):
            own = leverage_of(of, fit, p)
            surprise = residual_of(of, fit, p) * expected[p]
            # By so much the sum of squares falls without the sample: its square over 1 - leverage.
            fall = surprise * surprise / max(ONE - of[USABLE + p] * own, _SMALLEST_REST)
            worst[p] = which if fall > largest[p] else worst[p]
            largest[p] = fall if fall > largest[p] else largest[p]
    for i in range(len(samples)):
        of, which = samples[i], np.float32(i)
        for p in range(BLOCK):
            of[TRIAL + p] = ZERO if worst[p] == which else of[USABLE + p]
    normal_equations(samples, fit)
    invert_normal_matrices(fit)


@inner
def _keep_better(missed: Array, other: Array, scale: Array, other_scale: Array) -> None:
    """Take the residuals of the smaller scale."""
    for i in range(len(missed)):
        one, another = missed[i], other[i]
        for p in range(BLOCK):
            one[p] = another[p] if other_scale[p] < scale[p] else one[p]
    for p in range(BLOCK):
        scale[p] = other_scale[p] if other_scale[p] < scale[p] else scale[p]


@inner
def _biweigh(samples: Array, missed: Array, per_reach: Array) -> None:
    """Trial weights by Tukey's biweight of residuals; ``per_reach``: 1 over where it ends."""
    for i in range(len(samples)):
        of, surprise = samples[i], missed[i]
        for p in range(BLOCK):
            share = surprise[p] * per_reach[p]
            # An unused sample is infinitely surprising; nothing is left of it.
            rest = max(ONE - share * share, ZERO)
            of[TRIAL + p] = of[USABLE + p] * rest * rest


@inner
def reweigh_blocks(work: Work) -> None:
    """Fit all blocks by least squares, and what those cannot explain by `reweigh_by_biweight`.

    Parameters
    ----------
    work : Work
        As for `nlights_core.solving.compiled_choices.fit_blocks`.
    """
    samples, fits, rows = work.samples, work.fits, work.rows
    # Block and place in it of each pixel that waits to be gathered; doubtful pixels of the block at hand.
    which, chosen, fewer = work.places[0], work.places[1], work.places[2]
    waiting = np.int64(0)  # a plain 0 is a constant to the compiler, for which it would compile another copy
    for block in range(len(samples)):
        normal_equations(samples[block], fits[block])
        invert_normal_matrices(fits[block])
        found = find_doubtful(samples[block], fits[block], rows[0], rows[1], fewer)
        # Mostly a few pixels of a block are doubtful, and are gathered; where it is more than half, copying costs
        # more than working on all of the block.
        if found > BLOCK // 2:
            reweigh_by_biweight(samples[block], fits[block], work.noise, rows, work.quantiles)
            _undo_others(samples[block], fits[block], fewer[:found], rows[0])
            continue
        for k in range(found):
            which[waiting], chosen[waiting] = block, fewer[k]
            waiting += 1
            if waiting == BLOCK:
                _reweigh(work, waiting)
                waiting = np.int64(0)
    if waiting:
        _reweigh(work, waiting)


@inner
def _reweigh(work: Work, size: Any) -> None:
    """Collect pixels from their blocks into one, solve them by `reweigh_by_biweight`, and return them."""
    samples, fits, some, fit = work.samples, work.fits, work.some, work.fit
    # Places from ``size`` on keep pixels of before: they are finite, worked on and not returned.
    for q in range(size):
        block, p = work.places[0, q], work.places[1, q]
        for i in range(len(some)):
            for k in range(0, SAMPLE, BLOCK):
                some[i, k + q] = samples[block, i, k + p]
        for k in range(0, FIT, BLOCK):
            fit[k + q] = fits[block, k + p]
    reweigh_by_biweight(some, fit, work.noise, work.rows, work.quantiles)
    # The biweight leaves normal equations behind; their blocks want solutions.
    invert_normal_matrices(fit)
    for q in range(size):
        block, p = work.places[0, q], work.places[1, q]
        for i in range(len(some)):
            samples[block, i, TRIAL + p] = some[i, TRIAL + q]
        for k in range(0, FIT, BLOCK):
            fits[block, k + p] = fit[k + q]


@inner
def _undo_others(samples: Array, fit: Array, chosen: Array, others: Array) -> None:
    """Give all pixels but the chosen ones their usable weights back, and solve."""
    others[:] = ONE
    for p in chosen:
        others[p] = ZERO
    for i in range(len(samples)):
        of = samples[i]
        for p in range(BLOCK):
            of[TRIAL + p] = of[USABLE + p] if others[p] > ZERO else of[TRIAL + p]
    normal_equations(samples, fit)
    invert_normal_matrices(fit)
