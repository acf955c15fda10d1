"""Uncertainty of a height: noise that integration carries along, and coarse maps on the photograph's grid."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array, PixelGrid
from nlights_core.solving.least_squares import COVERING


def height_noise(confidence: float, grid: PixelGrid) -> float:
    """Standard deviation of a height, about its mean, by independent noise of the normals.

    Slopes of variance v are integrated by a Poisson equation, whose eigenvalues are ``4 - 2 cos a - 2 cos b``: the
    variance of the height is ``v s^2`` times the mean of their inverses, s the pixel size.

    Parameters
    ----------
    confidence : float
        Angle within which 68 % of the normals lie, degrees.
    grid : PixelGrid

    Returns
    -------
    float
        In the grid's unit.
    """
    slope = np.radians(confidence) / COVERING
    rows, columns = (np.cos(np.pi * np.arange(length) / length) for length in grid.shape)
    total = 0.0
    for cosine in rows:
        eigenvalues = 4 - 2 * cosine - 2 * columns
        total += float(np.sum(1 / eigenvalues[eigenvalues > 1e-12]))
    return float(slope * grid.pixel_size * np.sqrt(total / (grid.rows * grid.columns)))


class Stretched:
    """A coarse map stretched over the photograph, by linear interpolation; ask it for rows.

    Parameters
    ----------
    coarse : (h, w) array
        Over the whole field.
    shape : (int, int)
        Rows and columns of the photographs.

    Examples
    --------
    >>> Stretched(np.array([[1, 3]], np.float32), (1, 4))[0:1]
    array([[1. , 1.5, 2.5, 3. ]], dtype=float32)
    """

    def __init__(self, coarse: Array, shape: tuple[int, int]) -> None:
        left, right, share = _between(shape[1], coarse.shape[1])
        self._wide = (coarse[:, left] * (1 - share) + coarse[:, right] * share).astype(np.float32)
        self._above, self._below, self._down = _between(shape[0], coarse.shape[0])

    def __getitem__(self, rows: slice) -> Array:
        """Some rows, (n, W) float32."""
        down = self._down[rows, None]
        return np.asarray(self._wide[self._above[rows]] * (1 - down) + self._wide[self._below[rows]] * down)


def _between(length: int, parts: int) -> tuple[Array, Array, Array]:
    """Parts before and after each pixel of a line, and how near it is to the latter."""
    place = np.clip((np.arange(length) + 0.5) * parts / length - 0.5, 0, parts - 1)
    before = np.minimum(place.astype(np.intp), max(parts - 2, 0))
    return before, np.minimum(before + 1, parts - 1), (place - before).astype(np.float32)
