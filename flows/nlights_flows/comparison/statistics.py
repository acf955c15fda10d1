"""Statistics of a comparison: bootstrap intervals of paired differences, and ranks with ties.

A quantity is measured for every variant at the same places (tiles, blocks of pixels, lamps).  The
places are drawn with replacement, the same for all variants, and the differences are looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from nlights_core.frames import Array

CONFIDENCE = 0.95
DRAWS = 10_000
SEED = 1
FEWEST = 5
"""Places below which no interval is given."""
FEWEST_ALIKE = 2.0
"""Independent places, of many that are alike, below which none is given: Student's t needs as many."""
_LEAST = 1e-300
"""What a mean counts as that is 0, for its logarithm."""
_TAIL = 10
"""Draws that make a tail's share known."""
_TOGETHER = 1000
"""Draws made at a time, so that the memory stays small."""

Kind = Literal["tiles", "blocks", "lamps"]


@dataclass(frozen=True)
class Sample:
    """One quantity of every variant, at the same places.

    Attributes
    ----------
    values : (G, R, C, K) float64 array
        Positive means at R x C places (neighbours lie together) of each of G groups, for K variants; means
        of squares where ``root`` says so.  NaN where not known.
    weights : (G, R, C) float64 array
        How much each place counts.
    root : bool
        The quantity is the root of the weighted mean (rms), not the mean.
    kind : {"tiles", "blocks", "lamps"}
        What the places are.
    """

    values: Array
    weights: Array
    root: bool
    kind: Kind


@dataclass(frozen=True)
class Difference:
    """Difference of one variant's quantity from another's.

    Attributes
    ----------
    value : float
    interval : (float, float) or None
        95 % interval; None where there are too few independent places.
    p : float or None
        Two-sided probability of so large a difference where there is none; of this pair alone.
    places : float
        Independent places that the interval rests on.
    """

    value: float
    interval: tuple[float, float] | None
    p: float | None
    places: float


@dataclass(frozen=True)
class Analysis:
    """Statistics of a sample.

    Attributes
    ----------
    kind : {"tiles", "blocks", "lamps"}
    places : int
        How many there are.
    values : tuple of float
        The quantity of each variant.
    intervals : tuple of (float, float) or None
        95 % interval of each variant by itself.
    differences : tuple of tuple of Difference
        ``differences[i][j]``: variant i minus variant j.
    ranks : tuple of int or None
        1 for the smallest; equal where not told apart; None where no pair has an interval.
    """

    kind: Kind
    places: int
    values: tuple[float, ...]
    intervals: tuple[tuple[float, float] | None, ...]
    differences: tuple[tuple[Difference, ...], ...]
    ranks: tuple[int, ...] | None

    @property
    def best(self) -> int:
        """The variant of the smallest value, whether it is told apart or not."""
        return int(np.argmin(self.values))

    @property
    def winners(self) -> tuple[int, ...]:
        """The variants of rank 1, where some other is told apart from the best; else none."""
        if self.ranks is None or max(self.ranks) == 1:
            return ()
        return tuple(i for i, rank in enumerate(self.ranks) if rank == 1)


def analyse(sample: Sample, *, draws: int = DRAWS, seed: int = SEED) -> Analysis:
    """Estimate every variant's quantity, all differences, and the ranks.

    Parameters
    ----------
    sample : Sample
        At least one place must be known for all variants.
    draws, seed : int
        Of the bootstrap.

    Returns
    -------
    Analysis

    Notes
    -----
    Errors are positive and differ most where all variants find it hard, so the logarithm of the
    ratio of two variants' quantities is looked at; its interval times the other's quantity is the
    interval of the difference.  Percentile intervals of the paired bootstrap [1]_ are widened for n
    places by sqrt(n / (n - 1)) t / z, with z of the normal and t of Student's distribution of n - 1
    degrees of freedom, for the reasons of [2]_.  Neighbouring blocks resemble each other; with the
    correlation r of neighbours a mean over a lattice spreads (1 + r) / (1 - r) times more than over
    independent places, and n places count as n ((1 - r) / (1 + r))^2.  The probabilities of all
    pairs are corrected by Holm [3]_.

    References
    ----------
    .. [1] B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13.
    .. [2] T. Hesterberg, What teachers should know about the bootstrap, Am. Stat. 69, 2015.
    .. [3] S. Holm, A simple sequentially rejective multiple test procedure, Scand. J. Stat. 6, 1979.
    """
    known = np.isfinite(sample.values).all(axis=-1) & (sample.weights > 0)
    if not known.any():
        raise ValueError("analyse: no place is known for all variants")
    values, weights = sample.values[known], sample.weights[known]
    count, variants = values.shape
    means = weights @ values / weights.sum()
    power = 0.5 if sample.root else 1.0
    # How much each place moves the quantity, as far as places differ.
    slope = power * np.maximum(means, _LEAST) ** (power - 1)
    influence = np.full(sample.values.shape, np.nan)
    influence[known] = (values - means) * slope * (weights / weights.mean())[:, None]
    resampled = None
    if count >= FEWEST:
        resampled = power * (_logarithms(_resampled(values, weights, draws, seed)) - _logarithms(means))
    found = means**power
    pairs = [
        [_difference(found, influence, resampled, i, j) for j in range(variants)] for i in range(variants)
    ]
    differences = tuple(tuple(row) for row in pairs)
    return Analysis(
        sample.kind,
        count,
        tuple(float(v) for v in found),
        tuple(_difference(found, influence, resampled, i, None).interval for i in range(variants)),
        differences,
        _ranks(values, found, differences),
    )


def _logarithms(values: Array) -> Array:
    return np.asarray(np.log(np.maximum(values, _LEAST)))


def _difference(found: Array, influence: Array, resampled: Array | None, i: int, j: int | None) -> Difference:
    """Variant i minus variant j; without j, variant i itself."""
    one = np.zeros(len(found))
    one[i] += 1
    if j is not None:
        one[j] -= 1
    base = found[i] if j is None else found[j]
    value = float(found[i] - (0 if j is None else found[j]))
    r = neighbour_correlation(influence @ one)
    places = influence[..., 0][np.isfinite(influence[..., 0])].size * ((1 - r) / (1 + r)) ** 2
    if resampled is None or places < FEWEST_ALIKE:
        return Difference(value, None, None, places)
    spread = resampled @ one * (1 + r) / (1 - r)
    if j is None:
        low, high = base * np.exp(_interval(0.0, spread, places))
        return Difference(value, (float(low), float(high)), None, places)
    ratio = float(_logarithms(found[i]) - _logarithms(found[j]))
    low, high = base * np.expm1(_interval(ratio, spread, places))
    return Difference(value, (float(low), float(high)), _probability(ratio, spread, places), places)


def _resampled(values: Array, weights: Array, draws: int, seed: int) -> Array:
    """The weighted mean of each variant in every draw of the places, (draws, K)."""
    random = np.random.default_rng(seed)
    count = len(values)
    parts = []
    for start in range(0, draws, _TOGETHER):
        size = min(_TOGETHER, draws - start)
        drawn = random.multinomial(count, np.full(count, 1 / count), size=size) * weights
        parts.append(drawn @ values / drawn.sum(axis=1, keepdims=True))
    return np.concatenate(parts)


def neighbour_correlation(field: Array) -> float:
    """Correlation of neighbouring places, from 0 to 0.99.

    Parameters
    ----------
    field : (G, R, C) array
        Neighbours along the last two axes; NaN where not known.

    Returns
    -------
    float
        0 where there are no neighbours, and where they are unlike each other.
    """
    centred = field - np.mean(field[np.isfinite(field)])
    variance = float(np.nanmean(centred**2))
    pairs = np.concatenate(
        [(centred[:, 1:] * centred[:, :-1]).ravel(), (centred[:, :, 1:] * centred[:, :, :-1]).ravel()]
    )
    pairs = pairs[np.isfinite(pairs)]
    if not pairs.size or variance <= 0:
        return 0.0
    return float(np.clip(pairs.mean() / variance, 0, 0.99))


def _widening(places: float) -> float:
    """Factor by which few places widen a standard deviation that was estimated from them."""
    return float(np.sqrt(places / (places - 1)))


def _interval(value: float, spread: Array, places: float) -> Array:
    """Percentile interval (2,) around a value, widened for few places."""
    from scipy.stats import norm, t

    tail = (1 - CONFIDENCE) / 2
    wider = _widening(places) * t.ppf(tail, places - 1) / norm.ppf(tail)
    return np.asarray(value + wider * np.quantile(spread, [tail, 1 - tail]))


def _probability(value: float, spread: Array, places: float) -> float:
    """Two-sided probability that belongs to `_interval`."""
    from scipy.stats import norm, t

    if value == 0:
        return 1.0
    beyond = np.count_nonzero((value + spread) * np.sign(value) <= 0)
    # Of a tail that no draw reached, only its distance is known.
    z = norm.isf(beyond / len(spread)) if beyond >= _TAIL else abs(value) / max(spread.std(), 1e-300)
    return float(min(1.0, 2 * t.sf(z / _widening(places), places - 1)))


def holm(probabilities: Sequence[float]) -> list[float]:
    """Probabilities of several comparisons, corrected for their number.

    Examples
    --------
    >>> [round(p, 6) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    order = np.argsort(probabilities)
    corrected = np.empty(len(order))
    largest = 0.0
    for i, place in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - i) * probabilities[place]))
        corrected[place] = largest
    return [float(p) for p in corrected]


def _ranks(values: Array, found: Array, differences: Any) -> tuple[int, ...] | None:
    """Ranks by the quantity found; a variant shares the rank of the best from which it is not told apart."""
    count = len(found)
    # Variants that made the very same are one: comparing them twice is no second comparison.
    same = [next(j for j in range(count) if np.array_equal(values[:, i], values[:, j])) for i in range(count)]
    pairs = [(i, j) for i in sorted(set(same)) for j in sorted(set(same)) if j < i]
    tested = [(i, j) for i, j in pairs if differences[i][j].p is not None]
    if pairs and not tested:
        return None
    corrected = holm([differences[i][j].p for i, j in tested])
    apart = {frozenset(pair) for pair, p in zip(tested, corrected, strict=True) if p < 1 - CONFIDENCE}
    ranks = np.zeros(count, int)
    left = [int(i) for i in np.argsort(found, kind="stable")]
    while left:
        first = same[left[0]]
        group = [i for i in left if frozenset((same[i], first)) not in apart]
        ranks[group] = count - len(left) + 1
        left = [i for i in left if i not in group]
    return tuple(int(rank) for rank in ranks)
