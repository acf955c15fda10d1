"""Bands of large maps, and their reduction: by blocks, and to samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order

BAND_BYTES = 16 << 20
"""About how much of an array is looked at in one go."""

SAMPLE = 2_000_000


def bands_of_bytes(rows: int, row_bytes: int, multiple: int = 1) -> Iterator[slice]:
    """Cut an image into bands of rows of about `BAND_BYTES` each.

    Parameters
    ----------
    rows : int
        Rows of the image.
    row_bytes : int
        Size of one of them.
    multiple : int
        Every band but the last has a multiple of so many rows.

    Yields
    ------
    slice
        Rows from the top of the image to its bottom.

    Examples
    --------
    >>> list(bands_of_bytes(5, BAND_BYTES // 2))
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    height = max(1, BAND_BYTES // max(1, row_bytes) // multiple) * multiple
    for start in range(0, rows, height):
        yield slice(start, min(start + height, rows))


def block_means(array: Array, factor: int) -> Array:
    """A reduced view: means of what is known in blocks of ``factor`` x ``factor`` pixels.

    Parameters
    ----------
    array : (H, W) or (H, W, C) array
        NaN where not known.
    factor : int
        Edge of a block, px, at most H and W; a remainder at the right and bottom is cut, as in
        `PixelGrid.reduced`.

    Returns
    -------
    (H // factor, W // factor[, C]) float32 array
        NaN where less than half of a block is known.
    """
    if factor == 1:
        return np.array(array, np.float32)
    from nlights_core.files import compiled_means

    rows, columns = array.shape[0] // factor, array.shape[1] // factor
    out = np.empty((rows, columns, *array.shape[2:]), np.float32)
    planes = out.reshape(rows, columns, -1)

    def reduce(band: slice) -> None:
        part = np.asarray(array[band], np.float32)
        part = part.reshape(len(part), part.shape[1], -1)
        compiled_means.block_means(part, factor, planes[band.start // factor : band.stop // factor])

    deque(in_order(reduce, bands_of_bytes(rows * factor, array[:1].nbytes, factor)), 0)
    return out


def sampled(array: Array) -> Array:
    """Known values on a regular lattice of at most about `SAMPLE` pixels, (N,) float64."""
    step = max(1, int(np.ceil(np.sqrt(array.shape[0] * array.shape[1] / SAMPLE))))
    values = np.asarray(array[::step, ::step], np.float64)
    return values[np.isfinite(values)]
