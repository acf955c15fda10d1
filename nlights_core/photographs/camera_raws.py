"""Camera raw files: LibRaw develops them, and what it does not say of a fault is said here."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tifffile

from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.photographs.decoding import Decoder

if TYPE_CHECKING:
    import rawpy

LEAST_BYTES = 1 / 8
"""Bytes that a pixel takes at the least: packed numbers take 1 and more, and what is coded without loss, number
by number, at least a bit."""

LEAST_BYTES_OF_WAVELETS = 1 / 100
"""Where areas are coded together (wavelets, JPEG): smooth ones take next to nothing."""

CODED_BY_AREAS = frozenset({".cr3", ".dng", ".gpr", ".kdc"})
"""Whose cameras or converters may do so: C-RAW, lossy DNG and JPEG XL, VC-5, the JPEG of early Kodaks."""

_MOSAICS = (32803, 34892)
"""PhotometricInterpretation of a colour filter array, and of linear raw."""


def open_raw(path: Path) -> Decoder:
    """Open a camera raw file, which is developed linearly and alike for every frame."""
    with _explained(path) as raw:
        sizes = raw.sizes
        rows, columns, channels = sizes.height, sizes.width, raw.num_colors
    _check_size(path, sizes.raw_height * sizes.raw_width)
    if channels not in (1, 3):
        raise TileError(f"{path}: its sensor has {channels} colours; develop it to an RGB TIFF, linearly")

    def decode(start: int, stop: int) -> Array:
        import rawpy

        with _explained(path) as raw:
            numbers: Array = raw.postprocess(
                # The same linear interpolation in every frame: one that follows edges would choose
                # other neighbours under another lamp, and the ratios between lamps are the measurement.
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                user_wb=[1, 1, 1, 1],
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                # 0: else the white level follows the brightest pixel of each frame.
                adjust_maximum_thr=0.0,
                # 0: how the camera was held must not turn one frame against the others.
                user_flip=0,
            )
        return numbers.reshape(rows, columns, channels)[start:stop]

    return Decoder(rows, columns, channels, np.dtype(np.uint16), None, step=rows, decode=decode)


@contextmanager
def _explained(path: Path) -> Iterator[rawpy.RawPy]:
    """Open a camera raw file; what LibRaw says of one that it cannot read is often not the reason."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except rawpy.LibRawError:
        _explain_compression(path)
        raise


def _check_size(path: Path, pixels: int) -> None:
    """Refuse a raw file that cannot hold its picture: a header alone, or cut short.

    LibRaw fills up what is missing in many formats, without a word.

    Parameters
    ----------
    path : Path
        The file.
    pixels : int
        That its header says the sensor has.

    Raises
    ------
    TileError
        With the bytes that were found, and those that the picture needs.
    """
    size, suffix = path.stat().st_size, path.suffix.lower()
    least = LEAST_BYTES_OF_WAVELETS if suffix in CODED_BY_AREAS else LEAST_BYTES
    if size < least * pixels:
        raise TileError(
            f"{path}: its header says {pixels / 1e6:.1f} million pixels, but the file has {size} bytes, "
            f"{size / pixels:.2g} a pixel (a {suffix} needs {least:g} at least): the picture is not in it; copy it "
            "again from the camera"
        )
    needed = _extent_of_dng(path)
    if needed > size:
        raise TileError(
            f"{path}: it is truncated: its images need {needed} bytes, the file has {size}; copy it again "
            "from the camera"
        )


def _explain_compression(path: Path) -> None:
    """Say of a DNG that its compression is the trouble, where it is; LibRaw calls the file damaged.

    Raises
    ------
    TileError
        Naming the compression.
    """
    for page in _pages(path):
        # Read are bare numbers and lossless JPEG, with or without loss by another name.
        if page.photometric in _MOSAICS and page.compression not in (1, 7, 34892):
            name = tifffile.COMPRESSION(page.compression).name
            raise TileError(
                f"{path}: its picture is compressed by {name}, which is not read in a DNG; convert it to a DNG "
                "without compression or with lossless JPEG, or develop it to a TIFF, linearly"
            )


def _pages(path: Path) -> list[tifffile.TiffPage]:
    """All images of a DNG, thumbnails included; none of other raw files.

    The tables of those need not mean what a TIFF's mean.
    """
    if path.suffix.lower() != ".dng":
        return []
    with tifffile.TiffFile(path) as file:
        pages = [page.aspage() for page in file.pages]
        return pages + [sub.aspage() for page in pages for sub in page.pages or ()]


def _extent_of_dng(path: Path) -> int:
    """Bytes that the images of a DNG need: LibRaw would fill the missing end of one with zeros."""
    segments = [zip(page.dataoffsets, page.databytecounts, strict=False) for page in _pages(path)]
    return max((offset + count for listed in segments for offset, count in listed), default=0)
