"""Statistics of large maps, by bands of rows.

Means, shares and extremes are taken over every pixel; medians and percentiles over a regular sample
of at most `SAMPLE` pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nlights_core.files.reduction import bands_of_bytes
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order

SAMPLE = 2_000_000

STEEPEST = float(np.tan(np.radians(70)))
"""Slopes are limited to this, as in `NormalField.gradient`."""


def mean_of(array: Array) -> float | None:
    """Mean over what is known.

    Parameters
    ----------
    array : (H, W, ...) float array
        NaN where not known.

    Returns
    -------
    float or None
        None where nothing is known.
    """
    from nlights_core.report import compiled_statistics

    total, known = _added(lambda band: compiled_statistics.known_sum(_flat(array[band])), array)
    return float(total / known) if known else None


def summarise_counts(array: Array, least: int = 1, inside: int | None = None) -> tuple[float, float] | None:
    """Mean of whole numbers, and the share of them that are at least ``least``.

    Parameters
    ----------
    array : (H, W) array of unsigned integers
        0 outside the mask.
    least : int
        At least 1.
    inside : int, optional
        How many pixels are inside the mask; all of them where there is none.

    Returns
    -------
    (mean, share) or None
        None where there is no pixel.
    """
    from nlights_core.report import compiled_statistics

    count = array.size if inside is None else inside
    if not count:
        return None
    total, enough = _added(lambda band: compiled_statistics.sum_counts(_flat(array[band]), least), array)
    return total / count, enough / count


def inclination(normals: Array) -> tuple[float, float | None]:
    """Share of the normals (H, W, 3) that are known, and the mean of their angles to z, degrees.

    The angle is None where nothing is known.
    """
    from nlights_core.report import compiled_statistics

    def sums(band: slice) -> tuple[float, int]:
        return compiled_statistics.inclinations(_flat(normals[band]).reshape(-1, 3))

    total, known = _added(sums, normals)
    share = known / max(1, normals.size // 3)
    return share, float(np.degrees(total / known)) if known else None


def _flat(band: Array) -> Array:
    """A band in one dimension, as the compiled loops take it."""
    return np.ascontiguousarray(band).reshape(-1)


def _added(sums: Callable[[slice], tuple[Any, Any]], array: Array) -> tuple[Any, Any]:
    """Two sums over all bands of rows, added in their order."""
    found = list(in_order(sums, bands_of_bytes(array.shape[0], array[:1].nbytes)))
    return sum(first for first, _ in found), sum(second for _, second in found)


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
        values = np.asarray(array[band] if of is None else of(array[band]))
        known = np.isfinite(values)
        return (
            float(np.min(values, where=known, initial=np.inf)),
            float(np.max(values, where=known, initial=-np.inf)),
        )

    found = list(in_order(ends, bands_of_bytes(array.shape[0], array[:1].nbytes)))
    low, high = min(pair[0] for pair in found), max(pair[1] for pair in found)
    return (low, high) if low <= high else None


def bias_angle(bias: Array) -> Array:
    """Angle by which a difference of unit vectors (..., 3) turns a normal, degrees (...)."""
    length = np.sqrt((np.asarray(bias, np.float64) ** 2).sum(axis=-1))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(1, length / 2))))


def unevenness(reading: Array) -> float | None:
    """Brightest over darkest place of a flat field (h, w, C), by the mean of its colours."""
    values = np.asarray(reading, np.float64).mean(axis=-1)
    values = values[np.isfinite(values) & (values > 0)]
    return float(values.max() / values.min()) if values.size else None


def misclosure(normals: Array, grid: PixelGrid) -> float | None:
    """Misclosure of heights on a walk once round a pixel: the curl of the slopes.

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
    from nlights_core.report import compiled_statistics

    def squares(band: slice) -> tuple[float, int]:
        # One row more: its squares with the band's last.
        part = np.ascontiguousarray(normals[band.start : band.stop + 1])
        return compiled_statistics.sum_misclosures(part, np.float32(STEEPEST))

    total, count = _added(squares, normals)
    return float(grid.pixel_size * np.sqrt(total / count)) if count else None


class Relief(NamedTuple):
    """Spread and best plane of a height map.

    Attributes
    ----------
    rms : float
        Of the known heights about their mean, in the grid's unit.
    plane : (a, b, c) or None
        Least-squares plane ``z = a x + b y + c``: slopes (dimensionless) and offset (the grid's
        unit); None where fewer than three pixels that are not on a line are known.
    """

    rms: float
    plane: tuple[float, float, float] | None


def relief(height: Array, grid: PixelGrid, level: float = 0.0) -> Relief | None:
    """Spread and best plane of a height map, in one look at it.

    Parameters
    ----------
    height : (H, W) float32 array
        NaN where not known.
    grid : PixelGrid
        Where the pixels are.
    level : float
        About where the heights are: sums that count from there keep all their digits.

    Returns
    -------
    Relief or None
        None where nothing is known.
    """
    from nlights_core.report import compiled_statistics

    x = grid.x()

    def sums(band: slice) -> tuple[Array, Array, float]:
        part = np.empty((3, 3)), np.empty(3)
        y = grid.y(band.start, band.stop)
        return *part, compiled_statistics.height_sums(height[band], level, x, y, *part)

    matrix, right, square = np.zeros((3, 3)), np.zeros(3), 0.0
    for products, heights, squares in in_order(sums, bands_of_bytes(grid.rows, height[:1].nbytes)):
        matrix += products
        right += heights
        square += squares
    count = matrix[2, 2]
    if not count:
        return None
    rms = float(np.sqrt(max(0.0, square / count - (right[2] / count) ** 2)))
    if np.linalg.matrix_rank(matrix / np.max(np.abs(matrix), initial=1.0)) < 3:
        return Relief(rms, None)
    a, b, c = np.linalg.solve(matrix, right)
    return Relief(rms, (float(a), float(b), float(c) + level))
