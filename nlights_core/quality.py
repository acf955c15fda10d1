"""Numbers that say how far a tile's measurement can be trusted: none of them is a verdict.

Means, shares and extremes are taken over every pixel, by bands of rows; medians and percentiles
over a regular sample of at most `SAMPLE` pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nlights_core.export import bands
from nlights_core.fields import NormalField
from nlights_core.frames import Array, PixelGrid

if TYPE_CHECKING:
    from nlights_core.levelling import Level

SAMPLE = 2_000_000


@dataclass(frozen=True)
class Number:
    """One measured quantity.

    Parameters
    ----------
    group : str
        Heading under which it is listed.
    name : str
        What it is.
    value : float or None
        None: not measured.  That is never a pass.
    unit : str
        Unit of the value.
    meaning : str
        What it tells, in one plain sentence.
    """

    group: str
    name: str
    value: float | None
    unit: str
    meaning: str


def mean_of(array: Array, of: Callable[[Array], Any] | None = None) -> float | None:
    """Mean over what is known, by bands of rows.

    Parameters
    ----------
    array : (H, W, ...) array
        NaN where not known.
    of : callable, optional
        What is averaged, computed from each band; the band itself if absent.

    Returns
    -------
    float or None
        None where nothing is known.
    """
    total, count = 0.0, 0
    for band in bands(array.shape[0], array[:1].nbytes):
        values = np.asarray(array[band] if of is None else of(array[band]))
        known = np.isfinite(values)
        total += float(np.sum(values, where=known, dtype=np.float64))
        count += int(known.sum())
    return total / count if count else None


def extremes(array: Array, of: Callable[[Array], Any] | None = None) -> tuple[float, float] | None:
    """Smallest and largest known value, by bands of rows.

    Parameters
    ----------
    array : (H, W, ...) array
        NaN where not known.
    of : callable, optional
        Whose extremes, computed from each band; the band itself if absent.

    Returns
    -------
    (low, high) or None
        None where nothing is known.
    """
    low, high = np.inf, -np.inf
    for band in bands(array.shape[0], array[:1].nbytes):
        values = np.asarray(array[band] if of is None else of(array[band]))
        known = np.isfinite(values)
        low = min(low, float(np.min(values, where=known, initial=np.inf)))
        high = max(high, float(np.max(values, where=known, initial=-np.inf)))
    return (low, high) if low <= high else None


def bias_angle(bias: Array) -> Array:
    """Angle by which a difference of unit vectors (..., 3) turns a normal, degrees (...)."""
    length = np.sqrt((np.asarray(bias, np.float64) ** 2).sum(axis=-1))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1, length / 2))))


def sampled(array: Array) -> Array:
    """Known values on a regular lattice of at most about `SAMPLE` pixels, (N,) float64."""
    step = max(1, int(np.ceil(np.sqrt(array.shape[0] * array.shape[1] / SAMPLE))))
    values = np.asarray(array[::step, ::step], np.float64)
    return values[np.isfinite(values)]


def misclosure(normals: Array, grid: PixelGrid) -> float | None:
    """How badly heights fail to close on a walk once round a pixel: the curl of the slopes.

    With the height steps p per column and q per row (`NormalField.gradient`), each 2 x 2 of known
    pixels gives, by the trapezoid rule,

        m = (p00 + p01) / 2 + (q01 + q11) / 2 - (p10 + p11) / 2 - (q00 + q10) / 2

    It is 0 for the slopes of any smooth height, so noise, wrong lights, interreflections and steps
    show in it, while a bias that is itself the slope of some surface (a bowl) does not.

    Parameters
    ----------
    normals : (H, W, 3) float32 array
        NaN where not known.
    grid : PixelGrid
        Its pixel size and unit.

    Returns
    -------
    float or None
        Root mean square of m in the grid's unit; None where no 2 x 2 pixels are known.
    """
    total, count = 0.0, 0
    for band in bands(grid.rows, 3 * normals[:1].nbytes):
        p, q = NormalField(normals[band.start : band.stop + 1], grid).gradient()
        across, down = p[:, :-1] + p[:, 1:], q[:-1] + q[1:]
        m = (across[:-1] - across[1:] + down[:, 1:] - down[:, :-1]).astype(np.float64) / 2
        known = np.isfinite(m)
        total += float(np.sum(m**2, where=known))
        count += int(known.sum())
    return float(np.sqrt(total / count)) if count else None


def best_plane(height: Array, grid: PixelGrid) -> tuple[float, float, float] | None:
    """Least-squares plane ``z = a x + b y + c`` of a height map.

    Parameters
    ----------
    height : (H, W) float32 array
        NaN where not known.
    grid : PixelGrid
        Where the pixels are.

    Returns
    -------
    (a, b, c) or None
        Slopes (dimensionless) and offset (the grid's unit); None where fewer than three pixels
        that are not on a line are known.
    """
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    x = grid.x()
    for band in bands(grid.rows, 8 * height[:1].nbytes):
        z = np.asarray(height[band], np.float64)
        known = np.isfinite(z)
        weight, z = known.astype(np.float64), np.where(known, z, 0)
        y = grid.y(band.start, band.stop)
        columns, rows = weight.sum(axis=0), weight.sum(axis=1)
        xx, xy, yy = columns @ x**2, y @ weight @ x, rows @ y**2
        sx, sy, n = columns @ x, rows @ y, rows.sum()
        matrix += np.array([[xx, xy, sx], [xy, yy, sy], [sx, sy, n]])
        right += np.array([z.sum(axis=0) @ x, z.sum(axis=1) @ y, z.sum()])
    if np.linalg.matrix_rank(matrix / np.max(np.abs(matrix), initial=1.0)) < 3:
        return None
    a, b, c = np.linalg.solve(matrix, right)
    return float(a), float(b), float(c)


def _surface(maps: Mapping[str, Array], grid: PixelGrid) -> list[Number]:
    """Numbers of the relief."""
    group, unit = "Surface", grid.unit
    height, normals = maps.get("height"), maps.get("normals")
    spread = rms = tilt = slope = None
    if height is not None and (values := sampled(height)).size:
        low, high = np.percentile(values, [0.1, 99.9])
        spread = float(high - low)
        level = float(np.median(values))
        mean = mean_of(height, lambda z: z - level) or 0.0
        square = mean_of(height, lambda z: (np.asarray(z, np.float64) - level - mean) ** 2) or 0.0
        rms = float(np.sqrt(square))
        plane = best_plane(height, grid)
        tilt = None if plane is None else float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))
    if normals is not None:
        slope = mean_of(normals, lambda n: np.degrees(np.arctan2(np.hypot(n[..., 0], n[..., 1]), n[..., 2])))
    return [
        Number(
            group,
            "Height range",
            spread,
            unit,
            "From the lowest to the highest part of the surface, leaving out 0.1 % of the pixels at each "
            "end; includes any tilt and bow.",
        ),
        Number(group, "Height, rms", rms, unit, "Typical distance of the surface from its own mean level."),
        Number(
            group,
            "Mean slope",
            slope,
            "°",
            "Average inclination of the surface to the plane of the stand: how rough it is at the scale of a "
            "pixel.",
        ),
        Number(
            group,
            "Tilt of the best plane",
            tilt,
            "°",
            "How far the artwork as a whole leans against the plane of the stand.",
        ),
    ]


def _fit(maps: Mapping[str, Array], grid: PixelGrid) -> list[Number]:
    """Numbers of how well the photographs agree with the model."""
    group = "Agreement"
    residual, normals, confidence = maps.get("residual"), maps.get("normals"), maps.get("confidence")
    mean = middle = curl = trust = None
    if residual is not None and (values := sampled(residual)).size:
        middle = 100 * float(np.median(values))
        share = mean_of(residual)
        mean = None if share is None else 100 * share
    if normals is not None:
        curl = misclosure(normals, grid)
    if confidence is not None:
        trust = mean_of(confidence)
    micrometres = grid.unit == "mm"
    return [
        Number(
            group,
            "Residual, mean",
            mean,
            "% of albedo",
            "How far the photographs differ from those that the measured normals and albedo would give; "
            "gloss, shadows and wrong lights raise it.",
        ),
        Number(
            group,
            "Residual, median",
            middle,
            "% of albedo",
            "The same for the typical pixel; far below the mean where a few places fit badly.",
        ),
        Number(
            group,
            "Misclosure of the slopes, rms",
            curl if curl is None or not micrometres else 1000 * curl,
            "µm" if micrometres else "px",
            "By how much heights fail to agree after walking once round a pixel: 0 for a true surface. "
            "It shows noise, not a slow bow.",
        ),
        Number(
            group,
            "Confidence, mean",
            trust,
            "0 to 1",
            "The solver's own confidence in its normals; 1 is best.",
        ),
    ]


def _share(array: Array | None, of: Callable[[Array], Any]) -> float | None:
    """Percentage of pixels for which something holds."""
    if array is None:
        return None
    share = mean_of(array, of)
    return None if share is None else 100 * share


def _lights(maps: Mapping[str, Array]) -> list[Number]:
    """Numbers of coverage and of how many lights served."""
    group = "Light"
    used, normals = maps.get("used"), maps.get("normals")
    stacks = [len(maps[name]) for name in ("plate", "frames") if name in maps]
    lamps = stacks[0] if stacks else int(used.max()) if used is not None and used.size else 0
    known = _share(normals, lambda n: np.isfinite(n).all(axis=-1))
    every = _share(used, lambda u: u >= lamps) if lamps else None
    return [
        Number(group, "Known share", known, "% of pixels", "Where the surface could be measured at all."),
        Number(
            group,
            "Lights used, mean",
            None if used is None else mean_of(used),
            "lights",
            "How many lamps served at a pixel on average; three are the least.",
        ),
        Number(
            group,
            f"Pixels with all {lamps} lights" if lamps else "Pixels with all lights",
            every,
            "% of pixels",
            "Where no photograph had to be left out.",
        ),
        Number(
            group,
            "Saturated",
            _share(maps.get("saturated"), lambda s: s > 0),
            "% of pixels",
            "Where at least one photograph is overexposed and was left out.",
        ),
        Number(
            group,
            "In shadow",
            _share(maps.get("shadow"), lambda s: s > 0),
            "% of pixels",
            "Where at least one lamp casts a shadow.",
        ),
        Number(
            group,
            "Albedo, mean",
            None if "albedo" not in maps else mean_of(maps["albedo"]),
            "linear",
            "Mean over pixels and colours on the scale of albedo.tif: a share of the light where a white "
            "reference was photographed, relative where not.",
        ),
    ]


def _removed(maps: Mapping[str, Array], grid: PixelGrid) -> list[Number]:
    """Amplitudes of what was removed, so that it can be judged and added back."""
    group = "Removed"
    ratios: list[float | None] = [None]
    if "plate" in maps:
        ratios = []
        for reading in maps["plate"]:
            values = reading[np.isfinite(reading) & (reading > 0)]
            ratios.append(float(values.max() / values.min()) if values.size else None)
    numbers = [
        Number(
            group,
            "Uneven light" if ratios == [None] else f"Uneven light, lamp {i} of {len(ratios)}",
            ratio,
            "brightest / darkest",
            "What a flat white plate reads under this lamp, and the photographs were divided by.",
        )
        for i, ratio in enumerate(ratios, start=1)
    ]
    trend = angle = None
    if "trend" in maps and (ends := extremes(maps["trend"])):
        trend = ends[1] - ends[0]
    if "bias" in maps and (ends := extremes(maps["bias"], bias_angle)):
        angle = ends[1]
    return [
        *numbers,
        Number(
            group,
            "Trend of the height, peak to valley",
            trend,
            grid.unit,
            "Smooth deformation taken out of the height; true bow of the artwork may be part of it.",
        ),
        Number(
            group,
            "Bias of the normals, largest",
            angle,
            "°",
            "Largest systematic error seen on the flat reference and taken out of the normals.",
        ),
    ]


def measure(maps: Mapping[str, Array], grid: PixelGrid) -> list[Number]:
    """Every number of the report, in its order.

    Parameters
    ----------
    maps : mapping of str to array
        What is there of "normals" (H, W, 3), "height" (H, W), "albedo" (H, W, C), "residual" and
        "confidence" (H, W), "used", "saturated" and "shadow" (H, W) counts of lights, "plate"
        (L, h, w, C), "frames" (L, ...), "trend" (H, W) and "bias" (H, W, 3).  NaN where not known.
    grid : PixelGrid
        Where the pixels are.

    Returns
    -------
    list of Number
        The same quantities whatever is there (the uneven light once per lamp); the value is None
        where it could not be measured.
    """
    return [*_lights(maps), *_fit(maps, grid), *_surface(maps, grid), *_removed(maps, grid)]


def of_level(level: Level) -> list[Number]:
    """What the photographs say of the surface's level and of the lamps since the flats were taken."""
    found = level.uncertainty is not None
    drift = 100 * (float(np.max(level.strengths)) - float(np.min(level.strengths)))
    return [
        Number(
            "Level",
            "Level found, against mean 0",
            level.offset if found else None,
            "mm",
            "What was added so that heights are above the plane of the flat reference.",
        ),
        Number(
            "Level",
            "Uncertainty of the level",
            level.uncertainty,
            "mm",
            "Standard deviation; not measured where gloss hides the level.",
        ),
        Number(
            "Level",
            "Drift of the lamps since the flats",
            drift if found else None,
            "%",
            "Strongest against weakest; it was corrected. Above 2 %, photograph the flats again.",
        ),
    ]
