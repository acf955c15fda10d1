"""Views of maps, for looking at: the albedo in sRGB, the normals as colours."""

from __future__ import annotations

import struct
import zlib
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from nlights_core.files.reduction import bands_of_bytes
from nlights_core.files.tiffs import Compression, write_bands
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import read_only

UNKNOWN_NORMAL = (0, 0, 0)
"""Colour of an unknown normal in the 8-bit view: no unit vector encodes to it."""


def srgb(linear: Array) -> Array:
    """Encode linear light for viewing (IEC 61966-2-1).

    Parameters
    ----------
    linear : array
        Linear light; clipped to 0..1, NaN becomes black.

    Returns
    -------
    float32 array of the same shape
        From 0 to 1.
    """
    light = np.clip(np.nan_to_num(np.asarray(linear, np.float32), nan=0.0), 0, 1)
    curve = np.float32(1.055) * light ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(light <= 0.0031308, np.float32(12.92) * light, curve)


def srgb_codes(linear: Array, dtype: Any) -> Array:
    """Linear light as whole numbers for viewing: `srgb` to within 0.01 of a 16-bit step, and rounded.

    Parameters
    ----------
    linear : float32 array
        Clipped to 0..1; NaN becomes black.
    dtype : {uint8, uint16}
        The largest number of this type is white.

    Returns
    -------
    array of ``dtype`` and the same shape
    """
    from nlights_core.products import compiled_viewing

    out = np.empty(linear.shape, dtype)
    values = read_only(np.ascontiguousarray(linear, np.float32).reshape(-1))
    largest = np.float32(np.iinfo(dtype).max)
    compiled_viewing.encoded(values, values.view(np.int32), *_srgb_table(), largest, out.reshape(-1))
    return out


@cache
def _srgb_table() -> tuple[Array, np.float32, int, int]:
    """The curve at 512 values from each power of two to the next, 2^-9 to 1, for `compiled_viewing.encoded`."""
    lowest, shift = np.float32(2**-9), 14
    first, last = (int(value.view(np.int32)) for value in (lowest, np.float32(1)))
    light = np.arange(first, last + 1, 1 << shift, dtype=np.int32).view(np.float32).astype(np.float64)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return curve.astype(np.float32), lowest, first, shift


def srgb_profile() -> bytes:
    """The sRGB colour profile (ICC), with a fixed creation date so that it never varies.

    Returns
    -------
    bytes
        LittleCMS's own sRGB profile; bytes 24 to 35 of its header hold the date (ICC.1, 7.2).
    """
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    date = np.array([2000, 1, 1, 0, 0, 0], ">u2").tobytes()
    return profile[:24] + date + profile[36:]


class NormalsView:
    """Normals as colours: an 8-bit PNG in the OpenGL convention (+Y up), written band by band.

    Red, green and blue are ``round(127.5 n + 127.5)`` of x, y and z.  Decode with
    ``n = v / 127.5 - 1``.  Unknown normals are black (`UNKNOWN_NORMAL`).  For looking at: eight
    bits resolve 0.45 degrees, so measure in the float32 TIFF.

    Parameters
    ----------
    path : Path
        File to write.
    rows, columns : int
        Size of the map.

    Notes
    -----
    Every band is deflated by itself and ends on a whole byte (Z_FULL_FLUSH), so that bands can be
    worked on at once.  Noise leaves nothing that repeats, hence only Huffman's code: on measured
    normals that is three times as fast as zlib's level 3, and smaller.
    """

    def __init__(self, path: Path, rows: int, columns: int) -> None:
        self._stream = path.open("wb")
        self._stream.write(b"\x89PNG\r\n\x1a\n")
        self._chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 2, 0, 0, 0))
        self._chunk(b"IDAT", b"\x78\x01")
        self._checksum = zlib.adler32(b"")

    @staticmethod
    def part(normals: Array) -> tuple[Array, bytes]:
        """A band's bytes (n, 1 + 3 W) uint8 before and after compression, for `write`."""
        from nlights_core.products import compiled_viewing

        colours = np.empty(normals.shape, np.uint8)
        compiled_viewing.normal_colours(normals, colours)
        lines = colours.reshape(len(normals), -1)
        plain = np.empty((len(lines), 1 + lines.shape[1]), np.uint8)
        compiled_viewing.differences(lines, plain)
        packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS, 9, zlib.Z_HUFFMAN_ONLY)
        return plain, packer.compress(plain.data) + packer.flush(zlib.Z_FULL_FLUSH)

    def write(self, part: tuple[Array, bytes]) -> None:
        """Append a band."""
        plain, packed = part
        self._checksum = zlib.adler32(plain.data, self._checksum)
        self._chunk(b"IDAT", packed)

    def _chunk(self, kind: bytes, content: bytes) -> None:
        self._stream.write(struct.pack(">I", len(content)) + kind + content)
        self._stream.write(struct.pack(">I", zlib.crc32(content, zlib.crc32(kind))))

    def __enter__(self) -> NormalsView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stream:
            if kind is None:
                last = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS).flush()
                self._chunk(b"IDAT", last + struct.pack(">I", self._checksum))
                self._chunk(b"IEND", b"")


def write_normals_view(path: str | Path, normals: Array) -> None:
    """Write normals as colours, as `NormalsView` codes them.

    Parameters
    ----------
    path : str or Path
        File to write.
    normals : (H, W, 3) float32 array
        Unit vectors in the plane frame, NaN where not known.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    with NormalsView(Path(path), *normals.shape[:2]) as view:
        places = bands_of_bytes(len(normals), normals[:1].nbytes)
        for part in in_order(lambda band: NormalsView.part(normals[band]), places):
            view.write(part)


def write_albedo_view(
    path: str | Path, albedo: Array, grid: PixelGrid, exposure: float = 1.0, compression: Compression = "none"
) -> None:
    """Write the albedo for looking at: 16-bit sRGB TIFF with its colour profile.

    Parameters
    ----------
    path : str or Path
        File to write.
    albedo : (H, W), (H, W, 1) or (H, W, 3) float32 array
        Linear; clipped to 0..1, NaN becomes black.  One channel is written as neutral grey.
    grid : PixelGrid
        Where the pixels are.
    exposure : float
        What the albedo is multiplied by first.
    compression : {"none", "zstd"}
        Without loss.

    Raises
    ------
    OSError
        When the file cannot be written.
    """

    def seen(band: slice) -> Array:
        part = albedo[band] * np.float32(exposure)
        code = srgb_codes(part, np.uint16).reshape(*part.shape[:2], -1)
        return np.ascontiguousarray(np.broadcast_to(code, (*code.shape[:2], 3)))

    description = "Albedo for viewing: sRGB (IEC 61966-2-1), clipped to 0..1, black where not known"
    write_bands(
        path,
        in_order(seen, bands_of_bytes(grid.rows, albedo[:1].nbytes)),
        (*grid.shape, 3),
        np.uint16,
        grid,
        description=description,
        icc=srgb_profile(),
        compression=compression,
    )
