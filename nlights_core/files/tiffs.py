"""Maps that leave the system as TIFFs.

Everything is written by bands of rows, so that a 100-megapixel map needs no second copy in
memory, and without dates, so that the same maps give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from nlights_core import __version__
from nlights_core.files.reduction import bands_of_bytes
from nlights_core.files.steady_files import SteadyFile
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import cores, in_order

STRIP_BYTES = {"none": 8 << 20, "zstd": 1 << 20}
"""About how large a TIFF's strips are: what is compressed, and must be read, in one go."""

Compression = Literal["none", "zstd"]
"""Of TIFFs; "zstd" comes with the predictor for the type of the pixels, and loses nothing."""


def _layout(
    shape: tuple[int, ...],
    dtype: Any,
    grid: PixelGrid | None,
    description: str,
    icc: bytes | None,
    compression: Compression = "none",
) -> dict[str, Any]:
    """Arguments of tifffile for an image: its type, its strips, its tags."""
    row_bytes = math.prod(shape[1:]) * np.dtype(dtype).itemsize
    resolution = (10 / grid.pixel_size,) * 2 if grid is not None and grid.unit == "mm" else None
    return {
        "shape": shape,
        "dtype": np.dtype(dtype),
        "photometric": "rgb" if len(shape) == 3 else "minisblack",
        "planarconfig": "contig" if len(shape) == 3 else None,
        "rowsperstrip": max(1, min(shape[0], STRIP_BYTES[compression] // row_bytes)),
        "resolution": resolution,
        "resolutionunit": "CENTIMETER" if resolution else "NONE",
        "description": description.encode() or None,
        "software": f"nLights {__version__}",
        "metadata": None,
        "iccprofile": icc,
    }


def _is_big(shape: tuple[int, ...], dtype: Any) -> bool:
    """Test whether an image's bytes exceed what a plain TIFF can address."""
    return bool(math.prod(shape) * np.dtype(dtype).itemsize > 2**32 - 2**20)


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
    read_soon : bool
        As for `SteadyFile`.
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
        read_soon: bool = False,
    ) -> None:
        import tifffile

        self._dtype = np.dtype(dtype).newbyteorder("<")
        with tifffile.TiffWriter(path, bigtiff=_is_big(shape, dtype), byteorder="<") as file:
            place = file.write(None, returnoffset=True, **_layout(shape, dtype, grid, description, icc))
        assert place is not None
        self._stream = SteadyFile(path, "r+b", start=place[0], read_soon=read_soon)

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
    path: str | Path,
    array: Array,
    grid: PixelGrid,
    *,
    description: str,
    icc: bytes | None = None,
    compression: Compression = "none",
) -> None:
    """Write a map as a TIFF, by bands of rows.

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
    compression : {"none", "zstd"}
        Without loss.

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
    rows = (array[band] for band in bands_of_bytes(grid.rows, array[:1].nbytes))
    write_bands(
        path, rows, shape, array.dtype, grid, description=description, icc=icc, compression=compression
    )


def write_again(source: Path, path: Path, grid: PixelGrid, compression: Compression) -> None:
    """Write what `write_tiff` wrote to another file, with another compression; raises as that does."""
    import tifffile

    with tifffile.TiffFile(source) as file:
        page = file.pages.first
        said, icc = page.description, page.iccprofile
    write_tiff(path, read_tiff(source), grid, description=said, icc=icc, compression=compression)


def write_bands(
    path: str | Path,
    rows: Iterable[Array],
    shape: tuple[int, ...],
    dtype: Any,
    grid: PixelGrid,
    *,
    description: str,
    icc: bytes | None = None,
    compression: Compression = "none",
    read_soon: bool = False,
) -> None:
    """Write a TIFF as `write_tiff` does, from rows as they are made.

    Parameters
    ----------
    path : str or Path
        File to write; an existing one is replaced.
    rows : iterable of arrays
        From the top of the image to its bottom, any number at a time.
    shape : tuple of int
        (H, W) or (H, W, 3).
    dtype : dtype
        Of the pixels.
    grid, description, icc, compression
        As in `write_tiff`.
    read_soon : bool
        As for `SteadyFile`.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    import tifffile

    if compression == "none":
        with BandTiff(
            Path(path), shape, dtype, grid=grid, description=description, icc=icc, read_soon=read_soon
        ) as file:
            for part in rows:
                file.write(part)
        return
    layout = _layout(shape, dtype, grid, description, icc, compression)
    # Whether the compressed bytes will fit a plain TIFF is not known before they are written.
    with tifffile.TiffWriter(path, bigtiff=_is_big(shape, dtype), byteorder="<") as writer:
        writer.write(
            in_order(_packed, _strips(rows, layout["rowsperstrip"], shape, layout["dtype"])),
            compression=compression,
            predictor=3 if layout["dtype"].kind == "f" else 2,
            **layout,
        )


def _packed(strip: Array) -> bytes:
    """A strip, compressed: each pixel's difference from the one before it first, by TIFF's predictors."""
    import imagecodecs

    predict = imagecodecs.floatpred_encode if strip.dtype.kind == "f" else imagecodecs.delta_encode
    pixels = strip.reshape(*strip.shape[:2], -1)
    return bytes(imagecodecs.zstd_encode(predict(pixels, axis=-2).tobytes(), level=1))


def _strips(rows: Iterable[Array], height: int, shape: tuple[int, ...], dtype: Any) -> Iterator[Array]:
    """The same rows, so many at a time; only the last strip may be lower."""
    gathered = np.empty((height, *shape[1:]), dtype)
    filled = 0
    for part in rows:
        lines = part.reshape(-1, *shape[1:])
        while len(lines):
            taken = min(height - filled, len(lines))
            gathered[filled : filled + taken] = lines[:taken]
            lines, filled = lines[taken:], filled + taken
            if filled == height:
                yield gathered
                gathered, filled = np.empty_like(gathered), 0
    if filled:
        yield gathered[:filled]


def read_tiff(path: str | Path) -> Array:
    """Open a TIFF that `write_tiff` wrote: a read-only memory map, of a copy where it is compressed.

    Raises
    ------
    OSError
        When the copy finds no room among the temporary files.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        if file.pages.first.is_memmappable:
            return tifffile.memmap(path, mode="r")
        return np.asarray(file.asarray(out="memmap", maxworkers=cores()))
