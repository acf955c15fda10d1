"""The light that a lamp throws on a flat: its logarithm, and the fit of its unknowns.

At the distance d of a point P a lamp at S makes the flat read

    log F = log power + mu log(w.a) + sum of c_k B_k(w) + log S_z - 3 log d + V

with w the unit vector from S to P, a the optical axis and mu the exponent of the emission.  The
B_k are what a real lamp adds to the ideal lobe, and V is the lens's vignetting, common to all
lamps.  All unknowns have Gaussian priors, the constants of this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.stands import Stand

AIM_DEVIATION_DEG = 2.0
"""Lamps are aimed at the centre of the field by eye, to some 20 mm at 650 mm."""
EXPONENT_DEVIATION = 0.3
"""Of log mu: a catalogue's half angle is good to some 15 %, and mu goes as its square."""
LOBE_DEVIATION = 0.01
"""Share by which the light on the cone of half power departs from the ideal lobe, per term: twice
what a group of four lamps shows that are 8 % unequal and 1 degree off in aim."""
ROUND_DEVIATION = 0.05
"""The same for the term without direction: a lens may well be flatter or more pointed than a cosine."""
VIGNETTING_DEVIATION = 0.1
"""Share of the light in the corners by which a lens departs from cos^4, per term."""
LEAST_RESIDUAL = 0.001
"""The white of a flat is not more even than this, over distances that lobes cannot follow."""
INDEPENDENT = 300
"""As how many independent readings a lamp's flat counts: its unevenness is shared by neighbours."""

SAMPLES = 40
"""Samples across that a flat is reduced to, by medians, so that dirt does not count."""
TUNING = 2.385
"""Cauchy's loss with this times the spread keeps 95 % of the efficiency of least squares."""
ROUNDS = 20
LOBES = 11
"""Number of terms B_k."""
UNKNOWNS = 7 + LOBES
"""Unknowns of a lamp, in the order of `LobeFit.lamps`."""


@dataclass(frozen=True)
class Readings:
    """Flats reduced to some samples, and the stand's view of the lamps.

    Attributes
    ----------
    logarithm : (L, N) float64 array
        Logarithm of the reading; NaN where not known.
    points : (N, 3) float64 array
        Where, mm.
    positions, axes : (L, 3) float64 arrays
        The stand's lamps, mm, and unit vectors from them to the centre of the field.
    sides : tuple of two (L, 3) float64 arrays
        Unit vectors across the axes.
    exponent : float
        The stand's emission exponent.
    lens : (N,) float64 array
        Logarithm of cos^4 about the camera's axis.
    corners : (N, 2) float64 array
        Second and fourth power of the distance from the camera's foot, 1 at the corner.
    """

    logarithm: Array
    points: Array
    positions: Array
    axes: Array
    sides: tuple[Array, Array]
    exponent: float
    lens: Array
    corners: Array

    @property
    def half_power(self) -> float:
        """Tangent of the angle of half power."""
        return float(np.sqrt(0.5 ** (-2 / self.exponent) - 1))


@dataclass(frozen=True)
class LobeFit:
    """Fitted lobes of the lamps, and the lens.

    Attributes
    ----------
    lamps : (L, 18) float64 array
        Per lamp: log power, two angles of aim about the given axis (radians), logarithm of the
        exponent over the given one, three shifts of the position (mm), coefficients of the B_k.
    lens : (2,) float64 array
        Terms of V beyond cos^4, at the corner of the field.
    covariance : (n, n) float64 array
        Of all free unknowns, lamp by lamp, then the lens.
    residual : (L, N) float64 array
        Reading over prediction, logarithm; NaN where not known.
    """

    lamps: Array
    lens: Array
    covariance: Array
    residual: Array


def reduce_readings(reading: Array, stand: Stand, lamps: tuple[str, ...], x: Array, y: Array) -> Readings:
    """Medians of blocks of the flats' logarithm, and what the stand says.

    Parameters
    ----------
    reading : (L, h, w, C) array
        Linear flats; NaN, zero and negative values are not known.
    stand : Stand
    lamps : tuple of str
        The stand's lamps in the order of ``reading``.
    x, y : (w,) and (h,) arrays
        Centres of its samples, mm.

    Raises
    ------
    TileError
        When less than half of a lamp's reading is known.
    """
    positive = np.where(np.isfinite(reading) & (reading > 0), reading, np.nan)
    logarithm = np.log(positive.mean(axis=-1, dtype=np.float64))
    block = max(1, len(x) // SAMPLES)
    rows, columns = len(y) // block, len(x) // block
    cut = logarithm[:, : rows * block, : columns * block].reshape(-1, rows, block, columns, block)
    parts = np.moveaxis(cut, 3, 2).reshape(len(lamps), rows * columns, block * block)
    known = np.isfinite(parts).mean(axis=2) > 0.5
    for lamp, share in zip(lamps, known.mean(axis=1), strict=True):
        if share < 0.5:
            raise TileError(
                f"flats: {lamp}: the reading is known on {share:.0%} of the frame only (the rest is saturated "
                "or black); photograph the flat again"
            )
    medians = np.nanmedian(np.where(known[..., None], parts, 0.0), axis=2)
    across = x[: columns * block].reshape(-1, block).mean(axis=1)
    down = y[: rows * block].reshape(-1, block).mean(axis=1)
    points = np.stack([*np.meshgrid(across, down), np.zeros((rows, columns))], axis=-1).reshape(-1, 3)
    positions = stand.lamp_positions(lamps)
    axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    first = np.cross([0.0, 0.0, 1.0], axes)
    first[np.linalg.norm(first, axis=1) < 1e-6] = [1.0, 0.0, 0.0]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    sides = first, np.cross(axes, first)
    values = np.where(known, medians, np.nan)
    return Readings(values, points, positions, axes, sides, stand.lamp.exponent, *lens_terms(stand, points))


def lens_terms(stand: Stand, points: Array) -> tuple[Array, Array]:
    """Logarithm of cos^4 at points (N, 3), and the two terms of what a lens adds to it, (N, 2)."""
    camera = stand.camera_position
    squared = np.sum((points[:, :2] - camera[:2]) ** 2, axis=1)
    share = squared / (np.sum(np.square(stand.field_mm)) / 4)
    return -2 * np.log1p(squared / camera[2] ** 2), np.stack([share, share**2], axis=1)


def optical_axes(lamps: Array, data: Readings) -> Array:
    """Optical axes of lamps (L, K): columns 1 and 2 turn them towards the two sides, radians."""
    turned = data.axes + lamps[:, 1:2] * data.sides[0] + lamps[:, 2:3] * data.sides[1]
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def predict_readings(lamps: Array, data: Readings) -> Array:
    """Logarithm of the flat field, (L, N), without the lens.

    ``lamps`` is that of `LobeFit`.
    """
    ideal, lobes = _ideal_and_lobes(lamps, data)
    return np.asarray(lamps[:, :1] + ideal + np.einsum("kln,lk->ln", lobes, lamps[:, 7:]))


def _ideal_and_lobes(lamps: Array, data: Readings) -> tuple[Array, Array]:
    """`predict_readings` of lamps of power 1 without the terms B_k, (L, N), and these terms, (11, L, N)."""
    positions, axes = data.positions + lamps[:, 4:7], optical_axes(lamps, data)
    ray = data.points - positions[:, None]
    distance = np.linalg.norm(ray, axis=2)
    along = np.maximum(np.einsum("lnk,lk->ln", ray, axes), 1e-3 * distance)
    shape = (data.exponent * np.exp(lamps[:, 3:4])) * np.log(along / distance)
    u, v = (
        (np.einsum("lnk,lk->ln", ray, side) - along * np.sum(side * axes, axis=1)[:, None])
        / (along * data.half_power)
        for side in data.sides
    )
    height = np.log(np.maximum(positions[:, 2:], 1.0))
    return np.asarray(shape + height - 3 * np.log(distance)), _lobes(u, v)


def _lobes(u: Array, v: Array) -> Array:
    """Terms B_k, (11, ...): r^m cos or sin k phi of orders 2 to 4, each 1 at most where r = 1.

    Order 1 is the aim, and order 2 without direction the exponent.
    """
    squared = u * u + v * v
    even, odd = u * u - v * v, 2 * u * v
    third = (u * (u * u - 3 * v * v), v * (3 * u * u - v * v))
    fourth = (squared * even, squared * odd, even * even - odd * odd, 2 * even * odd)
    return np.stack([even, odd, squared * u, squared * v, *third, *fourth, squared * squared])


def prior_deviations(position_mm: float) -> Array:
    """Standard deviations of the priors of one lamp's unknowns, (18,)."""
    aim = np.radians(AIM_DEVIATION_DEG)
    lobes = [LOBE_DEVIATION] * (LOBES - 1) + [ROUND_DEVIATION]
    # The exposure is anybody's choice.
    return np.array([100.0, aim, aim, EXPONENT_DEVIATION, *[position_mm] * 3, *lobes])


def fit_lobes(data: Readings, position_mm: float, free: Array) -> LobeFit:
    """Fit by Gauss-Newton until no unknown changes by more than 1 % of its prior's deviation.

    Parameters
    ----------
    data : Readings
    position_mm : float
        Standard deviation of the prior of each coordinate of a lamp.
    free : (18,) bool array
        Which unknowns of a lamp are fitted; the others stay as given.

    Returns
    -------
    LobeFit
        Robust: Cauchy's loss weighs strange samples down.
    """
    count, samples = data.logarithm.shape
    lamps, lens = np.zeros((count, len(free))), np.zeros(2)
    known = np.isfinite(data.logarithm)
    lamps[:, 0] = np.nanmean(data.logarithm - predict_readings(lamps, data) - data.lens, axis=1)
    scale = prior_deviations(position_mm)[free]
    deviations = np.concatenate([np.tile(scale, count), np.full(2, VIGNETTING_DEVIATION)])
    residual, information = np.zeros_like(known, float), np.diag(deviations**-2)
    for _ in range(ROUNDS):
        now = predict_readings(lamps, data)
        residual = np.where(known, data.logarithm - now - data.lens - data.corners @ lens, 0)
        spread = max(LEAST_RESIDUAL, float(np.median(np.abs(residual[known]))) / 0.6745)
        trust = known / (1 + (residual / (TUNING * spread)) ** 2)
        trust *= min(1.0, INDEPENDENT / samples) / spread**2
        columns = differentiate_readings(lamps, data, now, free)
        matrix, right = _normal_equations(columns, data.corners, trust, residual)
        state = np.concatenate([lamps[:, free].ravel(), lens])
        information = matrix + np.diag(deviations**-2)
        step = np.linalg.solve(information, right - state / deviations**2)
        largest = float(np.max(np.abs(step / deviations)))
        # A lamp that is not where it should be asks for steps far beyond what is linear.
        step *= min(1.0, 2 / largest)
        lamps[:, free] += step[:-2].reshape(count, -1)
        lens = lens + step[-2:]
        if largest < 0.01:
            break
    return LobeFit(lamps, lens, np.linalg.inv(information), np.where(known, residual, np.nan))


def differentiate_readings(lamps: Array, data: Readings, now: Array, free: Array) -> Array:
    """Derivatives of `predict_readings` by the free unknowns, (L, N, K), by differences from ``now``.

    It is linear in the logarithm of the power and in the coefficients of the B_k.
    """
    out = np.empty((*now.shape, np.count_nonzero(free)))
    lobes = _ideal_and_lobes(lamps, data)[1] if free[7:].any() else None
    steps = 1e-3 * prior_deviations(1.0)
    for place, k in enumerate(np.flatnonzero(free)):
        if k == 0:
            out[..., place] = 1
        elif lobes is not None and k >= 7:
            out[..., place] = lobes[k - 7]
        else:
            moved = lamps.copy()
            moved[:, k] += steps[k]
            out[..., place] = (predict_readings(moved, data) - now) / steps[k]
    return out


def _normal_equations(slopes: Array, corners: Array, trust: Array, residual: Array) -> tuple[Array, Array]:
    """Matrix and right side for all lamps' unknowns and the lens's, which all lamps share."""
    count, _, terms = slopes.shape
    size = count * terms
    matrix, right = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
    for i in range(count):
        own = slice(i * terms, (i + 1) * terms)
        columns = np.concatenate([slopes[i].T, corners.T])
        weighted = columns * trust[i]
        # No matrix product: it shares small work out to all cores, and waits long for busy ones.
        block, side = np.einsum("kn,mn->km", weighted, columns), np.einsum("kn,n->k", weighted, residual[i])
        matrix[own, own] = block[:terms, :terms]
        matrix[own, size:] = block[:terms, terms:]
        matrix[size:, own] = block[terms:, :terms]
        matrix[size:, size:] += block[terms:, terms:]
        right[own] = side[:terms]
        right[size:] += side[terms:]
    return matrix, right
