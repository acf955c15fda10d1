"""Images that leave the system: TIFFs, views of them, and their colour profile.

Everything is written by bands of rows, so that a 100-megapixel map needs no second copy in
memory, and without dates, so that the same maps give the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from nlights_core import __version__
from nlights_core.frames import Array, PixelGrid

BAND_BYTES = 32 << 20
"""About how much of an array is looked at in one go."""

UNKNOWN_NORMAL = (0, 0, 0)
"""Colour of an unknown normal in the 8-bit view: no unit vector encodes to it."""


def bands(rows: int, row_bytes: int, multiple: int = 1) -> Iterator[slice]:
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
    >>> list(bands(5, BAND_BYTES // 2))
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
    rows, columns = array.shape[0] // factor, array.shape[1] // factor
    out = np.empty((rows, columns, *array.shape[2:]), np.float32)
    for band in bands(rows * factor, array[:1].nbytes, factor):
        part = np.asarray(array[band, : columns * factor], np.float32)
        blocks = part.reshape(-1, factor, columns, factor, *array.shape[2:])
        known = np.isfinite(blocks)
        count = known.sum(axis=(1, 3))
        total = np.sum(blocks, axis=(1, 3), where=known, dtype=np.float64)
        mean = total / np.maximum(count, 1)
        out[band.start // factor : band.stop // factor] = np.where(2 * count >= factor**2, mean, np.nan)
    return out


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


class BandTiff:
    """An uncompressed TIFF that is written band by band.

    The header is written first, then the rows as they come.  A memory-mapped file would be
    shorter to write, but a full disk kills a process that fills one; plain writes raise OSError.

    Parameters
    ----------
    path : Path
        File to write; an existing one is replaced.
    shape : tuple of int
        (H, W) or (H, W, 3).
    dtype : dtype
        Of the pixels.
    grid : PixelGrid, optional
        Sets the resolution tags, where its unit is mm.
    description : str
        Goes to ImageDescription.
    icc : bytes, optional
        Colour profile to embed.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        dtype: Any,
        *,
        grid: PixelGrid | None = None,
        description: str = "",
        icc: bytes | None = None,
    ) -> None:
        import tifffile

        self._dtype = np.dtype(dtype).newbyteorder("<")
        pixel = int(np.prod(shape[2:], dtype=int)) * self._dtype.itemsize
        size = shape[0] * shape[1] * pixel
        resolution = (10 / grid.pixel_size,) * 2 if grid is not None and grid.unit == "mm" else None
        with tifffile.TiffWriter(path, bigtiff=size > 2**32 - 2**20, byteorder="<") as file:
            place = file.write(
                None,
                shape=shape,
                dtype=np.dtype(dtype),
                photometric="rgb" if len(shape) == 3 else "minisblack",
                planarconfig="contig" if len(shape) == 3 else None,
                rowsperstrip=max(1, min(shape[0], (8 << 20) // (shape[1] * pixel))),
                resolution=resolution,
                resolutionunit="CENTIMETER" if resolution else "NONE",
                description=description.encode() or None,
                software=f"nLights {__version__}",
                metadata=None,
                iccprofile=icc,
                returnoffset=True,
            )
        assert place is not None
        self._stream = path.open("r+b")
        self._stream.seek(place[0])

    def write(self, band: Array) -> None:
        """Append rows."""
        self._stream.write(np.ascontiguousarray(band, self._dtype).data)

    def __enter__(self) -> BandTiff:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()


def write_tiff(
    path: str | Path, array: Array, grid: PixelGrid, *, description: str, icc: bytes | None = None
) -> None:
    """Write a map as an uncompressed TIFF, by bands of rows.

    Where the scale is known the resolution tags say how many pixels cover a centimetre of the
    artwork.  Files of more than 4 GB become BigTIFF.  There is no date.

    Parameters
    ----------
    path : str or Path
        File to write; an existing one is replaced.
    array : (H, W), (H, W, 1) or (H, W, 3) array of float32, uint16 or uint8
        The map, on the pixels of ``grid``.
    grid : PixelGrid
        Where the pixels are.
    description : str
        What the numbers are: quantity, unit and frame.  Goes to ImageDescription.
    icc : bytes, optional
        Colour profile to embed.

    Raises
    ------
    ValueError
        When the array does not lie on the grid, or is of another type or depth.
    OSError
        When the file cannot be written, for instance on a full disk; what was written so far
        stays, for the caller to discard.
    """
    if array.dtype not in (np.float32, np.uint16, np.uint8):
        raise ValueError(
            f"{path}: a TIFF holds float32, uint16 or uint8, got {array.dtype}; convert it first"
        )
    depth = array.shape[2:]
    if array.shape[:2] != grid.shape or depth not in ((), (1,), (3,)):
        raise ValueError(
            f"{path}: expected {grid.rows} x {grid.columns} pixels of 1 or 3 channels, got {array.shape}"
        )
    shape = grid.shape if depth in ((), (1,)) else (*grid.shape, 3)
    with BandTiff(Path(path), shape, array.dtype, grid=grid, description=description, icc=icc) as file:
        for band in bands(grid.rows, array[:1].nbytes):
            file.write(array[band])


def write_normals_view(path: str | Path, normals: Array) -> None:
    """Write normals as colours: 8-bit PNG in the OpenGL convention (+Y up).

    Red, green and blue are ``round(127.5 n + 127.5)`` of x, y and z.  Decode with
    ``n = v / 127.5 - 1``.  Unknown normals are black (`UNKNOWN_NORMAL`).  For looking at: eight
    bits resolve 0.45 degrees, so measure in the float32 TIFF.

    Parameters
    ----------
    path : str or Path
        File to write.
    normals : (H, W, 3) float32 array
        Unit vectors in the plane frame, NaN where not known.

    Notes
    -----
    Pillow wants the whole picture at once: 3 bytes a pixel.
    """
    from PIL import Image

    out = np.empty(normals.shape, np.uint8)
    for band in bands(normals.shape[0], normals[:1].nbytes):
        part = normals[band]
        known = np.isfinite(part).all(axis=2, keepdims=True)
        code = np.rint(np.where(known, part, 0) * np.float32(127.5) + np.float32(127.5))
        out[band] = np.where(known, np.clip(code, 0, 255), np.array(UNKNOWN_NORMAL, np.float32))
    Image.fromarray(out).save(path, "PNG", compress_level=3)


def write_albedo_view(path: str | Path, albedo: Array, grid: PixelGrid) -> None:
    """Write the albedo for looking at: 16-bit sRGB TIFF with its colour profile.

    Parameters
    ----------
    path : str or Path
        File to write.
    albedo : (H, W), (H, W, 1) or (H, W, 3) float32 array
        Linear; clipped to 0..1, NaN becomes black.  One channel is written as neutral grey.
    grid : PixelGrid
        Where the pixels are.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    description = "Albedo for viewing: sRGB (IEC 61966-2-1), clipped to 0..1, black where not known"
    with BandTiff(
        Path(path), (*grid.shape, 3), np.uint16, grid=grid, description=description, icc=srgb_profile()
    ) as file:
        for band in bands(grid.rows, 3 * albedo[:1].nbytes):
            code = np.rint(srgb(albedo[band]) * np.float32(65535)).astype(np.uint16)
            file.write(np.broadcast_to(code.reshape(*code.shape[:2], -1), (*code.shape[:2], 3)))
