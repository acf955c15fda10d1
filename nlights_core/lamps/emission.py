"""Emission of each lamp, fitted to photographs of a flat, and whether the stand's file fits them.

The reading of one plane says nothing about where a lamp is if the lamp may emit as it likes: every
position has an emission that explains it.  What tells is how odd an emission a wrong position
needs, so that the answer hangs on what is taken for odd (the priors of `nlights_core.lamps.lobes`).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.integration import poisson
from nlights_core.lamps.lobes import UNKNOWNS, Readings, fit_lobes, lens_terms, optical_axes, reduce_readings
from nlights_core.stands import Stand

LINEAR_MM = 20.0
"""How freely positions move while it is studied what the flats say about them."""
WORST_CONDITION = 100.0
"""Of the lights of a pixel whose flatness is looked at."""
FALSE_ALARM = 0.001
"""How often a stand's file that fits may be doubted."""


@dataclass(frozen=True)
class Emission:
    """Findings of the flats about the lamps.

    Attributes
    ----------
    lights : LightField
        The lamps at the stand's positions, with the axes, exponents and powers (mean 1) of ideal
        lobes that explain the flats best.
    vignetting : (2,) float64 array
        Logarithm of the lens's light at the corner of the field beyond cos^4, per term.
    residual : float
        Rms share by which the flats depart from that model.
    shifts, pulls : (L, 3) float64 arrays
        How far the flats would move each lamp, mm in the plane frame, and that in standard
        deviations: of what the flats can tell and the stand's uncertainty together.
    resolution : float
        Standard deviation with which the flats alone tell a lamp's coordinate, mm: median.
    doubt : float
        Twice the logarithm of how much better another uncertainty of all positions explains the
        flats than the stand's own; 0 where none does.
    likely_mm : float
        That other uncertainty, mm.
    suspects : tuple of str
        Lamps that the flats would rather have elsewhere, each judged on its own.
    fits : bool
        False when a stand's file that fits would show such a doubt in less than one case in a
        thousand, or any suspect in as few.  True proves little: see docs/image-detrends.md for what can be seen.
    """

    lights: LightField
    vignetting: Array
    residual: float
    shifts: Array
    pulls: Array
    resolution: float
    doubt: float
    likely_mm: float
    suspects: tuple[str, ...]
    fits: bool


def fit_emission(reading: Array, stand: Stand, lamps: tuple[str, ...], x: Array, y: Array) -> Emission:
    """Fit axes, exponents, powers and vignetting to flats, and test the stand's positions on them.

    Parameters
    ----------
    reading : (L, h, w, C) array
        Photographs of the flat, as `nlights_core.algorithms.ImageDetrend.flat_field` gets them:
        linear, dark subtracted, block means; NaN where saturated.
    stand : Stand
        Positions, their uncertainty, and the exponent to start from.
    lamps : tuple of str
        Its lamps in the order of ``reading``.
    x, y : (w,) and (h,) arrays
        Centres of the blocks, mm.

    Returns
    -------
    Emission
        In about a second.

    Raises
    ------
    TileError
        When less than half of a lamp's reading is known.

    Notes
    -----
    Maximum a posteriori by Gauss-Newton on the logarithm with Cauchy's loss; all priors are
    Gaussian and are the constants of this module.  It runs twice: with ideal lobes and positions
    as the stand has them, for the light field; and with departing lobes and nearly free
    positions, for the test.  There, a position x_i measured by the flats with covariance C and by
    the stand with s has the evidence N(x; 0, C + s^2), so that s can be compared with the stand's
    (a variance component, fitted by maximum likelihood) [1]_.

    References
    ----------
    .. [1] S. Searle, G. Casella, C. McCulloch, Variance Components, 1992, ch. 6.
    """
    from scipy.special import chdtri

    data = reduce_readings(reading, stand, lamps, x, y)
    ideal = fit_lobes(data, LINEAR_MM, np.arange(UNKNOWNS) < 4)
    free = fit_lobes(data, LINEAR_MM, np.ones(UNKNOWNS, bool))
    places = (UNKNOWNS * np.arange(len(lamps))[:, None] + np.arange(4, 7)).ravel()
    information = np.linalg.inv(free.covariance[np.ix_(places, places)])
    # What the flats alone say: without the wide prior that kept the fit near the stand.
    covariance = np.linalg.inv(information - np.eye(len(places)) / LINEAR_MM**2)
    shifts = covariance @ information @ free.lamps[:, 4:7].ravel()
    pulls, suspects = _pulls(shifts, covariance, stand.uncertainty_mm)
    doubt, likely = _variance_component(shifts, covariance, stand.uncertainty_mm)
    return Emission(
        lights=_ideal_lights(lamps, ideal.lamps, data),
        vignetting=ideal.lens,
        residual=float(np.sqrt(np.nanmean(ideal.residual**2))),
        shifts=shifts.reshape(-1, 3),
        pulls=pulls,
        resolution=float(np.median(np.sqrt(np.diag(covariance)))),
        doubt=doubt,
        likely_mm=likely,
        suspects=tuple(lamp for lamp, suspect in zip(lamps, suspects, strict=True) if suspect),
        # Half of the time the best uncertainty is the stated one or less: a one-sided test.
        fits=not suspects.any() and doubt <= float(chdtri(1, 2 * FALSE_ALARM)),
    )


def _ideal_lights(names: tuple[str, ...], lamps: Array, data: Readings) -> LightField:
    """The light field of fitted lamps at the stand's positions."""
    # `LightField.vectors` counts a lamp's power by its light at the origin.
    power = np.exp(lamps[:, 0] - np.log(np.sum(data.positions**2, axis=1)))
    return LightField(
        names,
        positions=data.positions,
        power=(power / power.mean())[:, None],
        axes=optical_axes(lamps, data),
        exponents=data.exponent * np.exp(lamps[:, 3]),
    )


def _pulls(shifts: Array, covariance: Array, stated: float) -> tuple[Array, Array]:
    """Shifts in standard deviations, (L, 3), and which lamps' three are too large together, (L,)."""
    from scipy.special import chdtri

    total = covariance + stated**2 * np.eye(len(shifts))
    pulls = (shifts / np.sqrt(np.diag(total))).reshape(-1, 3)
    blocks = [slice(3 * i, 3 * i + 3) for i in range(len(pulls))]
    odds = [float(shifts[b] @ np.linalg.solve(total[b, b], shifts[b])) for b in blocks]
    return pulls, np.array(odds) > chdtri(3, FALSE_ALARM / len(pulls))


def computed_flat_field(emission: Emission, stand: Stand, x: Array, y: Array) -> Array:
    """The flat field that the fitted lamps and lens make, up to one factor for all lamps.

    Parameters
    ----------
    emission : Emission
    stand : Stand
        Where the camera is.
    x, y : (w,) and (h,) arrays
        Points, mm.

    Returns
    -------
    (L, h, w, 1) float32 array
    """
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
    light = emission.lights.vectors(points)[..., 2] * emission.lights.power[:, :, None]
    lens, corners = lens_terms(stand, points.reshape(3, -1).T)
    seen = np.exp(lens + corners @ emission.vignetting).reshape(len(y), len(x))
    return np.asarray((light * seen)[..., None], np.float32)


def flat_fit(reading: Array, emission: Emission, stand: Stand, x: Array, y: Array) -> tuple[float, float]:
    """Measure how flat the flat comes out when its lamps are computed instead of photographed.

    The flats are divided by `computed_flat_field` and measured as an artwork would be.  What is left is
    what stand file and fitted emission get wrong together, and what is not plane about the flat.

    Parameters
    ----------
    reading, x, y
        As in `fit_emission`.
    emission : Emission
        What it found.
    stand : Stand

    Returns
    -------
    peak_to_valley, rms : float
        Of the height less its best plane, micrometres; NaN where nothing could be measured.
    """
    images = np.mean(reading / computed_flat_field(emission, stand, x, y), axis=-1)
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
    light = emission.lights.vectors(points)
    light = light / light[..., 2:]
    scaled = _scaled_normals(images, light)
    step = float(x[1] - x[0])
    per_column, per_row = -scaled[..., 0] / scaled[..., 2] * step, scaled[..., 1] / scaled[..., 2] * step
    known = np.isfinite(per_column)
    if known.mean() < 0.5:
        return float("nan"), float("nan")
    height = poisson.simchony(
        np.where(known, per_column, 0).astype(np.float32), np.where(known, per_row, 0).astype(np.float32)
    )
    base = np.stack([points[0], points[1], np.ones_like(height)], axis=-1)
    height = height - base @ np.linalg.lstsq(base[known], height[known], rcond=None)[0]
    return 1000 * float(np.ptp(height[known])), 1000 * float(np.std(height[known]))


def _scaled_normals(images: Array, light: Array) -> Array:
    """Normals times albedo of a few pixels (h, w, 3) by least squares, NaN where badly conditioned."""
    # Apart from `nlights_core.solving.least_squares`, so that the artefact of a flat field rests on no normal solver.
    known = np.isfinite(images)
    matrix = np.einsum("lhw,lhwi,lhwj->hwij", known.astype(np.float64), light, light)
    right = np.einsum("lhw,lhwi->hwi", np.where(known, images, 0), light)
    well = (known.sum(axis=0) >= 3) & (np.linalg.cond(matrix) <= WORST_CONDITION**2)
    matrix[~well] = np.eye(3)
    solved = np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.where(well[..., None], solved, np.nan)


def _variance_component(shifts: Array, covariance: Array, stated: float) -> tuple[float, float]:
    """Likelihood of another uncertainty of shifts against the stated one, and which one is likeliest.

    Returns
    -------
    doubt : float
        Twice the logarithm of the ratio of likelihoods; at least 0.
    likely : float
        The uncertainty at which the likelihood is highest, from the stated one to 1 m, mm.
    """
    variances, turn = np.linalg.eigh((covariance + covariance.T) / 2)
    squares = (turn.T @ shifts) ** 2
    candidates = np.geomspace(stated, max(1000.0, 2 * stated), 400)
    total = np.maximum(variances, 0)[:, None] + candidates**2
    costs = np.sum(squares[:, None] / total + np.log(total), axis=0)
    best = int(np.argmin(costs))
    return float(costs[0] - costs[best]), float(candidates[best])


@dataclass(frozen=True)
class StandCheck:
    """Check of the stand's file against the flats, in a few numbers.

    Attributes
    ----------
    residual : float
        Rms share by which the flats depart from ideal lamps at the stand's positions.
    peak_to_valley, rms : float or None
        The flat's own height, measured with computed lamps, micrometres (`flat_fit`); None where
        it could not be measured.
    resolution, doubt, likely_mm, suspects, fits
        See `Emission`.
    """

    residual: float
    peak_to_valley: float | None
    rms: float | None
    resolution: float
    doubt: float
    likely_mm: float
    suspects: tuple[str, ...]
    fits: bool


def check_stand(reading: Array, stand: Stand, lamps: tuple[str, ...], x: Array, y: Array) -> StandCheck:
    """Check the stand's file against the flats; see `fit_emission` for the arguments."""
    found = fit_emission(reading, stand, lamps, x, y)
    peak_to_valley, rms = flat_fit(reading, found, stand, x, y)
    known = bool(np.isfinite(rms))
    return StandCheck(
        found.residual,
        peak_to_valley if known else None,
        rms if known else None,
        found.resolution,
        found.doubt,
        found.likely_mm,
        found.suspects,
        found.fits,
    )


def write_stand_check(folder: Path, check: StandCheck) -> None:
    """Write ``stand_check.json``."""
    (folder / "stand_check.json").write_text(json.dumps(asdict(check), indent=1) + "\n", encoding="utf-8")


def read_stand_check(folder: Path) -> StandCheck | None:
    """Read what `write_stand_check` wrote; None where it wrote nothing."""
    path = folder / "stand_check.json"
    if not path.is_file():
        return None
    record = json.loads(path.read_text(encoding="utf-8"))
    return StandCheck(**{**record, "suspects": tuple(record["suspects"])})
