"""Photographs averaged over blocks of pixels: for flat fields and overviews, which are smooth."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import available
from nlights_core.photographs.development import Darkroom
from nlights_core.photographs.exposures import Exposure
from nlights_core.photographs.images import Photograph, grey, is_saturated
from nlights_core.photographs.masks import Mask


class BlockMeans(NamedTuple):
    """Means over blocks of pixels.

    Attributes
    ----------
    images : (L, h, w, C) float32
        Linear, dark subtracted, fractions of saturation.
    saturated : (L, h, w) bool
        Where any pixel of the block is.
    inside : (h, w) bool
        Where the mask has any pixel of the block.
    """

    images: Array
    saturated: Array
    inside: Array


def average_blocks(
    room: Darkroom, block: int, rows: int, progress: Callable[[float], None] = lambda _: None
) -> BlockMeans:
    """Average the photographs of a darkroom over blocks; ask `Darkroom.check` then whether they say anything.

    Parameters
    ----------
    room : Darkroom
        The open photographs.
    block : int
        Edge of a block, px; rows and columns of pixels that fill no block are left out.
    rows : int
        About how many rows in the middle of each block are looked at (`middle_lines`).
    progress : callable
        Told the share done.

    Returns
    -------
    BlockMeans

    Raises
    ------
    TileError
        When a photograph cannot be read.
    """
    shape = (room.grid.rows // block, room.grid.columns // block)
    limited = bool(np.isfinite(room.info.saturation))
    inside = np.ones(shape, bool)
    if room.mask is not None:
        inside = _any_inside(room.mask, shape, block, rows)
    lamps = list(room.photographs)
    images = np.empty((len(lamps), *shape, room.info.channels), np.float32)
    shares = np.empty((len(lamps), *shape), np.float32)
    black: Array = np.zeros((1, 1, 1), np.float32)

    def averaged(photograph: Photograph) -> tuple[Array, Array]:
        return _means(photograph, shape, block, rows, limited or photograph is room.dark)

    everything = [*([room.dark] if room.dark else []), *room.photographs.values()]
    for done, (light, share) in enumerate(in_order(averaged, everything), 1 - len(everything) + len(lamps)):
        if done == 0:
            black, room.exposures["dark"] = light, _exposure(light, share)
            continue
        images[done - 1], shares[done - 1] = light - black, share
        progress(done / len(lamps))
    for lamp, image, share in zip(lamps, images, shares, strict=True):
        room.exposures[lamp] = _exposure(image[inside], share[inside])
    return BlockMeans(images, shares > 0, inside)


def middle_lines(block: int, rows: int) -> range:
    """Rows of a block that are looked at, at least ``rows`` if there are so many: what is smooth needs no more.

    They lie around the block's very middle: half a pixel beside it, lamps would seem to stand elsewhere.

    >>> middle_lines(23, 4), middle_lines(8, 4), middle_lines(3, 4)
    (range(9, 14), range(2, 6), range(0, 3))
    """
    lines = min(block, rows + (block - rows) % 2)
    return range((block - lines) // 2, (block + lines) // 2)


def _means(
    photograph: Photograph, shape: tuple[int, int], block: int, rows: int, limited: bool
) -> tuple[Array, Array]:
    """Mean (h, w, C) and share of saturated pixels (h, w) of a photograph's blocks."""
    middle = middle_lines(block, rows)
    lines = len(middle)
    columns = shape[1] * block
    mean = np.empty((*shape, photograph.info.channels), np.float32)
    share = np.zeros(shape, np.float32)
    info = photograph.info
    compiled = photograph.plain and available()
    if compiled:
        from nlights_core.files.compiled_means import line_means

        numbers = np.empty((lines, info.columns, info.channels), info.dtype)
    for row in range(shape[0]):
        first = row * block + middle.start
        if compiled:
            photograph.numbers(first, first + lines, numbers)
            line_means(numbers, block, *photograph.scale, mean[row], share[row])
            continue
        light = photograph.band(first, first + lines)[:, :columns]
        # Down first: along the memory that is a sum of whole rows.
        down = light.mean(axis=0).reshape(shape[1], block, -1)
        mean[row] = down.mean(axis=1)
        if limited:
            share[row] = is_saturated(light).mean(axis=0).reshape(shape[1], block).mean(axis=1)
    return mean, share


def _any_inside(mask: Mask, shape: tuple[int, int], block: int, rows: int) -> Array:
    """Mark where the mask has any pixel of a block, (h, w) bool, in as many rows of it as `_means` looks at."""
    middle = middle_lines(block, rows)
    inside = np.empty(shape, bool)
    for row in range(shape[0]):
        first, last = row * block + middle.start, row * block + middle.stop
        seen = mask.band(first, last)[:, : shape[1] * block].any(axis=0)
        inside[row] = seen.reshape(shape[1], block).any(axis=1)
    return inside


def _exposure(light: Array, saturated: Array) -> Exposure:
    exposure = Exposure()
    exposure.add(grey(light).ravel(), saturated.ravel() > 0.5)
    return exposure
