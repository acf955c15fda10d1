"""A smooth bend from scattered points: a Gaussian process whose widths the points themselves tell.

The model of a point at (x, y) is ``value = constant + tilt (x, y) + bend(x, y) + error``.  The
constant is free, and where asked the tilt is; else it has a prior as the bend has.  The bend's
covariance is Matern's of order 5/2, so that what it may do at a wavelength falls with about its 3.5th
power: photographs bend a height slowly or not at all, since lamps and flats are smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from nlights_core.frames import Array
from nlights_core.integration.known_heights import least_absolute

WIDTHS = tuple(0.001 * 2.0**k for k in range(16))
"""Standard deviations of bend and tilt that are tried, mm: 0.001 to 33."""

LENGTHS = (0.25, 0.5, 1.0, 2.0)
"""Lengths of correlation that are tried, of the field's longer side."""

FACTORS = (1.0, 2.0, 4.0, 8.0, 32.0, 128.0)
"""By how much the stated uncertainties are tried to be too small."""

EXPECTED, DECADES = 0.1, np.log(4.0)
"""Bend that is expected of photographs, mm, and how far off it may be (its logarithm's standard deviation): on
simulated troubles it was a few hundredths to half a millimetre."""

TOO_MUCH = 8.0
"""Factor above which points and stated uncertainties do not belong together."""

LIMIT = 4.5
"""Standard deviations by which a point may differ from what the others say of it."""

ODD = np.log(0.02 / 10.0)
"""What leaving a point out costs, as a logarithm of probability: 2 in 100 are odd, anywhere in 10 mm."""


@dataclass(frozen=True)
class Widths:
    """Widths of the model.

    Attributes
    ----------
    bend, tilt : float
        Standard deviations of the bend, and of the tilt at half the field's longer side, mm.
    length : float
        Length of correlation, of the field's longer side.
    factor : float
        What the stated uncertainties are multiplied by.
    """

    bend: float = EXPECTED
    tilt: float = EXPECTED
    length: float = 1.0
    factor: float = 1.0

    def prior(self, free: bool) -> float:
        """Logarithm of how likely these widths are beforehand."""
        # Of an error of the light the slope is likely to be so large, whatever its length: a quick bend is lower.
        widths = (
            (self.bend / min(self.length, 1.0),) if free else (self.bend / min(self.length, 1.0), self.tilt)
        )
        off = sum((np.log(width / EXPECTED) / DECADES) ** 2 for width in widths)
        # Stated uncertainties are believed rather than not, and slow bends are likelier than quick ones.
        return -0.5 * float(off + np.log2(self.length) ** 2) - 2.0 * float(np.log2(self.factor))

    def covariance(self, first: Array, second: Array, free: bool) -> Array:
        """Covariance of bend and tilt between points (N, 2) and (M, 2), in units of the longer side."""
        apart = np.sqrt(5.0) / self.length * np.linalg.norm(first[:, None] - second[None], axis=2)
        found = np.asarray(self.bend**2 * (1 + apart + apart**2 / 3) * np.exp(-apart))
        return found if free else np.asarray(found + 4 * self.tilt**2 * (first @ second.T))


@dataclass(frozen=True)
class Bend:
    """A bend that was found.

    Attributes
    ----------
    places : (N, 2) float64 array
        Of the points that had a say, in units of the field's longer side.
    strengths : (N,) float64 array
        What each adds of the covariance with it.
    projection : (N, N) float64 array
        Inverse covariance of the points, the free terms taken out.
    widths : Widths
    free : bool
        Whether the tilt was free, and so is no part of this.
    used : (P,) bool array
        Which of the given points had a say.
    evidence : float
        Logarithm of the probability of the points that had a say.
    settled : bool
        Whether all of these agree; else more than a quarter of the points would have to go, or their
        uncertainties would have to be more than `TOO_MUCH` times as large.
    """

    places: Array
    strengths: Array
    projection: Array
    widths: Widths
    free: bool
    used: Array
    evidence: float
    settled: bool = True

    def at(self, places: Array) -> Array:
        """Bend and tilt at places (M, 2) in units of the longer side, (M,) float64 mm."""
        return np.asarray(self.widths.covariance(places, self.places, self.free) @ self.strengths)

    def left(self, places: Array, values: Array) -> Array:
        """Values less what was found and the free terms, (P,) float64 mm, at the places that it was found from."""
        off = values - self.at(places)
        terms = _free_terms(places, self.free)
        return np.asarray(off - terms @ least_absolute(terms[self.used], off[self.used]))

    def doubt(self, places: Array) -> tuple[Array, Array]:
        """Standard uncertainty of `at` after the best constant, and what it was beforehand, (M,) each, mm."""
        before = self.widths.covariance(places, places, self.free)
        cross = self.widths.covariance(places, self.places, self.free)
        after = before - cross @ self.projection @ cross.T
        return _deviation(after), _deviation(before)


def find_bend(places: Array, values: Array, sigma: Array, free: bool, bend: float | None = None) -> Bend:
    """Find the smooth bend in scattered values, and which of them have no say.

    Parameters
    ----------
    places : (P, 2) float64 array
        x, y from the field's middle, in units of its longer side.
    values, sigma : (P,) float64 array
        Values and their standard uncertainties, mm.
    free : bool
        Whether a tilt is no part of the bend.
    bend : float, optional
        Standard deviation of the bend that is to be expected, mm; found in the points by default.

    Returns
    -------
    Bend
        Of the widths of largest evidence.  Points that differ from what the others say by more than `LIMIT`
        standard deviations had no say.
    """
    suspects = _suspects(places, values, sigma)

    best, score = None, -np.inf
    for factor in FACTORS:
        found = _without_odd(places, values, sigma * factor, suspects, Widths(factor=factor), free, bend)
        own = found.evidence + ODD * float(np.sum(~found.used))
        if best is None or (found.settled, own) > (best.settled, score):
            best, score = found, own
        elif best.settled:
            break  # from there on it falls
    assert best is not None
    return best


def _without_odd(
    places: Array,
    values: Array,
    sigma: Array,
    suspects: Array,
    widths: Widths,
    free: bool,
    bend: float | None,
) -> Bend:
    """Fit, drop the oddest point, take back who fits, until all do; a quarter is dropped at most."""
    used = ~suspects
    least = max(len(values) - len(values) // 4, 3 if free else 1)
    for turn in range(len(values)):
        found = _best(places, values, sigma, used, widths, free, bend)
        widths = found.widths
        inside, outside = _surprise(found, places, values, sigma)
        if turn < 4 and (outside <= LIMIT).any():
            used = used.copy()
            used[np.flatnonzero(~used)[outside <= LIMIT]] = True
        elif inside.max() > LIMIT and used.sum() > least:
            used = used.copy()
            used[np.flatnonzero(used)[np.argmax(inside)]] = False
        else:
            break
    fits = bool(inside.max() <= LIMIT) and widths.factor <= TOO_MUCH
    return replace(found, settled=fits and _told_by_others(found, values, sigma))


def _best(
    places: Array, values: Array, sigma: Array, used: Array, start: Widths, free: bool, bend: float | None
) -> Bend:
    """Climb to the widths of largest evidence: for each length from wide steps to narrow ones."""

    def climbed(best: Bend, tried: Sequence[float]) -> Bend:
        names = [name for name, fixed in (("bend", bend), ("tilt", free or None)) if fixed is None]
        before = -np.inf
        while best.evidence > before:
            before = best.evidence
            for name in names:
                ways = (replace(best.widths, **{name: width}) for width in tried)
                fits = [_fit(places, values, sigma, used, way, free) for way in ways]
                best = max([best, *fits], key=lambda fit: fit.evidence)
        return best

    if bend is not None:
        start = replace(start, bend=bend)
    starts = [_fit(places, values, sigma, used, replace(start, length=length), free) for length in LENGTHS]
    return climbed(max((climbed(one, WIDTHS[::3]) for one in starts), key=lambda fit: fit.evidence), WIDTHS)


def _fit(places: Array, values: Array, sigma: Array, used: Array, widths: Widths, free: bool) -> Bend:
    """Fit with given widths; restricted likelihood, since free terms have no prior."""
    there, seen, error = places[used], values[used], sigma[used]
    covariance = widths.covariance(there, there, free) + np.diag(error**2)
    terms = _free_terms(there, free)
    try:
        factor = cho_factor(covariance, lower=True)
        inverse = cho_solve(factor, np.eye(len(seen)))
        weighed = inverse @ terms
        information = terms.T @ weighed
        projection = inverse - weighed @ np.linalg.solve(information, weighed.T)
    except (LinAlgError, np.linalg.LinAlgError):
        nothing = np.zeros(len(seen))
        return Bend(there, nothing, np.diag(error**-2.0), widths, free, used, -np.inf)
    strengths = projection @ seen
    evidence = -0.5 * float(
        seen @ strengths
        + 2 * np.sum(np.log(np.diag(factor[0])))
        + np.linalg.slogdet(information)[1]
        + (len(seen) - terms.shape[1]) * np.log(2 * np.pi)
    )
    return Bend(there, strengths, projection, widths, free, used, evidence + widths.prior(free))


def _surprise(found: Bend, places: Array, values: Array, sigma: Array) -> tuple[Array, Array]:
    """Standard deviations by which points that had a say, and the other points, differ from what the rest says."""
    own = np.maximum(np.diag(found.projection), 1e-300)
    inside = np.abs(found.strengths) / np.sqrt(own)
    left = ~found.used
    if not left.any():
        return inside, np.zeros(0)
    cross = found.widths.covariance(places[left], found.places, found.free)
    # The constant is what the points that had a say leave over.
    terms, others = _free_terms(found.places, found.free), _free_terms(places[left], found.free)
    weights = sigma[found.used] ** -2.0
    covariance = found.widths.covariance(found.places, found.places, found.free) + np.diag(1 / weights)
    inverse = np.linalg.inv(covariance)
    information = terms.T @ inverse @ terms
    constant = np.linalg.solve(information, terms.T @ inverse @ values[found.used])
    off = values[left] - cross @ found.strengths - others @ constant
    lever = others - cross @ inverse @ terms
    own_variance = np.diag(found.widths.covariance(places[left], places[left], found.free))
    variance = own_variance - np.einsum("ij,jk,ik->i", cross, inverse, cross) + sigma[left] ** 2
    variance += np.einsum("ij,ij->i", lever, np.linalg.solve(information, lever.T).T)
    return inside, np.abs(off) / np.sqrt(np.maximum(variance, 1e-300))


def _told_by_others(found: Bend, values: Array, sigma: Array) -> bool:
    """Test whether points tell of one another at all: a bend that follows each may be none of the photographs'."""
    expected = float(np.median(1 / np.sqrt(np.maximum(np.diag(found.projection), 1e-300))))
    chance = float(np.median(sigma[found.used]))
    return expected < max(0.5 * float(np.std(values[found.used])), 4 * chance)


def _suspects(places: Array, values: Array, sigma: Array) -> Array:
    """Points far from the parabolic surface of least absolute distance, a quarter of them at most."""
    x, y = places.T
    left = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
    off = np.abs(values - left @ least_absolute(left, values))
    found = off > np.maximum(6 * 1.4826 * np.median(off), 6 * sigma)
    return found if found.sum() <= len(values) // 4 else np.zeros(len(values), bool)


def _free_terms(places: Array, free: bool) -> Array:
    ones = np.ones((len(places), 1))
    return np.hstack([ones, places]) if free else ones


def _deviation(covariance: Array) -> Array:
    """Standard deviations once each draw has lost its mean."""
    centred = covariance - covariance.mean(axis=0)
    centred = centred - centred.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(np.diag(centred), 0)))
