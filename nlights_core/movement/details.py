"""Details: parts of the photographs at full resolution, where a movement of a pixel and a blur can be seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

from nlights_core.capture import Tile
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.photographs.development import Darkroom, darkroom
from nlights_core.photographs.images import Photograph, grey, is_saturated
from nlights_core.photographs.tone_curves import linear_light
from nlights_core.reduced_light.relative_light import DUST, RelativeLight, enlarge, lamp_vectors
from nlights_core.reduced_light.samples import Samples

WHOLE = 1 << 19
"""Pixels up to which a photograph is looked at as a whole; of a larger one, a part of each quarter."""

ROWS, COLUMNS = 256, 1024
"""Size of such a part, px: wide, because whole rows are read."""

MOST = 8_000_000
"""Values kept at most, of all lamps; above, means over 2 x 2 or 4 x 4 px are, which still tell 0.3 px."""

LEVELS = 5
"""Details are looked at in so many sizes, each half of the one before: the coarsest follows 20 px and more."""

LEAST = 12
"""Edge of the smallest detail that is looked at, in its own samples."""


@dataclass(frozen=True)
class Detail:
    """A part of all photographs, as relative light.

    Attributes
    ----------
    images : (L, h, w) float32 array
        NaN where not known.
    scale : int
        Edge of a sample, px.
    top, left : int
        Where the part begins, px.
    """

    images: Array
    scale: int
    top: int
    left: int

    def of(self, kept: Sequence[int]) -> Detail:
        """The same of some lamps, by their indices."""
        return replace(self, images=self.images[np.array(kept, np.intp)])

    def halved(self) -> Detail:
        """The same at half the resolution."""
        return Detail(_block_means(self.images, 2), 2 * self.scale, self.top, self.left)


@dataclass(frozen=True)
class Surroundings:
    """Surroundings of the details: which lamps light a place, and from where.

    Attributes
    ----------
    relative : RelativeLight
        Of the samples.
    samples : Samples
    lights : LightField
    pixel_size : float
        Edge of a pixel, mm or px.
    shape : (int, int)
        Rows and columns of the photographs.
    """

    relative: RelativeLight
    samples: Samples
    lights: LightField
    pixel_size: float
    shape: tuple[int, int]

    def vectors(self, rows: Array, columns: Array) -> Array:
        """Vectors of the lamps at some places of the photographs, px; (L, n, 3)."""
        x = (columns - (self.shape[1] - 1) / 2) * self.pixel_size
        y = ((self.shape[0] - 1) / 2 - rows) * self.pixel_size
        points = np.stack([x, y, np.zeros_like(x)])[:, None].astype(np.float32)
        found = lamp_vectors(self.lights, points, self.relative.with_flats)[:, 0]
        chosen = [self.lights.lamps.index(lamp) for lamp in self.relative.lamps]
        return np.broadcast_to(found[chosen], (len(chosen), len(x), 3))

    def lit(self, top: float, bottom: float, left: float, right: float) -> Array:
        """Lamps of which no shadow is cast on a part of the photographs, px; (L,) bool."""
        edge = self.samples.block * self.relative.patch
        shaded = self.relative.shaded
        top, left = max(top, 0), max(left, 0)
        rows = slice(int(top // edge), max(int(-(-bottom // edge)), int(top // edge) + 1))
        columns = slice(int(left // edge), max(int(-(-right // edge)), int(left // edge) + 1))
        return np.asarray(~shaded[:, rows, columns].any(axis=(1, 2)))


def read_details(
    tile: Tile, samples: Samples, relative: RelativeLight, lights: LightField, scratch: Path
) -> tuple[list[Detail], Surroundings]:
    """Read the parts of a tile's photographs in which most is to be seen.

    Parameters
    ----------
    tile : Tile
    samples : Samples
    relative : RelativeLight
        Of the lamps that are wanted.
    lights : LightField
    scratch : Path
        Folder for what must be kept decoded.

    Returns
    -------
    list of Detail
        Four, one of each quarter, or one that is the whole.
    Surroundings

    Raises
    ------
    TileError
        When a photograph cannot be read.
    """
    with darkroom(tile, scratch) as room:
        shape = room.grid.shape
        parts = _parts(samples, relative, shape)
        pixels = sum((bottom - top) * (right - left) for top, bottom, left, right in parts)
        scale = 1
        while scale < 4 and pixels * len(relative.lamps) > MOST * scale**2:
            scale *= 2

        def read(lamp: str) -> list[Array]:
            return [_read(room, room.photographs[lamp], part, scale) for part in parts]

        light = list(in_order(read, relative.lamps))
        around = Surroundings(relative, samples, lights, room.grid.pixel_size, shape)
    details = []
    for k, (top, _, left, _) in enumerate(parts):
        images = np.stack([one[k] for one in light])
        details.append(_related(Detail(images, scale, top, left), around))
    return details, around


def _parts(
    samples: Samples, relative: RelativeLight, shape: tuple[int, int]
) -> list[tuple[int, int, int, int]]:
    """Top, bottom, left and right of the parts, px."""
    rows, columns = shape
    if rows * columns <= WHOLE:
        return [(0, rows, 0, columns)]
    height, width = min(ROWS, rows // 2), min(COLUMNS, columns // 2)
    height = min(rows // 2, max(height, ROWS * COLUMNS // width))
    block = samples.block
    # Where the samples differ from their neighbours there is texture or relief, and mostly finer detail too.
    seen = np.isfinite(relative.light)
    mean = np.where(seen, relative.light, np.float32(0)).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    detail = np.zeros_like(mean)
    level = max(float(np.median(mean)), 1e-6)
    detail[:-1, :-1] = (np.diff(mean, axis=0)[:, :-1] ** 2 + np.diff(mean, axis=1)[:-1] ** 2) / level**2
    detail = np.where(seen.any(axis=0) & samples.inside, np.minimum(detail, 0.01), np.float32(0))
    # What is not known, or in shadow, says nothing: a part that is mostly known is wanted.
    shaded = np.repeat(np.repeat(relative.shaded.mean(axis=0), relative.patch, 0), relative.patch, 1)
    detail *= 1 - shaded[: detail.shape[0], : detail.shape[1]]
    total = np.zeros((detail.shape[0] + 1, detail.shape[1] + 1))
    total[1:, 1:] = detail.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    high, wide = max(1, height // block), max(1, width // block)
    sums = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
    parts = []
    for low_row, low_column in ((0, 0), (0, columns // 2), (rows // 2, 0), (rows // 2, columns // 2)):
        first_row, first_column = -(-low_row // block), -(-low_column // block)
        last_row = max(first_row, (low_row + rows // 2 - height) // block)
        last_column = max(first_column, (low_column + columns // 2 - width) // block)
        there = sums[first_row : last_row + 1, first_column : last_column + 1]
        row, column = np.unravel_index(np.argmax(there), there.shape) if there.size else (0, 0)
        top = min((first_row + int(row)) * block, rows - height)
        left = min((first_column + int(column)) * block, columns - width)
        parts.append((top, top + height, left, left + width))
    return parts


def _read(room: Darkroom, photograph: Photograph, part: tuple[int, int, int, int], scale: int) -> Array:
    """Grey light of a part, in means of ``scale`` x ``scale`` px; NaN where saturated."""
    top, bottom, left, right = part
    if photograph.plain:
        info = photograph.info
        numbers = np.empty((bottom - top, info.columns, info.channels), info.dtype)
        photograph.numbers(top, bottom, numbers)
        light = linear_light(numbers[:, left:right], info.saturation)
    else:
        light = photograph.band(top, bottom)[:, left:right]
    found = grey(light)
    if np.isfinite(room.info.saturation):
        saturated = is_saturated(light)
        if saturated.any():
            found[saturated] = np.nan
    return np.asarray(_block_means(found[None], scale)[0])


def _block_means(images: Array, edge: int) -> Array:
    """Means over blocks of pixels; NaN where one is not known."""
    if edge == 1:
        return images
    rows, columns = images.shape[1] // edge, images.shape[2] // edge
    cut = images[:, : rows * edge, : columns * edge]
    total = sum(cut[:, k::edge] for k in range(edge))
    assert not isinstance(total, int)
    wide = sum(total[:, :, k::edge] for k in range(edge))
    return np.asarray(wide * np.float32(1 / edge**2), np.float32)


def _related(detail: Detail, around: Surroundings) -> Detail:
    """A part of the photographs, dark subtracted and relative to flats or strengths."""
    samples, relative = around.samples, around.relative
    _, height, width = detail.images.shape
    rows = detail.top + (np.arange(height) + 0.5) * detail.scale - 0.5
    columns = detail.left + (np.arange(width) + 0.5) * detail.scale - 0.5
    images = detail.images
    if samples.dark is not None:
        # So would the dark frame's noise be.
        dark = uniform_filter(samples.dark, DUST, mode="nearest")
        images = images - enlarge(dark[None], samples.block, rows, columns)
    divisors = relative.divisors
    if divisors.shape[1:] != (1, 1):
        # Dust on the flat would be a texture that lies still in all photographs.
        divisors = enlarge(relative.smooth_divisors, samples.block, rows, columns)
    images = images / divisors
    if not samples.inside.all():
        near = enlarge(samples.inside[None].astype(np.float32), samples.block, rows, columns)
        images = np.where(near > 0.99, images, np.float32(np.nan))
    return Detail(np.asarray(images, np.float32), detail.scale, detail.top, detail.left)
