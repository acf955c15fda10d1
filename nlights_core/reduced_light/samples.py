"""Samples: the photographs of a tile reduced to a small picture each, to be compared with one another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nlights_core.capture import Tile
from nlights_core.frames import Array, PixelGrid
from nlights_core.photographs.block_means import BlockMeans, average_blocks, middle_lines
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.images import Photograph, grey
from nlights_core.reduced_light.colours import colour_light

ACROSS = 240
"""About how many samples a photograph is wide, or more: what is compared is light, not detail."""

ROWS = 4
"""About how many rows of each block are read: their mean is good enough."""

NOTHING = 1e-6
"""Mean light of a row, as a share of saturation, that is taken for none: one of 15 numbers of 16 bits is 1, not 0."""


class Rows(NamedTuple):
    """Mean grey light of rows of the files before the dark frame, mask or not; 0 where every number is.

    Attributes
    ----------
    frames : (L, h) float64 array
    flats : (L, h) float64 array or None
    dark : (h,) float64 array or None
    """

    frames: Array
    flats: Array | None
    dark: Array | None


@dataclass(frozen=True)
class Samples:
    """Small pictures of the photographs of a tile: grey linear light, fractions of saturation.

    Attributes
    ----------
    lamps : tuple of str
        In the order of the first axis.
    frames : (L, h, w) float32 array
        Dark subtracted; NaN where a pixel of the block is saturated, and outside the mask.
    flats : (L, h, w) float32 array or None
        The same of the photographs of the flat, without the mask; None where there are none.
    dark : (h, w) float32 array or None
        The dark frame itself.
    inside : (h, w) bool array
        The mask.
    grid : PixelGrid
        Where the blocks are on the plane.
    block : int
        Edge of a block, px of the photographs.
    step : float
        Light of one number of the files, which nothing finer can be told from; 0 for floats.
    rows : Rows
        Of each row of blocks, what the files hold.
    colour : (L, h, w) float32 array or None
        Light relative to the flats without its grey part, as `colour_light` gives it; None where not known.
    """

    lamps: tuple[str, ...]
    frames: Array
    flats: Array | None
    dark: Array | None
    inside: Array
    grid: PixelGrid
    block: int
    step: float
    rows: Rows
    colour: Array | None = None

    def of(self, lamps: Sequence[str]) -> Samples:
        """The same of some of the lamps."""
        chosen = [self.lamps.index(lamp) for lamp in lamps]
        flats, rows = self.flats, self.rows
        return replace(
            self,
            lamps=tuple(lamps),
            frames=self.frames[chosen],
            flats=None if flats is None else flats[chosen],
            rows=Rows(rows.frames[chosen], None if rows.flats is None else rows.flats[chosen], rows.dark),
            colour=None if self.colour is None else self.colour[chosen],
        )


def sample_photographs(
    tile: Tile, flats: bool, scratch: Path, progress: Callable[[float], None] = lambda _: None
) -> Samples:
    """Read some rows of every photograph of a tile as means over blocks of pixels.

    Parameters
    ----------
    tile : Tile
    flats : bool
        Whether the photographs of the flat are read too, if there are any.
    scratch : Path
        Folder for what must be kept decoded.
    progress : callable
        Told the share done.

    Returns
    -------
    Samples

    Raises
    ------
    TileError
        When a photograph is missing, cannot be read, or does not fit the others.
    """
    with_flats = flats and bool(tile.flats)
    share = 0.5 if with_flats else 1.0
    with darkroom(tile, scratch) as room:
        block = max(1, room.grid.columns // ACROSS)
        frames = average_blocks(room, block, ROWS, lambda done: progress(share * done))
        grid = room.grid
        step = float(1 / room.info.saturation) if room.info.dtype.kind == "u" else 0.0
        dark = _reduced_dark(room.dark, block, frames.inside.shape)
    small = None
    black = np.zeros(len(frames.inside)) if dark is None else dark.mean(axis=1, dtype=np.float64)
    if with_flats:
        with darkroom(tile, scratch, flats=True) as room:
            small = average_blocks(room, block, ROWS, lambda done: progress(0.5 + 0.5 * done))
    return Samples(
        lamps=tile.lamps,
        frames=_known(frames),
        flats=None if small is None else _known(small),
        dark=dark,
        inside=frames.inside,
        grid=grid.reduced(block),
        block=block,
        step=step,
        rows=Rows(
            _row_means(frames, black),
            None if small is None else _row_means(small, black),
            None if dark is None else _zeroed(black),
        ),
        colour=None if small is None else _colour(frames, small),
    )


def _known(means: BlockMeans) -> Array:
    """Grey light, NaN where a block is saturated or outside."""
    light = grey(means.images)
    light[means.saturated | ~means.inside] = np.nan
    return light


def _colour(frames: BlockMeans, flats: BlockMeans) -> Array | None:
    """Colour relative to the flats, not of what is saturated in either, nor outside."""
    unknown = frames.saturated | flats.saturated | ~frames.inside
    return colour_light(np.where(unknown[..., None], np.float32(np.nan), frames.images), flats.images)


def _row_means(means: BlockMeans, black: Array) -> Array:
    """Mean light of each row of blocks before the dark frame, (L, h)."""
    return _zeroed(grey(means.images).mean(axis=2, dtype=np.float64) + black)


def _zeroed(light: Array) -> Array:
    """Light that is nothing but rounding made 0."""
    return np.where(light < NOTHING, 0.0, light)


def _reduced_dark(dark: Photograph | None, block: int, shape: tuple[int, int]) -> Array | None:
    """The dark frame as means over some rows of each block."""
    if dark is None:
        return None
    middle = middle_lines(block, ROWS)
    found = np.empty(shape, np.float32)
    for row in range(shape[0]):
        first, last = row * block + middle.start, row * block + middle.stop
        light = grey(dark.band(first, last)[:, : shape[1] * block])
        found[row] = light.mean(axis=0).reshape(shape[1], block).mean(axis=1)
    return found
