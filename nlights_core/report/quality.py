"""Numbers that say how far a tile's measurement can be trusted: none of them is a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nlights_core.files.reduction import sampled
from nlights_core.frames import Array, PixelGrid
from nlights_core.report.figures import CHECKED_ON, NOT_IN_RECIPE, NOT_MEASURED, Number
from nlights_core.report.map_statistics import (
    bias_angle,
    extremes,
    inclination,
    mean_of,
    misclosure,
    relief,
    summarise_counts,
    unevenness,
)

if TYPE_CHECKING:
    from nlights_core.lamps.emission import StandCheck
    from nlights_core.near_light.position_uncertainty import PositionUncertainty


def _surface(maps: Mapping[str, Array], grid: PixelGrid, slope: float | None) -> list[Number]:
    """Numbers of the relief, of which the mean slope is given."""
    group, unit, height = "Surface", grid.unit, maps.get("height")
    spread = rms = tilt = None
    if height is not None and (values := sampled(height)).size:
        low, level, high = np.percentile(values, [0.1, 50, 99.9])
        spread = float(high - low)
        if found := relief(height, grid, float(level)):
            rms = found.rms
            tilt = found.plane and float(np.degrees(np.arctan(np.hypot(*found.plane[:2]))))
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
        curl = misclosure(maps.get("measured", normals), grid)
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
            "Uncertainty of the normals, mean",
            trust,
            "°",
            "68 % of the normals are off by no more than this, as far as noise and disagreement of the "
            f"photographs tell; what wrong lamp positions add is not in it. {CHECKED_ON}",
        ),
    ]


def _share(array: Array | None, inside: int | None) -> float | None:
    """Percentage of the pixels inside whose count is not 0."""
    found = None if array is None else summarise_counts(array, inside=inside)
    return None if found is None else 100 * found[1]


def _lights(maps: Mapping[str, Array], known: float | None, inside: int | None) -> list[Number]:
    """Numbers of coverage, of which the known share is given, and of how many lights served."""
    group, used = "Light", maps.get("used")
    stacks = [len(maps[name]) for name in ("flat_field", "frames") if name in maps]
    lamps = stacks[0] if stacks else int(used.max()) if used is not None and used.size else 0
    served = None if used is None else summarise_counts(used, lamps, inside)
    mean, every = served or (None, None)
    return [
        Number(group, "Known share", known, "% of pixels", "Where the surface could be measured at all."),
        Number(
            group,
            "Lights used, mean",
            mean,
            "lights",
            "How many lamps served at a pixel on average; three are the least.",
        ),
        Number(
            group,
            f"Pixels with all {lamps} lights" if lamps else "Pixels with all lights",
            100 * every if every is not None and lamps else None,
            "% of pixels",
            "Where no photograph had to be left out.",
        ),
        Number(
            group,
            "Saturated",
            _share(maps.get("saturated"), inside),
            "% of pixels",
            "Where at least one photograph is overexposed and was left out.",
        ),
        Number(
            group,
            "In shadow",
            _share(maps.get("shadow"), inside),
            "% of pixels",
            "Where at least one lamp casts a shadow.",
        ),
        Number(
            group,
            "Albedo, mean",
            None if "albedo" not in maps else mean_of(maps["albedo"]),
            "linear",
            "Mean over pixels and colours on the scale of albedo.tif: a share of the light where a flat "
            "was photographed, relative where not.",
        ),
    ]


def _removed(maps: Mapping[str, Array], grid: PixelGrid, lamps: Sequence[str]) -> list[Number]:
    """Amplitudes of what was removed, so that it can be judged and added back."""
    group = "Removed"
    absent = {
        name: NOT_MEASURED if name in maps else NOT_IN_RECIPE for name in ("flat_field", "trend", "bias")
    }
    names = ["Uneven light"]
    ratios: list[float | None] = [None]
    if "flat_field" in maps:
        ratios = [unevenness(reading) for reading in maps["flat_field"]]
        numbered = [f"lamp {i} of {len(ratios)}" for i in range(1, len(ratios) + 1)]
        names = [f"Uneven light, {lamp}" for lamp in (*lamps[: len(ratios)], *numbered[len(lamps) :])]
    numbers = [
        Number(
            group,
            name,
            ratio,
            "brightest / darkest",
            "What a flat reads under this lamp, and the photographs were divided by.",
            absent["flat_field"],
        )
        for name, ratio in zip(names, ratios, strict=True)
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
            absent["trend"],
        ),
        Number(
            group,
            "Bias of the normals, largest",
            angle,
            "°",
            "Largest systematic error seen on the flat and taken out of the normals.",
            absent["bias"],
        ),
    ]


def measure(
    maps: Mapping[str, Array], grid: PixelGrid, lamps: Sequence[str] = (), inside: int | None = None
) -> list[Number]:
    """Every number of the report, in its order.

    Parameters
    ----------
    maps : mapping of str to array
        What is there of "normals" (H, W, 3), as "measured" before they were made integrable, "height"
        (H, W), "albedo" (H, W, C), "residual" and "confidence" (H, W), "used", "saturated" and "shadow"
        (H, W) counts of lights, "flat_field" (L, h, w, C), "frames" (L, ...), "trend" (H, W) and "bias"
        (H, W, 3).  NaN where not known.
        Without "flat_field", "trend" or "bias" the recipe had no step that makes one.
    grid : PixelGrid
        Where the pixels are.
    lamps : sequence of str
        Their names, in the order of "flat_field"; they are numbered where there are none.
    inside : int, optional
        Pixels inside the mask, of which shares are counted; all of them where there is none.

    Returns
    -------
    list of Number
        The same quantities whatever is there (the uneven light once per lamp); the value is None
        where it could not be measured, and `Number.missing` says why.
    """
    known = slope = None
    if "normals" in maps:
        share, slope = inclination(maps["normals"])
        known = 100 * share
        if inside is not None:
            known *= grid.rows * grid.columns / max(1, inside)
    return [
        *_lights(maps, known, inside),
        *_fit(maps, grid),
        *_surface(maps, grid, slope),
        *_removed(maps, grid, lamps),
    ]


def of_known_heights(found: tuple[Array, Array] | None, source: str) -> list[Number]:
    """Numbers of the heights that somebody measured, from their differences before and after; none without any."""
    if found is None:
        return []
    before, after = (off[np.isfinite(off)] for off in found)

    def typical(off: Array) -> float | None:
        return 1.4826 * float(np.median(np.abs(off))) if off.size else None

    return [
        Number(
            "Known heights",
            "Points within the field",
            float(before.size),
            "points",
            f"The height is tied to these points of {source}, of {len(found[0])}: its slow bends are theirs as "
            "far as they are surer. known_heights.csv lists them.",
        ),
        Number(
            "Known heights",
            "Difference of the photographed height, typical",
            typical(before),
            "mm",
            "How far the photographed height was from them after the best constant: 1.48 times the median, which is "
            "the standard deviation where nothing is odd.",
        ),
        Number(
            "Known heights",
            "Difference of the tied height, typical",
            typical(after),
            "mm",
            "The same of the height as it leaves the system.",
        ),
    ]


def grouped(numbers: Sequence[Number]) -> list[Number]:
    """The same numbers with those of a group together, groups in the order of their first."""
    groups = list(dict.fromkeys(number.group for number in numbers))
    return sorted(numbers, key=lambda number: groups.index(number.group))


def of_positions(found: PositionUncertainty | None, uncertainty: float | None) -> list[Number]:
    """Errors of normals and height by the uncertainty of the lamps' measured positions."""
    said = f"{uncertainty:g} mm" if uncertainty else "an unknown amount"
    return [
        Number(
            "Agreement",
            "Uncertainty of the normals by the lamps' positions",
            None if found is None else found.normals,
            "°",
            f"Each lamp's position is uncertain by {said} per axis; this is the angle that it may turn the "
            "normals by, smoothly over the field (68 %).",
        ),
        Number(
            "Agreement",
            "Uncertainty of the height by the lamps' positions",
            None if found is None else found.height,
            "mm",
            "The bow that the same may give the height, as a standard deviation over the field.",
        ),
    ]


def of_flat(check: StandCheck | None, stand: str | None, missing: str) -> list[Number]:
    """Numbers of the photographs of the flat: about themselves and the stand's file."""
    warning = ""
    if check is not None and not check.fits:
        named = f", above all {', '.join(check.suspects)}" if check.suspects else ""
        warning = (
            f"The flats do not fit the stand '{stand}': its lamps seem to be some {check.likely_mm:.0f} mm "
            f"off{named}. "
            "See whether this is the stand that was used, and whether photographs of lamps were exchanged; "
            "measure its points of interest again."
        )

    def number(name: str, value: float | None, unit: str, meaning: str, warning: str = "") -> Number:
        absent = missing if check is None else NOT_MEASURED
        return Number("Flat", name, value, unit, meaning, absent, warning, code="stand")

    return [
        number(
            "Flat fit, peak to valley",
            check.peak_to_valley if check else None,
            "µm",
            "Height of the flat itself when it is measured like an artwork with computed instead of photographed "
            "lamps: what stand file and lamps get wrong together. The artwork's height does not have this error.",
        ),
        number("Flat fit, rms", check.rms if check else None, "µm", "The same, typically."),
        number(
            "Flats against computed lamps, rms",
            100 * check.residual if check else None,
            "%",
            "How far the flats are from ideal lamps at the stand's positions, through an ideal lens.",
        ),
        number(
            "Doubt of the stand's file",
            check.doubt if check else None,
            "",
            "Twice the logarithm of how much better the flats fit lamps elsewhere; above 9.5 it is not chance. "
            f"The flats can tell a lamp's place to {check.resolution if check else 6:.0f} mm, so a small doubt "
            "proves little.",
            warning,
        ),
    ]
