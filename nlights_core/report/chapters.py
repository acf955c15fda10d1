"""The chapters of the report: which pictures it shows and what it says of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from nlights_core.files.reduction import block_means
from nlights_core.frames import Array
from nlights_core.products.viewing import srgb
from nlights_core.report import pictures, plots
from nlights_core.report.figures import CHECKED_ON, figure_of
from nlights_core.report.map_statistics import bias_angle, extremes, unevenness
from nlights_core.report.pictures import Picture
from nlights_core.report.views import Views

DETAIL = 640
"""Longest side of the detail that is shown pixel by pixel."""


@dataclass(frozen=True)
class Chapter:
    """A chapter of the report: its anchor, heading, introduction and pictures."""

    anchor: str
    title: str
    introduction: str
    pictures: tuple[Picture, ...]


def _grey_mean(array: Array) -> Array:
    """Mean over the channels of (h, w) or (h, w, C)."""
    return array if array.ndim == 2 else np.asarray(array.mean(axis=2))


def _albedo_colours(albedo: Array) -> Array:
    """Reduced albedo (h, w[, C]) as sRGB colours, hatched where not known."""
    code = (srgb(albedo) * 255 + 0.5).astype(np.uint8).reshape(*albedo.shape[:2], -1)
    return pictures.hatch(np.broadcast_to(code, (*code.shape[:2], 3)), np.isfinite(_grey_mean(albedo)))


def albedo_scale(white: float | None) -> str:
    """Sentence on the scale of the albedo, given the stated reflectance of the flat (None: there was none)."""
    if white is None:
        return "Relative: there was no flat, so only ratios within this tile count."
    return (
        "Absolute: the share of the light that it reflects, 1 being a perfect diffuser, as far as the "
        f"flat has its stated reflectance of {white:g}."
    )


def _exposure(albedo: Array | None) -> float:
    """Factor that an albedo is multiplied by to be seen: 1, unless it is relative and far too dark or bright."""
    if albedo is None or not np.isfinite(albedo).any():
        return 1.0
    bright = float(np.nanpercentile(albedo, 99.5))
    return 1.0 if 0.2 <= bright <= 1.05 or bright <= 0 else 0.9 / bright


def _surface(views: Views, white: float | None) -> Iterable[Picture]:
    """Chapter: what the surface looks like and how high it is."""
    albedo, normals, height = views.of("albedo"), views.of("normals"), views.height
    exposure = _exposure(albedo)
    if albedo is not None:
        brightened = (
            "" if exposure == 1 else f" This picture is brightened \N{MULTIPLICATION SIGN} {exposure:.2g}."
        )
        yield Picture(
            "Albedo",
            f"The colour of the surface itself, without light and shade. {albedo_scale(white)} Shown in sRGB, "
            f"clipped to 0 and 1.{brightened}",
            "Colour view of the artwork without shading",
            pictures.encode(_albedo_colours(albedo * np.float32(exposure))),
            scale=views.scale,
        )
    if normals is not None:
        shade, gain = pictures.hillshade(normals)
        yield Picture(
            "Raking light",
            "Computed from the normals as if one lamp shone from the upper left, 25° above the surface; "
            f"colour plays no part. Contrast \N{MULTIPLICATION SIGN} {gain:.2g}; no cast shadows.",
            "Grey relief view of the surface lit from the upper left",
            pictures.encode(pictures.grey(shade)),
            scale=views.scale,
        )
    yield from _detail(views, exposure)
    if height is not None:
        yield from _height(views, height)
    if normals is not None:
        yield from _orientation(views, normals)


def _orientation(views: Views, normals: Array) -> Iterable[Picture]:
    """Chapter: which way the surface faces, and how steep it is."""
    colours = np.nan_to_num(normals * 127.5 + 128, nan=0.0).clip(0, 255).astype(np.uint8)
    yield Picture(
        "Normals",
        "Which way the surface faces, as colours in the OpenGL convention: redder faces right, greener "
        "faces up, blue faces the camera.",
        "Normal map of the surface in OpenGL colours",
        pictures.encode(pictures.hatch(colours, np.isfinite(_grey_mean(normals)))),
        scale=views.scale,
    )
    slope = np.degrees(np.arctan2(np.hypot(normals[..., 0], normals[..., 1]), normals[..., 2]))
    ends = pictures.robust_range(slope, from_zero=True)
    image, bar = pictures.coloured(slope, ends, "magma", "Slope in degrees")
    yield Picture(
        "Slope",
        "How steeply the surface is inclined to the plane of the stand, whichever way it faces.",
        "Map of the slope, dark where the surface is level",
        image,
        bar=bar,
        scale=views.scale,
    )


def _detail(views: Views, exposure: float) -> Iterable[Picture]:
    """The middle of the field pixel by pixel, where the other pictures show block means."""
    if views.factor == 1 or "normals" not in views.maps:
        return
    grid = views.grid
    size = min(DETAIL, grid.columns), min(DETAIL * 3 // 4, grid.rows)
    left, top = (grid.columns - size[0]) // 2, (grid.rows - size[1]) // 2
    window = np.s_[top : top + size[1], left : left + size[0]]
    scale = pictures.scale_bar(size[0] * grid.pixel_size, grid.unit)
    if "albedo" in views.maps:
        yield Picture(
            "Detail: albedo",
            f"The middle of the field, {size[0]} \N{MULTIPLICATION SIGN} {size[1]} pixels, each one shown.",
            "Colour view of the middle of the field at full resolution",
            pictures.encode(_albedo_colours(np.float32(exposure) * views.maps["albedo"][window])),
            scale=scale,
        )
    shade, gain = pictures.hillshade(np.asarray(views.maps["normals"][window]))
    yield Picture(
        "Detail: raking light",
        f"The same part, light from the upper left. Contrast \N{MULTIPLICATION SIGN} {gain:.2g}.",
        "Relief view of the middle of the field at full resolution",
        pictures.encode(pictures.grey(shade)),
        scale=scale,
    )


def _height(views: Views, height: Array) -> Iterable[Picture]:
    """The height map with axes, and the two profiles marked on it."""
    grid = views.grid
    low, high = pictures.robust_range(height)
    factor, unit = views.height_unit
    image, bar = pictures.coloured(height, (low, high), "viridis", f"Height in {unit}", factor)
    across = 100 * (grid.columns // 2 + 0.5) / (views.columns * views.factor)
    down = 100 * (grid.rows // 2 + 0.5) / (views.rows * views.factor)
    unknown_scale = " Scale not known: heights in pixels." if grid.unit == "px" else ""
    yield Picture(
        "Height",
        f"Height towards the camera, on axes x and y in {grid.unit}; count on differences only. The colours end "
        "at the 0.5th and the 99.5th percentile. Tilt and bow are as measured. The dashed lines are the "
        f"profiles A \N{EN DASH} A\u2032 and B \N{EN DASH} B\u2032 below.{unknown_scale}",
        "Height map in colours from dark blue, low, to yellow, high",
        image,
        bar=bar,
        scale=views.scale,
        layout="wide",
        edges=views.edges(),
        profile=(min(across, 100.0), min(down, 100.0)),
        aspect=views.width / views.tall,
    )
    doubt = views.maps.get("height_uncertainty")
    band = " The grey band is twice its uncertainty to either side." if doubt is not None else ""
    yield Picture(
        "Height profiles",
        f"Height in {unit} along the middle row and the middle column, every pixel; heights are exaggerated "
        f"against lengths.{band}",
        "Two line plots of height along the middle row and the middle column",
        plots.profiles(views.maps["height"], grid, factor, unit, doubt),
        layout="wide",
    )


def _trust(views: Views) -> Iterable[Picture]:
    """Chapter: how far each place of the surface can be trusted."""
    residual, reflection, confidence = (views.of(n) for n in ("residual", "reflection", "confidence"))
    if residual is not None:
        ends = pictures.robust_range(residual, from_zero=True)
        image, bar = pictures.coloured(residual, ends, "magma", "Residual in % of albedo", 100)
        yield Picture(
            "Residual",
            "How far the photographs differ from the model, rms over the lights. Bright places are glossy, "
            "shadowed or moved; their normals deserve doubt.",
            "Map of the residual, dark where the model fits well",
            image,
            bar=bar,
            scale=views.scale,
        )
    if "used" in views.maps:
        yield _lights_used(views)
    if confidence is not None:
        ends = pictures.robust_range(confidence, from_zero=True)
        image, bar = pictures.coloured(confidence, ends, "cividis", "Uncertainty of the normals in °")
        yield Picture(
            "Uncertainty of the normals",
            "68 % of the normals are off by no more than this, by the noise of the photographs and by how well they "
            "agree. Dark colours and places that few lamps reach are less certain. "
            f"{CHECKED_ON}",
            "Map of the uncertainty of the normals, dark where it is small",
            image,
            bar=bar,
            scale=views.scale,
        )
    yield from _height_uncertainty(views)
    if reflection is not None:
        yield _reflection(views, reflection)


def _height_uncertainty(views: Views) -> Iterable[Picture]:
    """Uncertainty of the height, where it is known."""
    doubt = views.of("height_uncertainty")
    if doubt is not None:
        factor, unit = views.height_unit
        ends = pictures.robust_range(doubt, from_zero=True)
        image, bar = pictures.coloured(doubt, ends, "cividis", f"Uncertainty of the height in {unit}", factor)
        yield Picture(
            "Uncertainty of the height",
            "Standard uncertainty after the best constant: by noise, by how well light, level and gloss are known, "
            "and by what the model misses. It does not cover a flat that is not plane.",
            "Map of the uncertainty of the height, dark where it is small",
            image,
            bar=bar,
            scale=views.scale,
        )


def _reflection(views: Views, reflection: Array) -> Picture:
    """Apparent colour less albedo."""
    mean = _grey_mean(reflection)
    image, bar = pictures.coloured(
        mean,
        pictures.robust_range(mean, symmetric=True),
        "RdBu_r",
        "Reflection, on the scale of the albedo",
    )
    return Picture(
        "Reflection",
        "Apparent colour (mean over the lamps) minus albedo, mean of the colours. Gloss shows as red. Slopes "
        "show as pairs of red and blue, on a matt surface too: on average over the lamps, one side of a "
        "stroke is lit more than level ground and the other less. Wide patches of one colour: the light is not "
        "well known.",
        "Map of reflection, red where the apparent colour is brighter than the albedo, blue where darker",
        image,
        bar=bar,
        scale=views.scale,
    )


def _lights_used(views: Views) -> Picture:
    """Chapter: how many lights served at each pixel."""
    f = views.factor
    used = np.asarray(views.maps["used"][f // 2 :: f, f // 2 :: f][: views.rows, : views.columns], int)
    most = max([int(used.max()), *(len(views.maps[n]) for n in ("flat_field", "frames") if n in views.maps)])
    if most <= 16:
        image, bar = pictures.counted(used, most, "Lights used: share of the pixels")
    else:
        image, bar = pictures.coloured(used, (0.0, float(most)), "cividis", "Lights used")
    return Picture(
        "Lights used",
        "How many lamps served at each pixel, the others being overexposed, in shadow or discarded. "
        "Fewer than three: not known.",
        "Map of the number of lights used per pixel",
        image,
        bar=bar,
        scale=views.scale,
    )


def _removed(views: Views, lamps: Sequence[str]) -> Iterable[Picture]:
    """Chapter: what was taken out of the measurement."""
    if "flat_field" in views.maps:
        flat_fields = [_grey_mean(np.asarray(p, np.float64)) for p in views.maps["flat_field"]]
        relative = [p / np.nanmax(p) if np.isfinite(p).any() else p for p in flat_fields]
        low = min((pictures.robust_range(p)[0] for p in relative), default=0.0)
        for i, flat_field in enumerate(relative):
            name = lamps[i] if i < len(lamps) else f"lamp {i + 1}"
            label = "Share of the brightest place"
            image, bar = pictures.coloured(flat_field, (min(low, 0.99), 1.0), "cividis", label)
            caption = f"Brightest to darkest {figure_of(unevenness(views.maps['flat_field'][i]))}."
            yield Picture(
                f"Light of {name}", caption, f"Light of {name} on a flat", image, bar, None, "small"
            )
    trend, bias = views.of("trend"), views.of("bias")
    if trend is not None:
        lowest, highest = extremes(views.maps["trend"]) or (0.0, 0.0)
        spread = highest - lowest
        factor, unit = views.height_unit
        ends = pictures.robust_range(trend)
        image, bar = pictures.coloured(trend, ends, "viridis", f"Trend in {unit}", factor)
        caption = (
            f"Smooth deformation taken out of the height: {figure_of(spread * factor, unit)} {unit} from peak to "
            "valley. True bow of the artwork may be part of it; add it back with trend.tif."
        )
        alt = "Map of the trend removed from the height"
        yield Picture("Trend of the height", caption, alt, image, bar, views.scale)
    if bias is not None:
        angle = bias_angle(bias)
        largest = (extremes(views.maps["bias"], bias_angle) or (0.0, 0.0))[1]
        ends = pictures.robust_range(angle, from_zero=True)
        image, bar = pictures.coloured(angle, ends, "magma", "Bias in degrees")
        caption = (
            "Systematic error of the normals, seen on the flat and taken out: "
            f"{figure_of(largest, '°')}° at most."
        )
        alt = "Map of the bias removed from the normals"
        yield Picture("Bias of the normals", caption, alt, image, bar, views.scale)


def _photographs(views: Views, lamps: Sequence[str]) -> Iterable[Picture]:
    """The photographs, all at the same exposure."""
    if "frames" not in views.maps:
        return
    frames = np.asarray(views.maps["frames"], np.float32)
    white = max(float(np.nanpercentile(frames, 99.5)), 1e-9) if np.isfinite(frames).any() else 1.0
    for i, frame in enumerate(frames):
        name = lamps[i] if i < len(lamps) else f"lamp {i + 1}"
        view = block_means(frame / white, max(1, max(frame.shape[:2]) // 400))
        image = pictures.encode(_albedo_colours(view))
        yield Picture(name, "", f"Photograph of the artwork lit by {name}", image, layout="small")


def _light(views: Views, lights: Mapping[str, Any] | None) -> Iterable[Picture]:
    """Chapter: where the lamps were."""
    if not lights or not (lights.get("positions") or lights.get("directions")):
        return
    near = lights.get("positions") is not None
    unit = views.grid.unit
    caption = (
        f"Seen from the camera, in {unit}; z is a lamp's distance from the plane of the artwork. "
        "The cross is the camera."
        if near
        else "Lamps taken as infinitely far away: the circles are their heights above the horizon."
    )
    alt = "Top view of the lamps around the field"
    image = plots.light_geometry(lights, views.grid)
    yield Picture("Lamps around the field", caption, alt, image, layout="plot")


def chapters(views: Views, record: Mapping[str, Any]) -> list[Chapter]:
    """The chapters of a report that have something to show or to say, in reading order.

    Parameters
    ----------
    views : Views
        The tile's maps.
    record : mapping
        Of which "lamps" (names), "lights" (`LightField.record`) and "white" (reflectance of the
        flat) are shown.
    """
    lamps = [str(name) for name in record.get("lamps") or ()]
    # Matplotlib must not draw in two threads at once: the chapters with plots keep to one.
    with ThreadPoolExecutor(1) as beside:
        plotted = beside.submit(
            lambda: (tuple(_surface(views, record.get("white"))), tuple(_light(views, record.get("lights"))))
        )
        removed, trust = tuple(_removed(views, lamps)), tuple(_trust(views))
        photographs = tuple(_photographs(views, lamps))
        if border := record.get("border"):
            alt = "Small picture of the field, in red what seems to be no part of the artwork"
            photographs = (
                Picture("The artwork's border", border["sentence"], alt, border["image"]),
                *photographs,
            )
        surface, light = plotted.result()
    every = [
        Chapter("surface", "The surface", "", surface),
        Chapter(
            "trust",
            "How far to trust it",
            "Where these pictures are uneven, look at the surface above with care.",
            trust,
        ),
        Chapter(
            "removed",
            "What was removed",
            "Errors of the apparatus, taken out of the measurement and kept, so that they can be judged and "
            "added back."
            if removed
            else "Nothing was taken out of this measurement.",
            removed,
        ),
        Chapter("light", "The light", "", light),
        Chapter("photographs", "The photographs", "Reduced, all at the same exposure.", photographs),
    ]
    return [chapter for chapter in every if chapter.pictures or chapter.anchor == "removed"]
