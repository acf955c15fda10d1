"""Photographs as light: bands of rows, linear, as fractions of the level at which the sensor saturates."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np

from nlights_core.capture import Encoding
from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.photographs.decoders import RAW_SATURATION, is_raw, open_decoder
from nlights_core.photographs.decoding import Decoder, explain_damage
from nlights_core.photographs.icc_profiles import linear_profile
from nlights_core.photographs.tone_curves import BELOW_ONE, ToneCurve, curve_of, full_scale, linear_light

LARGE_BYTES = 64 * 2**20
"""Decoded rows that must be kept together go to a scratch file when they are larger than this."""

AS_STORED = Encoding()
"""The encoding of a capture that says nothing: the tone curve of the embedded profile or none, no mosaic,
saturated at the type's largest number."""

_decoding_large = threading.Lock()


@dataclass(frozen=True)
class ImageInfo:
    """Header of a photograph.

    Parameters
    ----------
    rows, columns : int
        Size of what `Photograph.band` gives: a Bayer mosaic counts its 2 x 2 cells.
    channels : int
        1 or 3; alpha is dropped, a palette of a PNG, BMP or TGA is looked up.
    dtype : numpy.dtype
        Type of the file's numbers: uint8, uint16, uint32, or float32 for any float.
    saturation : float
        Level at which the sensor saturates, in the file's numbers; infinity where nothing is
        saturated.
    icc : bytes or None
        The embedded ICC profile as it is for linear light, for display: its colours are not applied.
    curve : ToneCurve or None
        The tone curve that is undone; None: the file's numbers are in proportion to light.
    pages : tuple of str
        Of a TIFF with several full pages, what each is; the one that is read first.
    """

    rows: int
    columns: int
    channels: int
    dtype: np.dtype[np.generic]
    saturation: float
    icc: bytes | None
    curve: ToneCurve | None = None
    pages: tuple[str, ...] = ()


def probe(path: Path, encoding: Encoding = AS_STORED) -> ImageInfo:
    """Read a photograph's header; no pixel is decoded.

    Parameters
    ----------
    path : Path
        TIFF, PNG, JPEG, BMP, TGA or camera raw.
    encoding : Encoding
        How the capture says the numbers stand for light.

    Raises
    ------
    TileError
        Where the file is missing, damaged as far as the header tells, or of a kind that cannot
        be measured.
    """
    with Photograph(path, encoding) as photograph:
        return photograph.info


class Photograph:
    """A photograph that is read in bands of rows.

    The file is opened when it is first needed and stays open until `close`.  Uncompressed TIFFs
    are read where they lie.  Of compressed ones only the strips or tiles of the band are decoded,
    and the last row of them is kept, so that consecutive bands decode nothing twice.  Formats
    without such parts (PNG, JPEG, BMP, TGA, raw, a TIFF in a single strip) are decoded once.

    Distinct photographs may be read from distinct threads; one photograph serves one thread.

    Parameters
    ----------
    path : Path
        TIFF, PNG, JPEG, BMP, TGA or camera raw.
    encoding : Encoding
        How the file's numbers stand for light; it goes before the profile that the file embeds.  Camera raw
        files are developed linearly and have no mosaic left, so only the saturation level applies to them.
    scratch : Path, optional
        Folder for what must be kept decoded and is larger than `LARGE_BYTES`; such files are
        decoded one at a time.  None: it is kept in memory.

    Examples
    --------
    >>> import tempfile, tifffile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "ramp.tif"
    ...     tifffile.imwrite(path, np.array([[0, 51], [102, 255]], np.uint8))
    ...     with Photograph(path) as photograph:
    ...         photograph.band(1, 2)[..., 0]
    array([[0.4, 1. ]], dtype=float32)
    """

    def __init__(self, path: Path, encoding: Encoding = AS_STORED, scratch: Path | None = None) -> None:
        self.path, self.encoding, self.scratch = path, encoding, scratch
        self._mosaic = None if is_raw(path) else encoding.mosaic
        self._transfer = "linear" if is_raw(path) else encoding.transfer
        self._curve: ToneCurve | None = None
        self._decoder: Decoder | None = None
        self._block: Array | None = None
        self._block_start = 0

    @property
    def info(self) -> ImageInfo:
        """The photograph's header; raises `TileError` as `probe` does."""
        decoder = self._open()
        cell = 2 if self._mosaic else 1
        channels = 3 if self._mosaic else decoder.channels
        return ImageInfo(
            rows=decoder.rows // cell,
            columns=decoder.columns // cell,
            channels=channels,
            dtype=decoder.dtype,
            saturation=_saturation(self.path, decoder.dtype, self.encoding),
            icc=decoder.icc and linear_profile(decoder.icc, channels),
            curve=self._curve,
            pages=decoder.pages,
        )

    def band(self, start: int, stop: int) -> Array:
        """Light in a band of rows.

        Parameters
        ----------
        start, stop : int
            Rows, ``0 <= start <= stop <= info.rows``.

        Returns
        -------
        (stop - start, columns, channels) float32 array
            Linear light as a fraction of the saturation level: 1 or more exactly where the file's
            number is at or above it.

        Raises
        ------
        TileError
            Where the pixels are damaged, or a float file holds NaN or infinity.
        ValueError
            Where the rows are not in the photograph.
        """
        info, decoder = self.info, self._open()
        if not 0 <= start <= stop <= info.rows:
            raise ValueError(f"rows {start} to {stop} are not within the {info.rows} rows of {self.path}")
        cell = 2 if self._mosaic else 1
        light = np.empty(((stop - start) * cell, decoder.columns, decoder.channels), np.float32)
        filled = 0
        for numbers in self._numbers(decoder, start * cell, stop * cell):
            self._develop(numbers, info.saturation, light[filled : filled + len(numbers)])
            filled += len(numbers)
        if decoder.dtype.kind == "f":
            self._check_finite(light, start * cell)
        return superpixels(light[..., 0], self._mosaic) if self._mosaic else light

    def _develop(self, numbers: Array, saturation: float, light: Array) -> None:
        """Light of the file's numbers, channel by channel where their curves differ."""
        curves = self._curve.channels if self._curve else (None,)
        if len(curves) == 1:
            light[:] = linear_light(numbers, saturation, curves[0])
            return
        for channel, curve in enumerate(curves):
            light[..., channel] = linear_light(numbers[..., channel], saturation, curve)

    @property
    def plain(self) -> bool:
        """Test whether light is the file's number over the saturation level: no mosaic, no tone curve."""
        decoder = self._open()
        whole = decoder.dtype.kind == "u" and decoder.dtype.itemsize <= 2
        return whole and self._mosaic is None and self._curve is None

    @property
    def scale(self) -> tuple[float, float, float]:
        """Light per number of a `plain` photograph, the number at which the sensor saturates, the largest light."""
        info = self.info
        if np.isfinite(info.saturation):
            return 1 / info.saturation, info.saturation, np.inf
        return 1 / full_scale(info.dtype), np.inf, float(BELOW_ONE)

    @property
    def stored_shape(self) -> tuple[int, int, int]:
        """Rows, columns and channels of the file: of a mosaic's file, not of what `band` makes of it."""
        decoder = self._open()
        return decoder.rows, decoder.columns, decoder.channels

    def numbers(self, start: int, stop: int, out: Array) -> None:
        """Copy what the file holds in a band of its rows, as stored; raises as `band` does.

        Parameters
        ----------
        start, stop : int
            Rows of the file: a mosaic has them twice.
        out : (stop - start, columns, channels) array of ``info.dtype``
            Receives it.
        """
        decoder = self._open()
        if decoder.fill is not None and out.flags.c_contiguous:
            with explain_damage(self.path):
                decoder.fill(start, stop, out)
            return
        for numbers in self._numbers(decoder, start, stop):
            out[: len(numbers)] = numbers
            out = out[len(numbers) :]

    def close(self) -> None:
        """Close the file and forget what was decoded; reading again opens it anew."""
        self._block = None
        if self._decoder is not None:
            self._decoder.close()
            self._decoder = None

    def __enter__(self) -> Photograph:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()

    def _open(self) -> Decoder:
        if self._decoder is None:
            decoder = open_decoder(self.path)
            if self._mosaic and decoder.channels != 1:
                decoder.close()
                raise TileError(
                    f"{self.path}: has {decoder.channels} channels, but mosaic: {self._mosaic} is for grey "
                    "files; remove mosaic from the capture's encoding, or give files not yet demosaiced"
                )
            try:
                self._curve = curve_of(self._transfer, decoder.icc, decoder.channels, self.path)
            except TileError:
                decoder.close()
                raise
            self._decoder = decoder
        return self._decoder

    def _numbers(self, decoder: Decoder, start: int, stop: int) -> Iterator[Array]:
        """The file's numbers in rows ``start`` to ``stop``, in one or more parts from the top."""
        while start < stop:
            if decoder.step == 1:
                with explain_damage(self.path):
                    numbers = decoder.decode(start, stop)
            else:
                block = self._block_around(decoder, start)
                numbers = block[start - self._block_start : stop - self._block_start]
            yield numbers
            start += len(numbers)

    def _block_around(self, decoder: Decoder, row: int) -> Array:
        """The rows that are decoded together with a given one; the last such block is kept."""
        start = row // decoder.step * decoder.step
        if self._block is None or self._block_start != start:
            self._block = None  # its memory is needed for the next
            stop = min(start + decoder.step, decoder.rows)
            size = (stop - start) * decoder.columns * decoder.channels * decoder.dtype.itemsize
            scratch = self.scratch if size > LARGE_BYTES else None
            with _decoding_large if scratch else nullcontext(), explain_damage(self.path):
                block = decoder.decode(start, stop)
                if scratch:
                    block = _moved_to_disk(block, scratch)
            self._block, self._block_start = block, start
        return self._block

    def _check_finite(self, light: Array, start: int) -> None:
        known = np.isfinite(light).all(axis=(1, 2))
        if not known.all():
            rows = start + np.flatnonzero(~known)
            raise TileError(
                f"{self.path}: holds NaN or infinity in rows {rows[0]} to {rows[-1]}; a photograph has a "
                "number in every pixel: export it anew, and leave out areas with the capture's mask"
            )


def _saturation(path: Path, dtype: np.dtype[np.generic], encoding: Encoding) -> float:
    """The level in the file's numbers, infinite where nothing saturates."""
    if encoding.saturation == "none":
        return float("inf")
    default = RAW_SATURATION if is_raw(path) else full_scale(dtype)
    return default if encoding.saturation is None else float(encoding.saturation)


def _moved_to_disk(numbers: Array, scratch: Path) -> Array:
    """The same array, mapped from a file that has no name, so that even a killed run leaves nothing."""
    scratch.mkdir(parents=True, exist_ok=True)
    with TemporaryFile(dir=scratch) as file:
        # Written, not assigned through a map: a full disk then raises OSError instead of killing.
        for row in range(0, len(numbers), 256):
            file.write(np.ascontiguousarray(numbers[row : row + 256]).data)
        file.flush()
        return np.memmap(file, numbers.dtype, "r", shape=numbers.shape)


def superpixels(mosaic: Array, pattern: str) -> Array:
    """Make each 2 x 2 cell of a Bayer mosaic one RGB pixel; nothing is interpolated.

    Parameters
    ----------
    mosaic : (H, W) float32 array
        Light behind the colour filters, as fractions of the saturation level.
    pattern : {"RGGB", "BGGR", "GRBG", "GBRG"}
        Filters of a cell: upper left, upper right, lower left, lower right.

    Returns
    -------
    (H // 2, W // 2, 3) float32 array
        Green is the mean of the cell's two, or the larger one where it is saturated, so that a
        saturated sample always saturates its channel.  An odd last row or column is dropped.
    """
    rows, columns = mosaic.shape[0] // 2 * 2, mosaic.shape[1] // 2 * 2
    samples = [mosaic[i // 2 : rows : 2, i % 2 : columns : 2] for i in range(4)]
    first, second = (samples[i] for i in range(4) if pattern[i] == "G")
    largest = np.maximum(first, second)
    green = np.where(largest >= 1, largest, (first + second) * np.float32(0.5))
    return np.stack([samples[pattern.index("R")], green, samples[pattern.index("B")]], axis=-1)


EYE = np.array([0.299, 0.587, 0.114])
"""Shares of red, green and blue in what the eye takes for brightness (ITU-R BT.601)."""


def grey(image: Array, shares: Array | None = None) -> Array:
    """The grey of an image: 0.299 R + 0.587 G + 0.114 B, or its single channel.

    Parameters
    ----------
    image : (..., C) array
        C is 1 or 3.
    shares : (C,) array, optional
        Share of each channel, instead of those.

    Returns
    -------
    (...) array of the image's type
    """
    if image.shape[-1] == 1:
        return image[..., 0]
    if shares is not None:
        return np.asarray(image @ shares.astype(image.dtype))
    red, green, blue = (image.dtype.type(weight) for weight in EYE)
    return np.asarray(image[..., 0] * red + image[..., 1] * green + image[..., 2] * blue)


def is_saturated(band: Array) -> Array:
    """Test whether any channel of a pixel is at or above the saturation level.

    Parameters
    ----------
    band : (..., C) array
        What `Photograph.band` gave.  Where `ImageInfo.saturation` is infinite nothing is saturated,
        yet float files may hold 1 and more: do not ask this of them.

    Returns
    -------
    (...) bool array
    """
    saturated = np.asarray(band[..., 0] >= 1)
    for channel in range(1, band.shape[-1]):  # any() along so short an axis is seven times slower
        saturated |= band[..., channel] >= 1
    return saturated


def reduce_photograph(
    photograph: Photograph, factor: int, band_rows: int = 256, keep_saturated: bool = False
) -> Array:
    """Means of blocks of pixels, read in bands.

    Parameters
    ----------
    photograph : Photograph
        Read from top to bottom.
    factor : int
        Edge of a block, px; rows and columns that fill no block are cut off.
    band_rows : int
        About how many rows are read at a time.
    keep_saturated : bool
        Average saturated pixels like any other.

    Returns
    -------
    (rows // factor, columns // factor, channels) float32 array
        Summed in float64.  NaN in all channels where a pixel of the block is saturated, unless
        they are kept.
    """
    info = photograph.info
    rows, columns = info.rows // factor, info.columns // factor
    means = np.empty((rows, columns, info.channels), np.float32)
    together = max(1, band_rows // factor)
    for start in range(0, rows, together):
        stop = min(start + together, rows)
        band = photograph.band(start * factor, stop * factor)[:, : columns * factor]
        blocks = band.reshape(stop - start, factor, columns, factor, info.channels)
        means[start:stop] = blocks.sum(axis=1, dtype=np.float64).sum(axis=2) / factor**2
        if not keep_saturated and np.isfinite(info.saturation):
            means[start:stop][is_saturated(blocks.max(axis=1)).any(axis=2)] = np.nan
    return means
