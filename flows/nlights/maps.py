"""Maps: arrays of pixels that know where their pixels are and what their numbers count."""

from __future__ import annotations

from typing import Any

import numpy as np

from nlights_core.frames import Array, PixelGrid


class Map(np.ndarray[Any, np.dtype[Any]]):
    """An array with a `grid` and a `unit`; use it wherever an array goes.

    What is cut out of a map or computed from it is a plain array: its pixels or its numbers are others,
    so it has neither grid nor unit.  A map of a product is read-only and mapped from its file.

    Parameters
    ----------
    values : (H, W) or (H, W, C) array
        The numbers, which are not copied; NaN where not known.
    grid : PixelGrid
        Where the pixels are, of H rows and W columns.
    unit : str
        Of the numbers: "mm", "px", "°"; empty for a ratio or a unit vector.

    Raises
    ------
    ValueError
        When the array does not lie on the grid.

    Examples
    --------
    >>> height = Map(np.zeros((2, 3)), PixelGrid(2, 3, 0.5), "mm")
    >>> height.unit, height.grid.pixel_size
    ('mm', 0.5)
    >>> type(height + 1) is type(height[0]) is np.ndarray
    True
    """

    _place: tuple[PixelGrid, str] | None

    def __new__(cls, values: Array, grid: PixelGrid, unit: str) -> Map:
        """See the class."""
        if np.shape(values)[:2] != grid.shape:
            raise ValueError(
                f"values: of shape {np.shape(values)}, which does not lie on a grid of {grid.rows} x {grid.columns} "
                "pixels"
            )
        made: Map = np.asanyarray(values).view(cls)
        made._place = grid, unit
        return made

    def __array_finalize__(self, source: Any) -> None:
        # Whether a view or a copy still is the whole map in its order cannot be told here, so it has no place.
        self._place = None

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        return np.asarray(part) if isinstance(part, Map) else part

    def __reduce__(self) -> Any:
        build, arguments, state = tuple(super().__reduce__())
        return build, arguments, (state, self._place)

    def __setstate__(self, state: Any) -> None:
        own, self._place = state
        super().__setstate__(own)

    def copy(self, order: Any = "C") -> Map:
        """Copy the map, with its place; the copy can be written to."""
        found = super().copy(order)
        found._place = self._place
        return found

    @property
    def is_whole(self) -> bool:
        """Tell whether this is a whole map, with grid and unit, and no view of one."""
        return self._place is not None

    @property
    def grid(self) -> PixelGrid:
        """Grid of the pixels.

        Raises
        ------
        AttributeError
            For what was made of a map.
        """
        return self._whole()[0]

    @property
    def unit(self) -> str:
        """Unit of the numbers; raises as `grid` does."""
        return self._whole()[1]

    def _whole(self) -> tuple[PixelGrid, str]:
        if self._place is None:
            raise AttributeError(
                "this was made of a map and has neither grid nor unit; take those of the map itself"
            )
        return self._place
