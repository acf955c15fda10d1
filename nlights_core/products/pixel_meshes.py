"""Surfaces as PLY: a mesh with a vertex per pixel, streamed by bands of rows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nlights_core import __version__
from nlights_core.files.reduction import bands_of_bytes
from nlights_core.files.steady_files import SteadyFile
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.products.viewing import srgb_codes

_VERTEX = np.dtype(
    [(axis, "<f4") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")]
)
_FACE = np.dtype([("corners", "u1"), ("a", "<i4"), ("b", "<i4"), ("c", "<i4")])


def _header(vertices: int, faces: int, unit: str) -> bytes:
    """Header of the binary PLY."""
    return "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment nLights {__version__}",
            f"comment unit {unit}; x right, y up, z from the artwork to the camera",
            f"element vertex {vertices}",
            *(f"property float {axis}" for axis in "xyz"),
            *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
            f"element face {faces}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
    ).encode("ascii")


def write_ply(
    path: str | Path,
    height: Array,
    albedo: Array,
    grid: PixelGrid,
    progress: Callable[[float], None] | None = None,
) -> tuple[int, int]:
    """Write the surface with a vertex per known pixel: binary PLY, streamed by bands of rows.

    Vertices are in the plane frame and the grid's unit, moved sideways by perspective as in
    `PixelGrid.points`, coloured with the sRGB albedo.  An unknown pixel has no vertex; each 2 x 2
    of known pixels makes two triangles that face the camera (+z).

    Parameters
    ----------
    path : str or Path
        File to write: 15 bytes a vertex, 13 a face; 4.2 GB for 100 megapixels.
    height : (H, W) float32 array
        z, NaN where not known.
    albedo : (H, W), (H, W, 1) or (H, W, 3) float32 array
        Linear; NaN becomes black.
    grid : PixelGrid
        Where the pixels are.
    progress : callable, optional
        Told the share that is done, from 0 to 1.

    Returns
    -------
    vertices, faces : int
        How many were written.

    Raises
    ------
    ValueError
        When the vertices exceed what PLY's 32-bit indices can number.
    OSError
        When the file cannot be written.
    """
    from nlights_core.products import compiled_meshes

    places = list(bands_of_bytes(grid.rows, 15 * grid.columns))
    rows = [band.stop - band.start for band in places]
    beyond = [np.s_[band.start : band.stop + 1] for band in places]
    counts = list(in_order(lambda i: compiled_meshes.count(height[beyond[i]], rows[i]), range(len(places))))
    vertices, faces = (sum(count[i] for count in counts) for i in range(2))
    if vertices > np.iinfo(np.int32).max:
        raise ValueError(f"{path}: {vertices} vertices exceed PLY's 32-bit indices; cut the tile in two")
    first = np.cumsum([0, *(count[0] for count in counts)])

    def points(i: int) -> Array:
        return _vertices(height[places[i]], albedo[places[i]], grid, places[i], counts[i][0])

    def corners(i: int) -> Array:
        record = np.empty(counts[i][1], _FACE)
        compiled_meshes.faces(height[beyond[i]], rows[i], int(first[i]), record)
        return record

    with SteadyFile(Path(path), "wb") as stream:
        stream.write(_header(vertices, faces, grid.unit))
        for half, records in enumerate((points, corners)):
            for i, record in enumerate(in_order(records, range(len(places))), start=1):
                stream.write(record.data)
                if progress:
                    progress(0.5 * (half + i / len(places)))
    return vertices, faces


def _vertices(height: Array, albedo: Array, grid: PixelGrid, band: slice, count: int) -> Array:
    """Vertex records of a band's known pixels, in reading order."""
    from nlights_core.products import compiled_meshes

    record = np.empty(count, _VERTEX)
    colours = srgb_codes(albedo, np.uint8).reshape(*height.shape, -1)
    camera = np.array(grid.camera or (0, 0, np.inf), np.float32)
    x, y = (axis.astype(np.float32) for axis in (grid.x(), grid.y(band.start, band.stop)))
    compiled_meshes.vertices(height, colours, x, y, camera, record)
    return record
