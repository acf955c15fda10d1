"""The overview: a tile's height at reduced resolution, which is all that near light needs to know.

A surface a millimetre higher is lit from another angle, so normals need the height and the height
needs the normals.  The height is needed to some hundredths of a millimetre only, and the same for
neighbouring pixels: so all passes but the last are made on means over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from nlights_core.algorithms import Solution
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.machine.band_threads import in_order
from nlights_core.photographs.block_means import average_blocks, middle_lines
from nlights_core.photographs.development import BAND_BYTES, Darkroom, Raw, bands_of_grid
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.photographs.noise import Noise
from nlights_core.solving.band_solving import solve_band
from nlights_core.solving.kernels import TASK, robust_solution
from nlights_core.solving.least_squares import UsableLights

COLUMNS = 500
"""About how many blocks an overview is wide."""

STEEPEST_DEG = 70.0
"""To which slopes are limited: means over blocks are hardly ever so steep."""

ROWS = 4
"""About how many rows of each block are read: their mean is good enough."""


@dataclass
class ReducedRoom(Darkroom):
    """A darkroom of photographs that are already read, as means over blocks of pixels.

    Parameters
    ----------
    images : (L, h, w, C) float32 array
        Linear, dark subtracted.
    saturated : (L, h, w) bool array
        Where a pixel of the block is saturated.
    inside : (h, w) bool array
        The mask.
    """

    images: Array | None = None
    saturated: Array | None = None
    inside: Array | None = None

    def raw(self, start: int, stop: int, lights: LightField) -> Raw:
        """A band of every photograph."""
        assert self.images is not None
        assert self.saturated is not None
        assert self.inside is not None
        power = lights.power.astype(np.float32)[:, None, None, :]
        images = self.images[:, start:stop] / power
        return Raw(start, stop, images, self.saturated[:, start:stop], self.inside[start:stop])

    def check(self) -> None:
        """Do nothing: the photographs are judged where they are read in full."""


def reduced_room(room: Darkroom, progress: Callable[[float], None]) -> ReducedRoom:
    """Read the photographs of a tile as means over blocks.

    Parameters
    ----------
    room : Darkroom
        The open photographs.
    progress : callable
        Told the share done.

    Returns
    -------
    ReducedRoom
        Rows and columns that fill no block are left out.
    """
    factor = block_edge(room.grid.columns)
    means = average_blocks(room, factor, ROWS, progress)
    room.check()
    kept = {f.name: getattr(room, f.name) for f in fields(Darkroom) if f.init and not f.name.startswith("_")}
    kept |= {"grid": room.grid.reduced(factor)}
    kept |= {"mask": None, "exposures": {}}
    small = ReducedRoom(**kept, **means._asdict())
    count = len(middle_lines(factor, ROWS)) * factor
    small.noise = Noise(room.noise.gain / count, room.noise.readout / count)
    return small


def thinned_room(room: ReducedRoom) -> ReducedRoom:
    """Take every other row and column of reduced photographs, as they are: their noise and texture stay the same."""
    grid = room.grid
    rows, columns = ((length + 1) // 2 for length in grid.shape)
    # An even length leaves its last row or column out, and the middle lies half a pixel back.
    left, up = ((2 * kept - 1 - whole) / 2 for kept, whole in ((columns, grid.columns), (rows, grid.rows)))
    centre = (grid.centre[0] + left * grid.pixel_size, grid.centre[1] - up * grid.pixel_size)
    kept = {
        f.name: getattr(room, f.name) for f in fields(ReducedRoom) if f.init and not f.name.startswith("_")
    }
    kept["grid"] = replace(grid, rows=rows, columns=columns, pixel_size=2 * grid.pixel_size, centre=centre)
    for name in ("images", "saturated"):
        kept[name] = np.ascontiguousarray(kept[name][:, ::2, ::2])
    kept["inside"] = np.ascontiguousarray(kept["inside"][::2, ::2])
    thin = ReducedRoom(**kept)
    thin.noise = room.noise
    return thin


class _Solver(UsableLights):
    """The robust solution, whatever solver the recipe has."""

    name: ClassVar[str] = "overview"

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        return robust_solution(images, lights, weights, self.shadow, self.condition)


def solve_overview(room: ReducedRoom, lights: LightField, flat_field: FlatField | None, passes: int) -> Array:
    """Find the height of mean 0.

    It is found robustly and by plain least squares whatever the recipe says, so that recipes which
    differ in solver or integrator share it.

    Parameters
    ----------
    room : ReducedRoom
        The photographs.
    lights, flat_field : LightField, FlatField or None
        As for `nlights_core.solving.band_solving.solve_tile`.
    passes : int
        How often.

    Returns
    -------
    (h, w) float32 array
        mm; NaN where not known.

    Raises
    ------
    TileError
        When no normal could be found.
    """
    height: Array | None = None
    for _ in range(passes):
        normals = _normals(room, lights, flat_field, height)
        if not np.isfinite(normals).any():
            raise TileError(
                "overview: not a single block has three usable lights; see the mask, the saturation level and "
                "the frames themselves"
            )
        height = least_squares_height(normals, room.grid, stencil="6-point", steepest_deg=STEEPEST_DEG)
    assert height is not None
    return height


def _normals(
    room: ReducedRoom, lights: LightField, flat_field: FlatField | None, height: Array | None
) -> Array:
    """Normals of all blocks, (h, w, 3) float32."""

    def of_rows(rows: tuple[int, int]) -> Array:
        raw = room.raw(*rows, lights)
        below = None if height is None else height[slice(*rows)]
        return solve_band(_Solver(), room.develop(raw, lights, flat_field, below)).normals

    # Each core takes as much as a kernel works on at once.
    return np.concatenate(list(in_order(of_rows, bands_of_grid(room.grid, BAND_BYTES // TASK))))


class Enlarged:
    """An overview's height on the grid of the photographs, by linear interpolation; ask it for rows.

    Parameters
    ----------
    height : (h, w) float32 array
        NaN where not known: filled with the nearest that is.
    factor : int
        Edge of a block, px.
    shape : (int, int)
        Rows and columns of the photographs.

    Examples
    --------
    >>> Enlarged(np.array([[1, 3]], np.float32), 2, (2, 4))[0:1]
    array([[1. , 1.5, 2.5, 3. ]], dtype=float32)
    """

    def __init__(self, height: Array, factor: int, shape: tuple[int, int]) -> None:
        from scipy.ndimage import distance_transform_edt

        unknown = np.isnan(height)
        if unknown.any():
            nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
            height = height[tuple(nearest)]
        left, right, across = _between(shape[1], factor, height.shape[1])
        # What an array of places selects lies in memory column by column; rows are wanted.
        self._wide = np.ascontiguousarray(height[:, left] * (1 - across) + height[:, right] * across)
        self._above, self._below, self._down = _between(shape[0], factor, height.shape[0])

    def __getitem__(self, rows: slice) -> Array:
        """Some rows, (n, W) float32."""
        places = zip(self._above[rows], self._below[rows], self._down[rows], strict=True)
        found = np.empty((len(self._down[rows]), self._wide.shape[1]), np.float32)
        # Row by row, so that what is in between stays in the processor's cache.
        for row, (above, below, share) in zip(found, places, strict=True):
            np.multiply(self._wide[above], 1 - share, out=row)
            row += self._wide[below] * share
        return found


def block_edge(columns: int) -> int:
    """Edge of a block, px, of photographs so wide."""
    return max(1, round(columns / COLUMNS))


def _between(length: int, factor: int, blocks: int) -> tuple[Array, Array, Array]:
    """Blocks before and after each pixel of a line, and how near it is to the latter."""
    place = np.clip((np.arange(length) + 0.5) / factor - 0.5, 0, blocks - 1)
    before = np.minimum(place.astype(np.intp), max(blocks - 2, 0))
    return before, np.minimum(before + 1, blocks - 1), (place - before).astype(np.float32)
