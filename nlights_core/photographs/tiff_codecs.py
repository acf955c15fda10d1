"""Codecs inside a TIFF: which are read, and that none makes more pixels than the file's header says."""

from __future__ import annotations

from pathlib import Path

import tifffile

from nlights_core.errors import TileError

BYTES = frozenset({1, 5, 8, 32773, 32946, 50000})
"""None, LZW, deflate (two numbers mean it), PackBits and Zstandard, as COMPRESSION of a TIFF.  They code bytes: the
buffer that they fill is as large as the strip or tile, whatever is in the file."""

JPEG = 7
"""JPEG codes an image of a size of its own, which is asked first."""

FAX = frozenset({2, 3, 4})
"""Codes of fax machines, for masks of bits.  They fill rows that are as long as the header says."""

LARGEST_TILE = 4096 * 4096
"""Pixels of a tile that may be larger than its image."""

PADDED = 16
"""Rows and columns by which a JPEG may be larger than its strip or tile: some programs fill up its blocks."""

_ADVICE = "export it as a TIFF without compression, or with LZW, deflate, PackBits, Zstandard or JPEG"


def require_codec(path: Path, page: tifffile.TiffPage, bits: bool = False) -> None:
    """Refuse a page whose compression is not read, or whose tiles are much larger than its image.

    JPEG 2000, JPEG XL, JPEG XR, WebP, PNG and LERC have sizes of their own, and tell them to nobody before they
    have taken the memory; LZMA takes up to 4 GB for its dictionary.

    Parameters
    ----------
    path : Path
        Of the file.
    page : TiffPage
        Its photograph.
    bits : bool
        It is a mask of bits or palette colours.

    Raises
    ------
    TileError
        Naming the compression, and what is read.
    """
    code = int(page.compression)
    if code not in BYTES and code != JPEG and not (bits and code in FAX):
        known = {int(one): one.name for one in tifffile.COMPRESSION}
        raise TileError(f"{path}: is compressed by {known.get(code, code)}, which is not read; {_ADVICE}")
    if page.is_tiled and page.tilewidth * page.tilelength > max(
        LARGEST_TILE, page.imagewidth * page.imagelength
    ):
        raise TileError(
            f"{path}: its header says tiles of {page.tilewidth} x {page.tilelength} px for an image of "
            f"{page.imagewidth} x {page.imagelength} px; {_ADVICE}"
        )


def require_size(path: Path, page: tifffile.TiffPage, coded: bytes) -> None:
    """Refuse a JPEG inside a TIFF that says it is larger than its strip or tile.

    Raises
    ------
    TileError
        With both sizes.
    """
    width = page.tilewidth if page.is_tiled else page.imagewidth
    height = page.tilelength if page.is_tiled else min(page.rowsperstrip, page.imagelength)
    for part in (page.jpegtables, coded):
        found = jpeg_size(part) if part else None
        if found and (found[0] > width + PADDED or found[1] > height + PADDED):
            raise TileError(
                f"{path}: its header says {width} x {height} px, but the JPEG in it says {found[0]} x {found[1]}; "
                "export it anew"
            )


def jpeg_size(coded: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG says it has; None where it does not say.

    Examples
    --------
    >>> jpeg_size(bytes.fromhex("ffd8 ffc0 000b 08 0030 0040 01 011100"))
    (64, 48)
    """
    place = 2
    while (place := coded.find(b"\xff", place)) >= 0 and place + 9 <= len(coded):
        marker = coded[place + 1]
        if marker in (0x00, 0xFF) or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            place += 1 if marker == 0xFF else 2
            continue
        if marker in (0xD9, 0xDA):  # the end, or the beginning of the pixels
            return None
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = (
                int.from_bytes(coded[place + 5 : place + 7]),
                int.from_bytes(coded[place + 7 : place + 9]),
            )
            return width, height
        place += 2 + int.from_bytes(coded[place + 2 : place + 4])
    return None
