"""Pictures of the report: small views of large maps, as data URIs.

Everything here works on reduced views (`LONGEST` pixels at most).  Scale bars, colour bars and
axes are text around a picture, not part of it, so that they stay legible at any width.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import read_only
from nlights_core.report.figures import figure_of

LONGEST = 1200
"""Longest side of a picture, px."""

NOT_KNOWN = "#b4b4b4"
"""Mean colour of the grey hatching of what is not known."""

Tick = tuple[float, str]
"""Where a label stands along an edge, in percent from the left (or top), and what it says."""


@dataclass(frozen=True)
class ColourBar:
    """Legend of a picture's colours.

    Parameters
    ----------
    label : str
        Quantity and unit.
    strip : str
        The colours from left to right, as a data URI; empty where there are swatches.
    ticks : tuple of Tick
        Values along the strip.
    swatches : tuple of (str, str)
        Colour and meaning of each step, for counts.
    """

    label: str
    strip: str = ""
    ticks: tuple[Tick, ...] = ()
    swatches: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Picture:
    """A picture with everything that is said about it.

    Parameters
    ----------
    title, caption, alt : str
        Its heading, its explanation, and its description for those who cannot see it.
    image : str
        Data URI.
    bar : ColourBar, optional
        What its colours mean.
    scale : Tick, optional
        Scale bar: width in percent of the picture's, and length.
    layout : {"half", "wide", "small"}
        Room on the page.
    edges : (tuple of Tick, tuple of Tick), optional
        Positions along the lower edge (from the left) and the left edge (from the top).
    profile : (float, float), optional
        Where the profiles were taken: column and row, percent.
    aspect : float
        Width by height of the picture, where a tall one must be kept to the page.
    """

    title: str
    caption: str
    alt: str
    image: str
    bar: ColourBar | None = None
    scale: Tick | None = None
    layout: str = "half"
    edges: tuple[tuple[Tick, ...], tuple[Tick, ...]] | None = None
    profile: tuple[float, float] | None = None
    aspect: float = 4 / 3


def view_factor(shape: tuple[int, ...]) -> int:
    """Edge of the pixel blocks that make a picture of at most `LONGEST` pixels."""
    return max(1, min(-(-max(shape[:2]) // LONGEST), shape[0], shape[1]))


def data_uri(kind: str, content: bytes) -> str:
    """A file as an address, so that a page can hold it."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def encode(colours: Array, *, lossless: bool = False) -> str:
    """A picture as a data URI: JPEG, or PNG where its colours are few and must be exact.

    Parameters
    ----------
    colours : (h, w, 3) uint8 array
        sRGB.
    lossless : bool
        PNG rather than JPEG.
    """
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(colours))
    stream = io.BytesIO()
    if lossless:
        image.save(stream, "PNG", optimize=True)
    else:
        image.save(stream, "JPEG", quality=88, subsampling=0)
    return data_uri("png" if lossless else "jpeg", stream.getvalue())


def hatch(colours: Array, known: Array) -> Array:
    """Cover what is not known with grey hatching, which no colour scale contains.

    Parameters
    ----------
    colours : (h, w, 3) uint8 array
        Pictures of under 300 pixels are first enlarged without smoothing, so that single pixels
        stay visible and the hatching is finer than they are.
    known : (h, w) bool array
        False: hatched.

    Returns
    -------
    (h, w, 3) uint8 array
        Or a multiple of that size.
    """
    from nlights_core.report import compiled_pictures

    times = max(1, 600 // max(known.shape))
    out = np.empty((known.shape[0] * times, known.shape[1] * times, 3), np.uint8)
    shown, valid = (read_only(np.ascontiguousarray(array)) for array in (colours, known))
    compiled_pictures.hatched(shown, valid, times, out)
    return out


def robust_range(values: Array, *, symmetric: bool = False, from_zero: bool = False) -> tuple[float, float]:
    """Range of a colour scale: the 0.5th to the 99.5th percentile of what is known.

    Parameters
    ----------
    values : array
        NaN where not known.
    symmetric : bool
        Equally far to both sides of 0.
    from_zero : bool
        Start at 0.

    Returns
    -------
    low, high : float
        Never equal.
    """
    known = values[np.isfinite(values)]
    low, high = 0.0, 1.0
    if known.size:
        low, high = (float(end) for end in np.percentile(known, [0.5, 99.5]))
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if from_zero:
        low = min(0.0, low)
    if high - low <= 1e-9 * max(abs(low), abs(high), 1e-6):
        half = max(0.05 * abs(high), 1e-6)
        low, high = (low if from_zero else low - half), high + half
    return low, high


def nice_step(span: float, intervals: int) -> float:
    """A step of 1, 2 or 5 times a power of ten that cuts a span into about so many intervals."""
    rough = span / intervals
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * min((1, 2, 5, 10), key=lambda m: abs(np.log(m * power / rough))))


def edge_ticks(low: float, high: float, intervals: int = 5) -> tuple[Tick, ...]:
    """Round values between two ends, with their places in percent from ``low``."""
    step = nice_step(abs(high - low), intervals)
    first, last = np.ceil(min(low, high) / step - 1e-9), np.floor(max(low, high) / step + 1e-9)
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    values = step * np.arange(first, last + 1)
    labels = [f"{v + 0.0:.{digits}f}".replace("-", "\N{MINUS SIGN}") for v in np.round(values, digits)]
    return tuple(
        (100 * (float(v) - low) / (high - low), label) for v, label in zip(values, labels, strict=True)
    )


def scale_bar(width: float, unit: str) -> Tick:
    """A scale bar of a round length, about a fifth of the picture: its width in percent, its label."""
    length = nice_step(width, 5)
    return 100 * length / width, f"{length:g} {unit}"


def coloured(
    values: Array, ends: tuple[float, float], colours: str, label: str, scale: float = 1.0
) -> tuple[str, ColourBar]:
    """A map in a perceptually uniform colour scale, and its colour bar.

    Parameters
    ----------
    values : (h, w) array
        NaN where not known.
    ends : (low, high)
        Values of the first and the last colour; beyond them the colours stay.
    colours : str
        Name of a Matplotlib colour map.
    label : str
        Quantity and unit.
    scale : float
        The colour bar shows ``values * scale``.
    """
    from matplotlib import colormaps

    from nlights_core.report import compiled_pictures

    low, high = ends
    table = (colormaps[colours](np.arange(256))[:, :3] * 255 + 0.5).astype(np.uint8)
    places = np.empty(values.shape, np.uint8)
    kind = values.dtype.type if values.dtype.kind == "f" else np.float64
    compiled_pictures.levels(values, kind(low), kind(high), kind(high - low), places)
    picture = hatch(table[places], np.isfinite(values))
    strip = encode(np.broadcast_to(table, (1, 256, 3)), lossless=True)
    return encode(picture), ColourBar(label, strip, edge_ticks(low * scale, high * scale))


def counted(counts: Array, most: int, one: str) -> tuple[str, ColourBar]:
    """A map of whole numbers in one colour each, with the shares from 0.05 % on; 0 is hatched.

    Parameters
    ----------
    counts : (h, w) integer array
    most : int
        Largest possible count, at most 16.
    one : str
        What is counted.
    """
    from matplotlib import colormaps

    table = (colormaps["plasma"](np.linspace(0, 1, most + 1))[:, :3] * 255 + 0.5).astype(np.uint8)
    share = 100 * np.bincount(np.minimum(counts, most).ravel(), minlength=most + 1) / counts.size
    colours = [NOT_KNOWN, *(f"#{bytes(row).hex()}" for row in table[1:])]
    swatches = tuple(
        (colours[i], f"{i}: {figure_of(float(share[i]), '% of pixels')} %")
        for i in range(most + 1)
        if share[i] >= 0.05
    )
    picture = hatch(table[np.minimum(counts, most)], counts > 0)
    return encode(picture, lossless=True), ColourBar(one, swatches=swatches)


def hillshade(normals: Array, azimuth_deg: float = 135.0, elevation_deg: float = 25.0) -> tuple[Array, float]:
    """The surface in raking light, computed from its normals (Lambert's law, no cast shadows).

    Parameters
    ----------
    normals : (h, w, 3) array
        NaN where not known.
    azimuth_deg, elevation_deg : float
        Where the light comes from: counter-clockwise from x (135: upper left), and above the plane.

    Returns
    -------
    shade : (h, w) float64 array
        From 0 to 1, 0.5 where the surface has its median inclination; NaN where not known.
    gain : float
        By how much the contrast was raised (or lowered) to make the relief visible.
    """
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    light = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    length = np.linalg.norm(normals, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = (normals.astype(np.float64) @ np.array(light)) / (length * np.sin(elevation))
    known = np.isfinite(relative)
    if not known.any():
        return relative, 1.0
    relative -= np.median(relative[known])
    contrast = float(np.percentile(np.abs(relative[known]), 99))
    gain = 0.45 / max(contrast, 0.01)
    return np.clip(0.5 + gain * relative, 0, 1), gain


def grey(shade: Array) -> Array:
    """Values from 0 to 1 as neutral colours (h, w, 3) uint8; NaN hatched."""
    known = np.isfinite(shade)
    level = (np.where(known, shade, 0) * 255 + 0.5).astype(np.uint8)
    return hatch(np.repeat(level[..., None], 3, axis=2), known)
