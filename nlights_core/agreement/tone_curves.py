"""Tone curves that nobody stated: numbers that are not proportional to light."""

from __future__ import annotations

import numpy as np

from nlights_core.agreement.additive_light import bending_light, warning_of_light
from nlights_core.agreement.wording import listed
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.lamps.lobes import (
    INDEPENDENT,
    LEAST_RESIDUAL,
    TUNING,
    UNKNOWNS,
    VIGNETTING_DEVIATION,
    Readings,
    differentiate_readings,
    predict_readings,
    prior_deviations,
    reduce_readings,
)
from nlights_core.reduced_light.coarse_light import LEAST_CELLS, CoarseLight, centred, known_medians
from nlights_core.reduced_light.samples import Samples

SLOPES = (0.65, 1.5)
"""Slope of the logarithm of flats on that of the computed light: 1 if numbers are light, but for what free lobes
and aims take.  Sound captures reach 0.85 to 1.05; sRGB, gamma 1.8 and 2.2, and L* give 0.27 to 0.5."""

SLOPES_OF_FRAMES = (0.7, 1.6)
"""The same of photographs on flats, where no lamp need be known: the median of the lamps' slopes.  Sound captures
reach 0.83 (a relief in the shadow of its frame) and 1.19 (dark paint under varnish); curves give 0.55 or less."""

LEAST_LAMPS = 5
"""Of fewer, one odd photograph shifts what all have in common."""

CERTAIN = 3.0
"""How many standard deviations a slope must be beyond its limit."""

LEAST_RANGE = 0.05
"""Spread of the logarithm of light over the field below which no slope can be measured."""

COS4_DEVIATION = 0.3
"""How much of cos^4 a lens or a converter's correction leaves out."""

ROUNDS = 12

FREE = np.arange(UNKNOWNS) < 4
"""Of a lamp, power, aim and exponent are fitted."""


def find_tone_curve(samples: Samples, cells: CoarseLight, tile: Tile) -> list[CaptureWarning]:
    """Look for numbers that follow a tone curve: in flats, by the stand; in photographs, by their flats.

    Parameters
    ----------
    samples : Samples
    cells : CoarseLight
        Of lamps that can be trusted.
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        Of one at most; of light in the photographs alone where that explains more than a curve.
    """
    linear = (
        "in artwork.yaml, state encoding.transfer: linear, for a curve seems to be undone that is not there"
    )
    remedy = (
        "export linear photographs (no tone curve, gamma 1), or state the curve in encoding.transfer in "
        "artwork.yaml; positions of lamps and the stand are not in doubt before that is mended"
    )
    read = readings_of_flats(samples, cells.lamps, tile)
    if read is not None:
        slope, deviation = slope_on_computed_light(read)
        if _beyond(slope, deviation, SLOPES):
            return [
                CaptureWarning(
                    "tone-curve",
                    f"the numbers in the flats (lamps {listed(cells.lamps)}) follow a tone curve: they vary over the "
                    f"field as computed light to the power of {slope:.2f}, where linear ones give 0.85 to 1.05; "
                    f"{linear if slope > 1 else remedy}",
                    (),
                    slope,
                    "power",
                )
            ]
    if cells.flats is None:
        return []
    slope, deviation = slope_on_flats(cells.frames, cells.flats)
    if not _beyond(slope, deviation, SLOPES_OF_FRAMES):
        return []
    light = bending_light(cells.frames, cells.flats, slope) if slope < 1 else None
    if light is not None:
        return [warning_of_light(light)]
    return [
        CaptureWarning(
            "tone-curve",
            "photographs of the artwork and flats follow different tone curves: light varies over the field in the "
            f"former as in the latter to the power of {slope:.2f}, where 0.85 to 1.2 is usual; {remedy}",
            (),
            slope,
            "power",
        )
    ]


def readings_of_flats(samples: Samples, lamps: tuple[str, ...], tile: Tile) -> Readings | None:
    """Flats and the stand's view of some lamps; None where either is missing or too little is known."""
    stand = tile.stand
    if samples.flats is None or stand is None or len(lamps) < 3 or not set(lamps) <= set(stand.lamps):
        return None
    flats = samples.flats[[samples.lamps.index(lamp) for lamp in lamps]]
    try:
        return reduce_readings(flats[..., None], stand, lamps, samples.grid.x(), samples.grid.y())
    except TileError:
        return None


def slope_on_computed_light(data: Readings) -> tuple[float, float]:
    """Fit the power of computed light that flats follow, with all that is not known about lamps and lens.

    Parameters
    ----------
    data : Readings

    Returns
    -------
    slope, deviation : float
        And its standard deviation.

    Notes
    -----
    Gauss-Newton on the logarithm with Cauchy's loss and the priors of `nlights_core.lamps.lobes`; of each lamp
    power, aim and exponent, of the lens two terms and the share of cos^4.
    """
    count, samples = data.logarithm.shape
    known = np.isfinite(data.logarithm)
    lens = np.column_stack([data.corners, data.lens])
    lamps, shared = np.zeros((count, UNKNOWNS)), np.array([0.0, 0.0, 1.0, 1.0])
    priors = np.array([VIGNETTING_DEVIATION, VIGNETTING_DEVIATION, COS4_DEVIATION, 10.0])
    deviations = np.concatenate([np.tile(prior_deviations(1.0)[FREE], count), priors])
    aims = np.concatenate([np.zeros(4 * count), [0.0, 0.0, 1.0, 1.0]])
    lamps[:, 0] = np.nanmean(data.logarithm - predict_readings(lamps, data) - lens @ shared[:3], axis=1)
    information = np.diag(deviations**-2)
    for _ in range(ROUNDS):
        powers = lamps[:, :1].copy()
        now = predict_readings(lamps, data)
        shape = now - powers + lens @ shared[:3]
        residual = np.where(known, data.logarithm - powers - shared[3] * shape, 0)
        spread = max(LEAST_RESIDUAL, float(np.median(np.abs(residual[known]))) / 0.6745)
        trust = known / (1 + (residual / (TUNING * spread)) ** 2)
        trust *= min(1.0, INDEPENDENT / samples) / spread**2
        columns = differentiate_readings(lamps, data, now, FREE)
        columns[..., 1:] *= shared[3]
        everyone = np.concatenate(
            [np.broadcast_to(shared[3] * lens, (count, samples, 3)), shape[..., None]], -1
        )
        matrix, right = normal_equations(columns, everyone, trust, residual)
        state = np.concatenate([lamps[:, FREE].ravel(), shared])
        information = matrix + np.diag(deviations**-2)
        step = np.linalg.solve(information, right - (state - aims) / deviations**2)
        lamps[:, FREE] += step[:-4].reshape(count, -1)
        shared = shared + step[-4:]
        if np.max(np.abs(step / deviations)) < 0.01:
            break
    return float(shared[3]), float(np.sqrt(np.linalg.inv(information)[-1, -1]))


def normal_equations(own: Array, everyone: Array, trust: Array, residual: Array) -> tuple[Array, Array]:
    """Matrix and right side for unknowns of each lamp (L, N, K) and those that all lamps share (L, N, M)."""
    count, _, terms = own.shape
    size, shared = count * terms, everyone.shape[2]
    matrix, right = np.zeros((size + shared,) * 2), np.zeros(size + shared)
    for i in range(count):
        places = np.r_[i * terms : (i + 1) * terms, size : size + shared]
        columns = np.concatenate([own[i], everyone[i]], axis=1)
        weighted = columns * trust[i][:, None]
        # No matrix product: it shares small work out to all cores, and waits long for busy ones.
        matrix[np.ix_(places, places)] += np.einsum("nk,nm->km", weighted, columns)
        right[places] += np.einsum("nk,n->k", weighted, residual[i])
    return matrix, right


def slope_on_flats(frames: Array, flats: Array) -> tuple[float, float]:
    """Fit the power of the flats' light that photographs follow; of both what all lamps share is taken out.

    Parameters
    ----------
    frames, flats : (L, h, w) arrays
        Logarithms.

    Returns
    -------
    slope, deviation : float
        And its standard deviation; NaN where the light varies too little.
    """
    seen, light = (centred(one).reshape(len(one), -1) for one in (frames, flats))
    known = np.isfinite(seen) & np.isfinite(light)
    if len(seen) < LEAST_LAMPS or known.sum(axis=1).min() < LEAST_CELLS or np.std(light[known]) < LEAST_RANGE:
        return float("nan"), float("nan")
    light, seen, trust = np.where(known, light, 0), np.where(known, seen, 0), known.astype(np.float64)
    slopes = np.ones((len(seen), 1))
    for _ in range(ROUNDS):
        weight = trust.sum(axis=1, keepdims=True)
        x, y = (one - np.sum(trust * one, axis=1, keepdims=True) / weight for one in (light, seen))
        slopes = np.sum(trust * x * y, axis=1, keepdims=True) / np.sum(trust * x * x, axis=1, keepdims=True)
        residual = y - slopes * x
        spread = np.maximum(1e-3, known_medians(np.where(known, np.abs(residual), np.nan))[:, None] / 0.6745)
        trust = known / (1 + (residual / (TUNING * spread)) ** 2)
    # By lamps: a single odd photograph changes neither the median nor how much the others differ.
    slope = float(np.median(slopes))
    return slope, float(1.4826 * np.median(np.abs(slopes - slope)) / np.sqrt(len(slopes)))


def _beyond(slope: float, deviation: float, limits: tuple[float, float]) -> bool:
    """Test whether a slope is certainly outside its limits."""
    low, high = limits
    return bool(slope + CERTAIN * deviation < low or slope - CERTAIN * deviation > high)
