"""The known-heights detrend: low frequencies of the height from a probe or a scanner."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy.interpolate import RectBivariateSpline

from nlights_core.algorithms import HeightDetrend
from nlights_core.capture_warnings import CaptureWarning, warn
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, KnownHeights
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.known_heights import heights_at, within
from nlights_core.integration.poisson import row_slices
from nlights_core.integration.smooth_bend import Bend, find_bend
from nlights_core.machine.band_threads import in_order

FEWEST = 12
"""Points that are needed: a constant, a tilt and a bow along two axes and across are six numbers, and with fewer than
twelve points one that is wrong by 1 mm was not always told by the others (in simulation)."""

SPREAD = 0.2
"""Share of the field that points must span in x and in y; less tells a bow from nothing."""

CELLS = 12
"""Cells along the longer side, of which each counts as one point where there are more points than `SINGLE`."""

SINGLE = 120
"""Points that count one by one."""

NODES = 48
"""Places along the longer side at which the trend is found; it is much smoother than that."""

DOUBTED = 9
"""Places along each side at which the doubt that is left is looked at."""

BAND = 256
"""Rows that are worked on at once."""


class TiedToKnownHeights(HeightDetrend):
    """The bend in which the height differs from heights that somebody measured, as far as those are surer.

    Only wavelengths of about a quarter of the field and longer; fine relief stays as photographed.
    """

    name: ClassVar[str] = "known-heights"
    needs: ClassVar[tuple[str, ...]] = ("known_heights",)

    bend_mm: float | None = Field(
        default=None,
        gt=0,
        description="standard deviation of the bend that the photographs are thought to make, mm; "
        "absent: found in the known heights",
    )

    def trend(self, height: HeightMap) -> Array:
        """The bend on the whole rectangle, of mean 0.

        Raises
        ------
        TileError
            When there are too few known heights on what is known of the field, or they do not fit one another.
        """
        known = height.known
        if known is None:
            raise TileError("known_heights: is missing; add it to the manifest")
        if height.grid.unit != "mm":
            raise TileError(
                f"{known.source}: known_heights: are in mm, but the scale of the photographs is not known; state "
                "a stand or pixel_size_mm"
            )
        places, values, sigma = _compared(height, known)
        side = max(height.grid.shape) * height.grid.pixel_size
        found = find_bend(places / side, values, sigma, known.tilted, self.bend_mm)
        left = found.left(places / side, values)
        _tell_odd(found, places, left, known)
        _tell_doubt(found, height.grid, known)
        return _surface(found, height.grid)


def _compared(field: HeightMap, known: KnownHeights) -> tuple[Array, Array, Array]:
    """Places (P, 2) mm, differences of the field to known heights, and their uncertainties, mm."""
    inside = within(field, known)
    _tell_outside(~inside, known)
    heights, spread = heights_at(field, known)
    there = np.isfinite(heights)
    places, grid = known.points[there, :2], field.grid
    if len(places) < FEWEST:
        raise TileError(
            f"{known.source}: known_heights: {len(places)} of {len(known.points)} points lie where the surface was "
            f"measured; at least {FEWEST} are needed, spread over the field"
        )
    spans = np.ptp(places, axis=0)
    sides = np.array(grid.shape[::-1]) * grid.pixel_size
    if (spans < SPREAD * sides).any():
        raise TileError(
            f"{known.source}: known_heights: the points span {spans[0]:.3g} x {spans[1]:.3g} mm of a field of "
            f"{sides[0]:.4g} x {sides[1]:.4g} mm; at least a fifth of both sides is needed: measure points all over "
            "the field, and see that lengths are in mm"
        )
    values = heights[there] - known.points[there, 2]
    sigma = np.hypot(known.sigma[there], spread[there])
    if len(values) <= SINGLE:
        return places, values, sigma
    return _per_cell(places, values, sigma, float(sides.max()) / CELLS)


def _per_cell(places: Array, values: Array, sigma: Array, edge: float) -> tuple[Array, Array, Array]:
    """Points of a cell as one, with the uncertainty of one: a scanner errs alike in neighbouring points."""
    columns, rows = np.floor(places / edge).astype(int).T
    _, cell = np.unique(np.stack([rows, columns]), axis=1, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    found = []
    for members in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
        off = np.abs(values[members] - np.median(values[members]))
        kept = members[off <= 4 * 1.4826 * np.median(off) + 1e-12]
        found.append((*places[kept].mean(axis=0), values[kept].mean(), np.median(sigma[kept])))
    table = np.array(found)
    return table[:, :2], table[:, 2], table[:, 3]


def _surface(found: Bend, grid: PixelGrid) -> Array:
    """The bend on every pixel, (H, W) float32, of mean 0 over the rectangle."""
    side = max(grid.shape) * grid.pixel_size
    x, y = grid.x() / side, grid.y() / side
    along, down = (_nodes(axis) for axis in (x, y))
    nodes = np.stack(np.meshgrid(along, down), axis=-1).reshape(-1, 2)
    values = found.at(nodes).reshape(len(down), len(along))
    spline = RectBivariateSpline(down, along, values - values.mean())
    surface = np.empty(grid.shape, np.float32)

    def fill(lines: slice) -> None:
        rows = y[lines][::-1]  # a spline wants them to rise
        surface[lines] = spline(rows, x)[::-1]

    for _ in in_order(fill, row_slices(grid.rows, BAND)):
        pass
    return surface


def _nodes(axis: Array) -> Array:
    """Places along an axis, rising, a little more than the field."""
    ends = sorted((float(axis[0]), float(axis[-1])))
    count = max(4, round(NODES * (ends[1] - ends[0])))
    margin = 1e-6 + 0.01 * (ends[1] - ends[0])
    return np.linspace(ends[0] - margin, ends[1] + margin, count)


def _listed(places: Array) -> str:
    few = ", ".join(f"({x:.4g}, {y:.4g})" for x, y in places[:5])
    return few + (f" and {len(places) - 5} more" if len(places) > 5 else "")


def _tell_outside(outside: Array, known: KnownHeights) -> None:
    """Warn of points beside the field."""
    count = int(outside.sum())
    if count:
        warn(
            CaptureWarning(
                "known-heights-outside",
                f"{known.source}: {count} of {len(outside)} known heights lie outside the field, at x, y = "
                f"{_listed(known.points[outside, :2])} mm, and were not used: see that they are in this tile's plane "
                "frame",
                value=float(count),
                unit="points",
            )
        )


def _tell_odd(found: Bend, places: Array, left: Array, known: KnownHeights) -> None:
    """Warn of points without a say, and of uncertainties that were stated too small; refuse what fits nowhere."""
    odd = ~found.used
    if not found.settled:
        raise TileError(
            f"{known.source}: known_heights: the {len(left)} points agree neither with one another "
            "nor with a smooth bend of the photographs; see that they lie on this artwork, in this tile's plane "
            "frame, in mm, and that z rises towards the camera"
        )
    if odd.any():
        worst = float(np.abs(left[odd]).max())
        warn(
            CaptureWarning(
                "known-heights-odd",
                f"{known.source}: {int(odd.sum())} of {len(left)} known heights agree neither with the others nor "
                f"with the photographs, by up to {worst:.2g} mm, at x, y = {_listed(places[odd])} mm, and had no "
                "say: measure them again",
                value=worst,
                unit="mm",
            )
        )
    if found.widths.factor > 1:
        warn(
            CaptureWarning(
                "known-heights-scatter",
                f"{known.source}: the known heights scatter about {found.widths.factor:g} times as much as their "
                "sigma_mm says, and count that much less: see what their uncertainty is, and that of x and y "
                "(registration_mm)",
                value=found.widths.factor,
                unit="times sigma_mm",
            )
        )


def _tell_doubt(found: Bend, grid: PixelGrid, known: KnownHeights) -> None:
    """Warn where the points leave a part of the field as it was photographed."""
    side = max(grid.shape) * grid.pixel_size
    ends = [np.linspace(axis[0], axis[-1], DOUBTED) for axis in (grid.x(), grid.y())]
    nodes = np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 2)
    after, before = found.doubt(nodes / side)
    worst = int(np.argmax(after))
    if after[worst] > max(0.5 * before[worst], 2 * float(np.median(after)), 0.02):
        x, y = nodes[worst]
        warn(
            CaptureWarning(
                "known-heights-sparse",
                f"{known.source}: no known height is near x {x:.4g}, y {y:.4g} mm: there the height may still be "
                f"bent by {after[worst]:.2g} mm (standard uncertainty), elsewhere by {np.median(after):.2g}; measure "
                " points there too",
                value=float(after[worst]),
                unit="mm",
            )
        )
