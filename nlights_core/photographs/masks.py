"""Masks: images that say where the artwork, or a chrome sphere, is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.photographs.decoders import open_decoder
from nlights_core.photographs.decoding import Decoder, explain_damage
from nlights_core.photographs.tone_curves import full_scale


def mask_size(path: Path) -> tuple[int, int]:
    """Rows and columns of a mask, by its header; raises `TileError` as `Mask` does."""
    decoder = open_decoder(path, mask=True)
    decoder.close()
    return decoder.rows, decoder.columns


ROWS = 256
"""Rows that are looked at together, at least."""


class Mask:
    """A mask, read once and kept as a bit a pixel.

    Inside is what is brighter than half of full scale: what a JPEG or a soft brush leaves beside the
    edge is not.  Full scale is the largest number of the file's type, but 1 where the file holds
    nothing larger, and at least the largest number of a float file.  Where there is an alpha channel
    that is not the same everywhere, it is the mask and the colours do not count.

    Parameters
    ----------
    path : Path
        Image of any kind that is read as a photograph, or a TIFF of 1 bit or of palette colours.

    Attributes
    ----------
    path : Path
    rows, columns : int
    pixels : int
        How many are inside.
    largest : float
        The largest number in the file's colours, or in its alpha where that is the mask.
    full : float
        Full scale.

    Raises
    ------
    TileError
        Where the file is missing, damaged, or of a kind that is not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        decoder = open_decoder(path, mask=True)
        try:
            self.rows, self.columns = decoder.rows, decoder.columns
            with explain_damage(path):
                self._bits, self.largest, self.full = _chosen(decoder)
        finally:
            decoder.close()
        self.pixels = int(np.bitwise_count(self._bits).sum())

    def band(self, start: int, stop: int) -> Array:
        """Rows of the mask, (stop - start, columns) bool: whether a pixel is inside."""
        return np.unpackbits(self._bits[start:stop], axis=1, count=self.columns).view(bool)

    def require_some(self) -> None:
        """Refuse a mask in which nothing is inside.

        Raises
        ------
        TileError
            With its largest number, and what is needed.
        """
        if not self.pixels:
            raise TileError(
                f"{self.path}: mask: nothing is inside: its largest number is {self.largest:g}, and what is above "
                f"half of full scale ({self.full / 2:g}) is the artwork; paint the artwork white"
            )


def _chosen(decoder: Decoder) -> tuple[Array, float, float]:
    """Bits of a mask, its largest number, and full scale."""
    # What is decoded in one piece is not decoded again for the second look.
    whole = decoder.decode(0, decoder.rows) if decoder.step >= decoder.rows else None
    step = decoder.step * -(-ROWS // decoder.step)

    def bands() -> Iterator[tuple[slice, Array]]:
        for start in range(0, decoder.rows, step):
            rows = slice(start, min(start + step, decoder.rows))
            yield rows, decoder.decode(rows.start, rows.stop) if whole is None else whole[rows]

    ends = [(numbers.min(axis=(0, 1)), numbers.max(axis=(0, 1))) for _, numbers in bands()]
    lowest, highest = np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)
    seen = slice(0, decoder.channels)
    if decoder.channels in (2, 4):
        varies = lowest[-1] < highest[-1]
        seen = slice(decoder.channels - 1, None) if varies else slice(0, decoder.channels - 1)
    largest = float(highest[seen].max())
    full = max(1.0, largest)
    if decoder.dtype.kind == "u" and largest > 1:
        full = full_scale(decoder.dtype)
    bits = np.empty((decoder.rows, -(-decoder.columns // 8)), np.uint8)
    for rows, numbers in bands():
        bits[rows] = np.packbits(numbers[..., seen].max(axis=-1) > full / 2, axis=1)
    return bits, largest, full
