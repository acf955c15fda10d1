"""Plots of the report, drawn with Matplotlib: height profiles and the places of the lamps."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nlights_core.frames import Array, PixelGrid
from nlights_core.report.pictures import data_uri

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET, ACCENT, SECOND = "#25221e", "#6b655c", "#8a2f1d", "#1f5673"


def _figure(width: float, height: float) -> Figure:
    """A Matplotlib figure on the raster canvas, outside pyplot's global state; inches at 160 dpi.

    Its margins are given, not found: to find them a figure is drawn once more.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=160, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _finish(figure: Figure) -> str:
    """The figure as a PNG without date or version."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return data_uri("png", stream.getvalue())


def _plain(axes: Axes) -> None:
    """Quiet axes: two spines, light grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=INK, labelsize=10)
    axes.grid(color="#e4e0d8", linewidth=0.7)
    axes.set_axisbelow(True)


def profiles(
    height: Array, grid: PixelGrid, scale: float, unit: str, uncertainty: Array | None = None
) -> str:
    """Height along the middle row (A to A') and the middle column (B to B').

    Parameters
    ----------
    height : (H, W) array
        Every pixel, NaN where not known; only one row and one column are read.
    grid : PixelGrid
        Where the pixels are.
    scale : float
        ``height * scale`` is in ``unit``.
    unit : str
        Of the drawn heights.
    uncertainty : (H, W) array, optional
        Standard uncertainty of the height; twice of it is drawn to either side.

    Returns
    -------
    str
        Data URI.
    """
    figure = _figure(7.5, 5.4)
    figure.subplots_adjust(left=0.115, right=0.985, bottom=0.095, top=0.95, hspace=0.44)
    lines: tuple[tuple[str, Array, Any, str], ...] = (
        ("A \N{EN DASH} A\u2032  along x, left to right", grid.x(), (grid.rows // 2, slice(None)), ACCENT),
        ("B \N{EN DASH} B\u2032  along y, bottom to top", grid.y(), (slice(None), grid.columns // 2), SECOND),
    )
    for i, (title, place, line, colour) in enumerate(lines, start=1):
        axes = figure.add_subplot(2, 1, i)
        marker = "." if len(place) < 50 else ""
        z = np.asarray(height[line], float) * scale
        if uncertainty is not None:
            doubt = 2 * np.asarray(uncertainty[line], float) * scale
            axes.fill_between(place, z - doubt, z + doubt, color=QUIET, alpha=0.35, linewidth=0)
        axes.plot(place, z, color=colour, linewidth=0.9, marker=marker)
        half = 0.5 * len(place) * grid.pixel_size
        axes.set_xlim(-half, half)
        axes.set_title(title, loc="left", fontsize=11, color=colour)
        axes.set_xlabel(f"{'xy'[i - 1]} in {grid.unit}", fontsize=10, color=INK)
        axes.set_ylabel(f"height in {unit}", fontsize=10, color=INK)
        _plain(axes)
    return _finish(figure)


def light_geometry(lights: Mapping[str, Any], grid: PixelGrid) -> str:
    """The picture that `draw_lights` draws, as a data URI."""
    return _finish(draw_lights(lights, grid)[0])


def draw_lights(lights: Mapping[str, Any], grid: PixelGrid) -> tuple[Figure, Axes]:
    """Top view of the lamps around the field, as the light field's record states them.

    Parameters
    ----------
    lights : mapping
        `LightField.record`: "lamps" and either "positions" (near) or "directions" (distant).
    grid : PixelGrid
        Where the field is.

    Returns
    -------
    Figure
    Axes
        With the lamps' names as its texts.
    """
    from matplotlib.patches import Circle, Rectangle

    figure = _figure(6.4, 5.6)
    figure.subplots_adjust(left=0.135, right=0.985, bottom=0.09, top=0.985)
    axes = figure.add_subplot()
    near = lights.get("positions") is not None
    places = np.array(lights["positions"] if near else lights["directions"], float)
    if near:
        width, tall = grid.columns * grid.pixel_size, grid.rows * grid.pixel_size
        reach = 0.6 * max(width, tall / 0.85)
        axes.add_patch(Rectangle((-width / 2, -tall / 2), width, tall, facecolor="#ece6d8", edgecolor=QUIET))
        axes.annotate("field", (0, -tall / 2), (0, 5), textcoords="offset points", ha="center", color=QUIET)
        if grid.camera is not None:
            axes.plot(*grid.camera[:2], "+", color=SECOND, markersize=12, markeredgewidth=2)
        notes = [f"z {z:.0f} {grid.unit}" for z in places[:, 2]]
        axes.set_xlabel(f"x in {grid.unit}")
        axes.set_ylabel(f"y in {grid.unit}")
    else:
        reach = 1.3
        for elevation in (0, 30, 60):
            radius = float(np.cos(np.radians(elevation)))
            axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor="#bdb6a8", linewidth=0.8))
            axes.annotate(f"{elevation}°", (0, -radius), ha="center", va="bottom", color=QUIET, fontsize=9)
        notes = [f"{np.degrees(np.arcsin(np.clip(z, -1, 1))):.0f}°" for z in places[:, 2]]
        axes.set_xlabel("x of the direction")
        axes.set_ylabel("y of the direction")
    _label_lamps(axes, lights["lamps"], places, notes)
    # Room for the names beside the lamps, in the figure's own proportions.
    across = max(1.5 * np.abs(places[:, 0]).max(), 1.4 * np.abs(places[:, 1]).max(), reach)
    axes.set(xlim=(-across, across), ylim=(-0.85 * across, 0.85 * across), aspect="equal")
    _plain(axes)
    return figure, axes


def _label_lamps(axes: Axes, names: Sequence[str], places: Array, notes: Sequence[str]) -> None:
    """Mark every lamp with its name, off the line to the centre.  Many lamps: dots only."""
    axes.plot(places[:, 0], places[:, 1], "o", color="#e0a526", markeredgecolor=ACCENT, markersize=9)
    if len(names) > 24:
        return
    radius = np.hypot(places[:, 0], places[:, 1])
    for name, place, note, inner in zip(names, places, notes, radius < np.median(radius), strict=True):
        # Lamps often stand in pairs, one behind the other: the two names go to different sides of their line.
        side = -1 if inner else 1
        beside = abs(place[0]) >= abs(place[1])
        axes.annotate(
            f"{name}\n{note}",
            (place[0], place[1]),
            (0, 8 * side) if beside else (8 * side, 0),
            textcoords="offset points",
            ha="center" if beside else "left" if side > 0 else "right",
            va="center" if not beside else "bottom" if side > 0 else "top",
            fontsize=9,
            color=INK,
            parse_math=False,
        )
