"""Statistics of large maps, by bands of rows.

Means, shares and extremes are taken over every pixel; medians and percentiles over a regular sample
of at most `SAMPLE` pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nlights_core.band_threads import in_order
from nlights_core.export import bands
from nlights_core.frames import Array, PixelGrid

SAMPLE = 2_000_000

STEEPEST = float(np.tan(np.radians(70)))
"""Slopes are limited to this, as in `NormalField.gradient`."""


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
    places = bands(array.shape[0], array[:1].nbytes)
    for part, known in in_order(lambda band: _sum(_values(array, band, of)), places):
        total, count = total + part, count + known
    return total / count if count else None


def _values(array: Array, band: slice, of: Callable[[Array], Any] | None) -> Array:
    """A band, or what is computed from it."""
    return np.asarray(array[band] if of is None else of(array[band]))


def _sum(values: Array) -> tuple[float, int]:
    """Sum, in float64, and number of the known ones."""
    from nlights_core import compiled_maps

    if values.dtype.kind != "f":
        return float(values.sum(dtype=np.int64)), values.size
    return compiled_maps.sum_of_known(np.ascontiguousarray(values).reshape(-1))


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

    def ends(band: slice) -> tuple[float, float]:
        values = _values(array, band, of)
        known = np.isfinite(values)
        return (
            float(np.min(values, where=known, initial=np.inf)),
            float(np.max(values, where=known, initial=-np.inf)),
        )

    found = list(in_order(ends, bands(array.shape[0], array[:1].nbytes)))
    low, high = min(pair[0] for pair in found), max(pair[1] for pair in found)
    return (low, high) if low <= high else None


def bias_angle(bias: Array) -> Array:
    """Angle by which a difference of unit vectors (..., 3) turns a normal, degrees (...)."""
    length = np.sqrt((np.asarray(bias, np.float64) ** 2).sum(axis=-1))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1, length / 2))))


def unevenness(reading: Array) -> float | None:
    """Brightest over darkest place of a white plate (h, w, C), by the mean of its colours."""
    values = np.asarray(reading, np.float64).mean(axis=-1)
    values = values[np.isfinite(values) & (values > 0)]
    return float(values.max() / values.min()) if values.size else None


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
    from nlights_core import compiled_maps

    def squares(band: slice) -> tuple[float, int]:
        return compiled_maps.misclosure(normals[band.start : band.stop + 1], STEEPEST)

    found = list(in_order(squares, bands(grid.rows, normals[:1].nbytes)))
    count = sum(known for _, known in found)
    return float(grid.pixel_size * np.sqrt(sum(total for total, _ in found) / count)) if count else None


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
    from nlights_core import compiled_maps

    x = grid.x()

    def sums(band: slice) -> tuple[Array, Array]:
        part = np.empty((3, 3)), np.empty(3)
        compiled_maps.plane_sums(height[band], x, grid.y(band.start, band.stop), *part)
        return part

    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for products, heights in in_order(sums, bands(grid.rows, height[:1].nbytes)):
        matrix += products
        right += heights
    if np.linalg.matrix_rank(matrix / np.max(np.abs(matrix), initial=1.0)) < 3:
        return None
    a, b, c = np.linalg.solve(matrix, right)
    return float(a), float(b), float(c)
