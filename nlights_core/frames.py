"""The plane frame, its units and the pixel grid: said once, here.

Arrays are indexed ``[row, column]`` with row 0 at the top of the photograph.  The *plane
frame* is right-handed and in millimetres: **x right, y up, z from the artwork towards the
camera**, its origin at the centre of the tile's field.  (The rival convention of image
processing, y down and z away from the camera, is never used for a stored quantity.)

Pixel ``(r, c)`` is the ray from the camera through the point of the plane

    x = (c - (W - 1) / 2) s        y = ((H - 1) / 2 - r) s        z = 0

where ``s`` is the pixel size: the field's width divided by the number of columns.

Pixels are float32, calibration is float64, and **NaN means not known**.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Any NumPy array; shapes, dtypes and units are in the docstrings."""


@dataclass(frozen=True)
class PixelGrid:
    """The photograph's pixels, placed on the plane of the artwork.

    Parameters
    ----------
    rows, columns : int
        Size of the photograph in pixels.
    pixel_size : float
        Edge of a pixel on the plane, mm (or 1 where the scale is not known).
    camera : tuple of 3 floats, optional
        Centre of projection in the plane frame, mm.  None: an orthographic camera.
    unit : {"mm", "px"}
        What lengths on this grid are measured in.
    centre : tuple of 2 floats
        x and y of the grid's centre, mm: 0 for a photograph, but not for blocks of its pixels that leave a rest.
    """

    rows: int
    columns: int
    pixel_size: float
    camera: tuple[float, float, float] | None = None
    unit: Literal["mm", "px"] = "mm"
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    def x(self) -> Array:
        """x of every column where its ray meets the plane, (columns,) float64, mm."""
        return self.centre[0] + (np.arange(self.columns) - (self.columns - 1) / 2) * self.pixel_size

    def y(self, start: int = 0, stop: int | None = None) -> Array:
        """y of rows ``start`` to ``stop`` where their rays meet the plane, float64, mm."""
        rows = np.arange(start, self.rows if stop is None else stop)
        return self.centre[1] + ((self.rows - 1) / 2 - rows) * self.pixel_size

    def reduced(self, factor: int, whole: bool = True) -> PixelGrid:
        """The grid of blocks of ``factor`` x ``factor`` pixels, from the first row and column on.

        Parameters
        ----------
        factor : int
            Edge of a block, px.
        whole : bool
            Whether rows and columns that fill no block are left out; else the last blocks lie in part beside
            the photograph.
        """
        rows, columns = (size // factor if whole else -(-size // factor) for size in self.shape)
        right, down = (columns * factor - self.columns) / 2, (rows * factor - self.rows) / 2
        centre = self.centre[0] + right * self.pixel_size, self.centre[1] - down * self.pixel_size
        return PixelGrid(rows, columns, self.pixel_size * factor, self.camera, self.unit, centre)

    def points(self, start: int, stop: int, height: Array | None = None) -> Array:
        """Points of the surface seen by the pixels of a band of rows.

        A point at height z seen through the pixel at (x0, y0) lies, for a camera at C, at
        ``x = x0 + (Cx - x0) z / Cz`` (and likewise y): perspective.

        Parameters
        ----------
        start, stop : int
            The band of rows.
        height : (stop - start, columns) array, optional
            z in mm; NaN is taken as 0.  None: the plane.

        Returns
        -------
        (3, stop - start, columns) float32 array
            x, y, z in mm.
        """
        points = np.zeros((3, stop - start, self.columns), np.float32)
        points[0] = self.x()[None, :]
        points[1] = self.y(start, stop)[:, None]
        if height is not None:
            z = np.nan_to_num(np.asarray(height, np.float32), nan=0.0)
            if self.camera is not None:
                shift = z / np.float32(self.camera[2])
                points[0] += (np.float32(self.camera[0]) - points[0]) * shift
                points[1] += (np.float32(self.camera[1]) - points[1]) * shift
            points[2] = z
        return points
