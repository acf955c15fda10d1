"""Photograph files: what a header says, and how rows of pixels become the file's numbers.

Nothing here knows light: the numbers are what the file holds.  `nlights_core.photographs.images` turns
them into fractions of the saturation level.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TgaImagePlugin import TgaImageFile
from PIL.TiffImagePlugin import TiffImageFile

from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.names.photographs import did_you_mean
from nlights_core.photographs.camera_raws import open_raw
from nlights_core.photographs.decoding import Decoder, explain_damage
from nlights_core.photographs.tiff_codecs import JPEG, require_codec, require_size
from nlights_core.photographs.tiff_pages import described, full_pages

# tifffile logs what it mends silently; each such fault that could change a pixel is an error here.
logging.getLogger("tifffile").setLevel(logging.CRITICAL)

# fmt: off
RAW_EXTENSIONS = frozenset({
    ".3fr", ".arw", ".cap", ".cr2", ".cr3", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef",
    ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".srw", ".x3f",
})
# fmt: on
"""Extensions of camera raw files.  Many start like a TIFF, so only the name tells."""

EXTENSIONS = RAW_EXTENSIONS | {".tif", ".tiff", ".png", ".jpg", ".jpeg", ".bmp", ".tga"}
"""Extensions by which photographs are told from other files in a folder."""

RAW_SATURATION = 65534.0
"""LibRaw scales the white level to 65535, and its float32 arithmetic may cut that to one less."""

MOST_PIXELS = 10**9
"""No camera makes a gigapixel; a header that says so is damaged, or made to exhaust memory."""

_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_TIFF_ADVICE = "export it as a grey or RGB TIFF of 8, 16 or 32 bits, unsigned or float"


def is_raw(path: Path) -> bool:
    """Test whether the name is that of a camera raw file."""
    return path.suffix.lower() in RAW_EXTENSIONS


def open_decoder(path: Path, mask: bool = False) -> Decoder:
    """Read a photograph's header and prepare to decode its rows.

    The format is told by the first bytes, except camera raw and TGA, which have no mark of
    their own and are told by the extension.

    Parameters
    ----------
    path : Path
        TIFF, PNG, JPEG, BMP, TGA or camera raw.
    mask : bool
        The file is a mask: alpha is a channel like any other, the last one, and a TIFF may be of 1 bit or of
        palette colours.

    Returns
    -------
    Decoder
        To be closed by the caller.

    Raises
    ------
    TileError
        Where there is no such file, or it is of no readable format, or it is damaged.
    """
    if not path.exists():
        raise TileError(
            f"{path}: no such file; correct the path in the capture's manifest or restore it{did_you_mean(path)}"
        )
    if kind := irregular_kind(path):
        raise TileError(f"{path}: {kind}, where a photograph is expected; name the file itself")
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        raise TileError(f"{path}: empty, 0 bytes; copy it again from the camera or export it anew")
    with explain_damage(path), ExitStack() as undo:
        decoder = _decoder_for(start, path, mask)(path)
        undo.callback(decoder.close)
        if not 0 < decoder.rows * decoder.columns <= MOST_PIXELS:
            raise TileError(
                f"{path}: its header says {decoder.columns} x {decoder.rows} pixels, but only images of 1 to "
                f"{MOST_PIXELS} pixels are read; export it anew, or in tiles"
            )
        undo.pop_all()
    return decoder


def _decoder_for(start: bytes, path: Path, mask: bool) -> Callable[[Path], Decoder]:
    """Choose the format from a file's first 8 bytes, or from its name."""
    if is_raw(path):
        return open_raw
    if start[:4] in _TIFF_STARTS:
        return partial(_open_tiff, mask=mask)
    if start == _PNG_START:
        return partial(_open_png, alpha=mask)
    if start[:2] == b"\xff\xd8":
        return partial(_open_with_pillow, JpegImageFile, alpha=mask)
    if start[:2] == b"BM":
        return partial(_open_with_pillow, BmpImageFile, alpha=mask)
    if path.suffix.lower() == ".tga":
        return partial(_open_with_pillow, TgaImageFile, alpha=mask)
    raise TileError(
        f"{path}: starts with {start[:4]!r}, which is no image format that is read; export it as TIFF "
        "(or PNG, JPEG, BMP, TGA), or give the camera's raw file its own extension, such as .dng"
    )


def _open_tiff(path: Path, mask: bool) -> Decoder:
    """Open the photograph in a TIFF or BigTIFF; see `nlights_core.photographs.tiff_pages`."""
    with ExitStack() as undo:
        file = tifffile.TiffFile(path)
        undo.callback(file.close)
        pages = full_pages(file)
        page = pages[0][1]
        bits = mask and not page.is_subifd and (page.bitspersample == 1 or page.photometric in (0, 3))
        require_codec(path, page, bits)
        if bits:
            return _open_bits(path, page)
        channels = _tiff_channels(path, page, mask)
        _check_segments(path, page, file.filehandle.size)
        assert page.dtype is not None
        number = page.dtype.newbyteorder("=") if page.dtype.kind == "u" else np.dtype(np.float32)
        # Of what is stored in its final form any rows can be had; of other files, rows of segments.
        stored = page.is_final
        rows_of_a_segment = page.tilelength if page.is_tiled else page.rowsperstrip
        rows = _stored_rows if stored else _decoded_rows
        as_it_is = stored and page.dtype == number and page.samplesperpixel == channels
        as_it_is &= np.dtype(page.dtype).newbyteorder(file.byteorder).isnative and page.planarconfig == 1
        decoder = Decoder(
            rows=page.imagelength,
            columns=page.imagewidth,
            channels=channels,
            dtype=number,
            icc=page.iccprofile,
            step=1 if stored else min(rows_of_a_segment, page.imagelength),
            decode=partial(rows, path, page, channels, number),
            close=file.close,
            fill=partial(_fill_rows, page) if as_it_is else None,
            pages=described(pages),
        )
        undo.pop_all()
    return decoder


def _open_bits(path: Path, page: tifffile.TiffPage) -> Decoder:
    """Open a mask of bits, palette colours or white-is-zero; Pillow makes of them what they mean, fax codes too."""
    decoder = _open_with_pillow(TiffImageFile, path, alpha=True, page=page.index)
    if page.bitspersample == 1 and page.photometric == 0 and page.software.startswith("tifffile"):
        # Python's tifffile says white-is-zero of every array of truth values, and nobody who writes one means it.
        return replace(decoder, decode=lambda start, stop: 255 - decoder.decode(start, stop))
    return decoder


def _fill_rows(page: tifffile.TiffPage, start: int, stop: int, out: Array) -> None:
    """Rows of an uncompressed TIFF that need no conversion, with no copy in between."""
    bytes_per_row = out.nbytes // max(len(out), 1)
    place = page.dataoffsets[0] + start * bytes_per_row
    _read_whole(page.parent.filehandle.fileno(), out[: stop - start].reshape(-1).view(np.uint8), place)


def _tiff_channels(path: Path, page: tifffile.TiffPage, mask: bool = False) -> int:
    """1 or 3, for what can be measured, and alpha where it is wanted; other contents are refused by name."""
    samples, bits, dtype = page.samplesperpixel, page.bitspersample, page.dtype
    coding = tifffile.PHOTOMETRIC(page.photometric)
    # YCbCr is what a JPEG inside the TIFF says of itself; it is decoded to RGB.
    colour = coding.name == "RGB" or (coding.name == "YCBCR" and page.compression == 7)
    alpha = samples in (2, 4) and (colour or mask or page.extrasamples[-1:] in ((1,), (2,)))
    channels: int = samples - alpha
    found = None
    if dtype is None or f"{dtype.kind}{dtype.itemsize}" not in ("u1", "u2", "u4", "f2", "f4", "f8"):
        kind = "of no known type" if dtype is None else f"of type {dtype.name}"
        found = f"its numbers are {kind} ({bits} bits)"
    elif not colour and coding.name != "MINISBLACK":
        found = f"its colours are coded as {coding.name}"
    elif bits != 8 * dtype.itemsize:
        found = f"its numbers are packed to {bits} bits"
    elif channels not in ((3,) if colour else (1, 3)):
        found = f"it has {samples} channels"
    elif page.imagedepth != 1:
        found = f"its page is a volume of {page.imagedepth} slices"
    if found:
        raise TileError(f"{path}: {found}, which cannot be measured; {_TIFF_ADVICE}")
    return samples if mask else channels


def _check_segments(path: Path, page: tifffile.TiffPage, size: int) -> None:
    """Refuse a TIFF whose strips or tiles are not all there: a reader would fill in zeros."""
    what = "tiles" if page.is_tiled else "strips"
    expected = int(np.prod(page.chunked))
    offsets = np.array(page.dataoffsets, np.int64)
    counts = np.array(page.databytecounts, np.int64)
    found = None
    if not len(offsets) == len(counts) == expected:
        found = f"it lists {min(len(offsets), len(counts))} of {expected} {what}"
    elif (offsets <= 0).any() or (counts <= 0).any():
        found = f"{int(((offsets <= 0) | (counts <= 0)).sum())} of {expected} {what} were never written"
    elif (offsets + counts > size).any():
        needed = int((offsets + counts).max())
        found = f"it is truncated: its {what} need {needed} bytes, the file has {size}"
    elif page.is_final and counts.sum() < page.nbytes:
        found = f"its {what} hold {int(counts.sum())} of {page.nbytes} bytes"
    if found:
        raise TileError(f"{path}: {found}; copy it again from the camera or export it anew")


def _stored_rows(
    path: Path, page: tifffile.TiffPage, channels: int, number: np.dtype[np.generic], start: int, stop: int
) -> Array:
    """Rows of an uncompressed TIFF.  They are read, not mapped: a page fault costs more than a copy."""
    planar = page.planarconfig == 2 and page.samplesperpixel > 1
    samples = 1 if planar else page.samplesperpixel
    stored = np.dtype(page.dtype).newbyteorder(page.parent.byteorder)
    row_bytes = page.imagewidth * samples * stored.itemsize
    planes = []
    for plane in range(channels if planar else 1):
        rows = np.empty((stop - start, page.imagewidth, samples), stored)
        place = page.dataoffsets[0] + (plane * page.imagelength + start) * row_bytes
        _read_whole(page.parent.filehandle.fileno(), rows.reshape(-1).view(np.uint8), place)
        planes.append(rows)
    numbers = planes[0][..., :channels] if not planar else np.concatenate(planes, axis=2)
    if number.kind == "u":
        return numbers
    with np.errstate(over="ignore"):  # a float64 past float32 becomes infinite, which the reader refuses
        return numbers.astype(number)


def _read_whole(file: int, into: Array, place: int) -> None:
    """Fill an array of bytes from a place in an open file."""
    while into.size:
        count = os.preadv(file, [into.data], place)
        if not count:
            raise EOFError(f"it ends at byte {place}, where pixels are expected")
        into, place = into[count:], place + count


def _decoded_rows(
    path: Path, page: tifffile.TiffPage, channels: int, number: np.dtype[np.generic], start: int, stop: int
) -> Array:
    """Rows of a TIFF, from the strips or tiles that hold them and no others."""
    planar = page.planarconfig == 2 and page.samplesperpixel > 1
    height = page.tilelength if page.is_tiled else page.rowsperstrip
    across = -(-page.imagewidth // page.tilewidth) if page.is_tiled else 1
    down = -(-page.imagelength // height)
    numbers = np.empty((stop - start, page.imagewidth, channels), number)
    for plane in range(channels if planar else 1):
        kept = slice(plane, plane + 1) if planar else slice(0, channels)
        first = (plane * down + start // height) * across
        last = (plane * down + -(-stop // height)) * across
        for index in range(first, last):
            page.parent.filehandle.seek(page.dataoffsets[index])
            coded = page.parent.filehandle.read(page.databytecounts[index])
            if page.compression == JPEG:
                require_size(path, page, coded)
            segment, place, _ = page.decode(
                coded, index, jpegtables=page.jpegtables, jpegheader=page.jpegheader
            )
            assert segment is not None
            row, column = place[2] - start, place[3]
            target = numbers[row : row + segment.shape[1], column : column + segment.shape[2], kept]
            # A tile may reach past the image; tifffile raises for a segment that is too small.
            with np.errstate(over="ignore"):
                target[:] = segment[0, : target.shape[0], : target.shape[1], : target.shape[2]]
    return numbers


def _open_png(path: Path, alpha: bool) -> Decoder:
    """Open a PNG; Pillow reads its header only, because it would cut 16-bit colours to 8."""
    with PngImageFile(path) as image:
        columns, rows = image.size
        icc, clear = image.info.get("icc_profile"), "transparency" in image.info
    with path.open("rb") as file:
        bits, colour_type = file.read(26)[24:]
    channels = 1 if colour_type in (0, 4) else 3
    if alpha:
        channels += colour_type in (4, 6) or clear

    def decode(start: int, stop: int) -> Array:
        numbers: Array = imagecodecs.png_decode(path.read_bytes())
        return numbers.reshape(rows, columns, -1)[start:stop, :, :channels]

    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    return Decoder(rows, columns, channels, dtype, icc, step=rows, decode=decode)


def _open_with_pillow(opener: Callable[[Path], ImageFile], path: Path, alpha: bool, page: int = 0) -> Decoder:
    """Open an 8-bit JPEG, BMP or TGA, or a page of a TIFF.

    The format's own class is called rather than `PIL.Image.open`, whose limit on the number of
    pixels is a global of the process and lies below a 100-megapixel camera.
    """
    with opener(path) as image:
        image.seek(page)
        columns, rows = image.size
        mode, icc, clear = image.mode, image.info.get("icc_profile"), "transparency" in image.info
    if mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
        raise TileError(f"{path}: its colours are coded as {mode}; export it as grey or RGB")
    target = "L" if mode in ("1", "L", "LA") else "RGB"
    if alpha and (mode in ("LA", "RGBA") or clear):
        target += "A"

    def decode(start: int, stop: int) -> Array:
        if opener is JpegImageFile:
            _check_jpeg_end(path)
        with opener(path) as image:
            image.seek(page)
            numbers = np.asarray(image if mode == target else image.convert(target))
        return numbers.reshape(rows, columns, -1)[start:stop]

    return Decoder(rows, columns, len(target), np.dtype(np.uint8), icc, step=rows, decode=decode)


def _check_jpeg_end(path: Path) -> None:
    """Refuse a JPEG whose end is zeros, as an interrupted copy leaves it: decoders would fill in grey."""
    coded = path.read_bytes()
    if coded.endswith(b"\0\0") and not coded.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise TileError(f"{path}: its end is only zeros, an interrupted copy; copy it again from the camera")
