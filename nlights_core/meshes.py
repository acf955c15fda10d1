"""Surfaces as meshes: a vertex per pixel streamed to PLY, and a light GLB for viewers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core import __version__
from nlights_core.export import bands, block_means, srgb
from nlights_core.frames import Array, PixelGrid

REDUCED_PIXELS = 1_500_000
"""Block means leave at most so many samples before the quadric decimation."""

_VERTEX = np.dtype([("place", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])


def triangles(known: Array, index: Array) -> Array:
    """Two triangles for each 2 x 2 of known pixels, counter-clockwise seen from the camera.

    Parameters
    ----------
    known : (h, w) bool array
        Which pixels have a vertex.
    index : (h, w) integer array
        Number of each pixel's vertex.

    Returns
    -------
    (F, 3) array of the type of ``index``
        Vertices of the triangles, the cells in reading order.
    """
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    above_left, above_right = index[:-1, :-1][whole], index[:-1, 1:][whole]
    below_left, below_right = index[1:, :-1][whole], index[1:, 1:][whole]
    corners = [above_left, below_left, above_right, above_right, below_left, below_right]
    return np.stack(corners, axis=1).reshape(-1, 3)


def _count(height: Array) -> tuple[int, int]:
    """Vertices and faces of the full mesh, which a PLY must state before the first of them."""
    vertices = faces = 0
    for band in bands(height.shape[0], height[:1].nbytes):
        known = np.isfinite(height[band.start : band.stop + 1])
        vertices += int(known[: band.stop - band.start].sum())
        faces += 2 * int((known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]).sum())
    return vertices, faces


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
    vertices, faces = _count(height)
    if vertices > np.iinfo(np.int32).max:
        raise ValueError(f"{path}: {vertices} vertices exceed PLY's 32-bit indices; cut the tile in two")
    tell = progress or (lambda share: None)
    with Path(path).open("wb") as stream:
        stream.write(_header(vertices, faces, grid.unit))
        for band in bands(grid.rows, 4 * height[:1].nbytes):
            stream.write(_vertices(height, albedo, grid, band).data)
            tell(0.5 * band.stop / grid.rows)
        first = 0
        for band in bands(grid.rows, 8 * height[:1].nbytes):
            known = np.isfinite(height[band.start : band.stop + 1])
            index = (first - 1 + np.cumsum(known).reshape(known.shape)).astype(np.int32)
            corners = triangles(known, index)
            record = np.empty(len(corners), _FACE)
            record["corners"], record["vertices"] = 3, corners
            stream.write(record.data)
            first += int(known[: band.stop - band.start].sum())
            tell(0.5 + 0.5 * band.stop / grid.rows)
    return vertices, faces


def _vertices(height: Array, albedo: Array, grid: PixelGrid, band: slice) -> Array:
    """Vertex records of a band's known pixels, in reading order."""
    part = height[band]
    known = np.isfinite(part)
    record = np.empty(int(known.sum()), _VERTEX)
    record["place"] = grid.points(band.start, band.stop, part)[:, known].T
    colour = np.asarray(albedo[band])[known]
    record["colour"] = np.rint(255 * srgb(colour.reshape(len(record), albedo[0, 0].size)))
    return record


def write_glb(
    path: str | Path,
    height: Array,
    albedo: Array,
    grid: PixelGrid,
    *,
    faces: int = 200_000,
    texture_px: int = 2048,
) -> dict[str, Any]:
    """Write a light mesh for viewers: binary glTF, decimated, with the albedo as its texture.

    Block means reduce the height to at most `REDUCED_PIXELS`, then edges collapse in the order of
    their quadric error [1]_ until ``faces`` are left.  glTF is in metres with y up and the viewer
    on the side of +z: the plane frame's axes stay as they are, so the artwork stands upright and
    faces the viewer, and 1000 mm become 1.  Where the scale is not known 1000 px become 1.

    Parameters
    ----------
    path : str or Path
        File to write.
    height : (H, W) float32 array
        z, NaN where not known.
    albedo : (H, W), (H, W, 1) or (H, W, 3) float32 array
        Linear; the texture is its sRGB encoding (PNG), black where not known.
    grid : PixelGrid
        Where the pixels are.
    faces : int
        Faces to keep; fewer are written when the surface has fewer.
    texture_px : int
        Longest side of the texture, at most.

    Returns
    -------
    dict
        "faces" and "vertices": how many were written; "largest_deviation_mm": largest distance
        along z between the mesh and the reduced height at its samples, in the grid's unit (mm);
        "covered": share of the samples of the full reduced mesh that lie under the decimated one
        (its border may retreat).

    Raises
    ------
    ValueError
        When no 2 x 2 pixels are known.

    References
    ----------
    .. [1] M. Garland and P. S. Heckbert, "Surface simplification using quadric error metrics",
       SIGGRAPH 1997.
    """
    factor = min(max(1, int(np.ceil(np.sqrt(height.size / REDUCED_PIXELS)))), *grid.shape)
    reduced = block_means(height, factor)
    places, corners = _height_field(reduced)
    if not len(corners):
        raise ValueError(f"{path}: no 2 x 2 pixels of the height are known, so there is no surface to mesh")
    # Collapsing in units of the pixel makes the result independent of the artwork's scale.
    step = grid.pixel_size * factor
    places[:, 2] /= step
    samples = places
    if len(corners) > faces:
        import fast_simplification

        places, corners = fast_simplification.simplify(places, corners, target_count=faces)
    deviation, covered = _deviation(places, corners, samples, reduced.shape)
    x, y = (centres[0] for centres in grid.block_centres(factor))
    points = np.stack([x + step * places[:, 0], y - step * places[:, 1], step * places[:, 2]], axis=1)
    texture, uv = _texture(albedo, grid, points, texture_px)
    _save_glb(Path(path), _seen_in_perspective(points, grid), corners, texture, uv, grid.unit)
    return {
        "faces": len(corners),
        "vertices": len(places),
        "largest_deviation_mm": deviation * step,
        "covered": covered,
    }


def _height_field(height: Array) -> tuple[Array, Array]:
    """Vertices (column, row, z) and triangles of a height map; only vertices that have a face."""
    known = np.isfinite(height)
    corners = triangles(known, np.arange(height.size).reshape(height.shape))
    used, corners = np.unique(corners, return_inverse=True)
    rows, columns = np.divmod(used, height.shape[1])
    places = np.stack([columns, rows, height.ravel()[used]], axis=1).astype(np.float64)
    return places, corners.reshape(-1, 3)


def _deviation(places: Array, corners: Array, samples: Array, shape: tuple[int, int]) -> tuple[float, float]:
    """Largest distance along z of a mesh from samples, and the share of samples it covers.

    Parameters
    ----------
    places : (V, 3) float64 array
        Column, row and z of the mesh's vertices.
    corners : (F, 3) integer array
        Its triangles.
    samples : (N, 3) float64 array
        Column, row (whole numbers inside ``shape``) and z of the samples.
    shape : (int, int)
        Rows and columns of the samples' lattice.
    """
    truth = np.full(shape, np.nan)
    lattice = samples[:, 1].astype(int), samples[:, 0].astype(int)
    truth[lattice] = samples[:, 2]
    reached = np.zeros(shape, bool)
    largest = 0.0
    for start in range(0, len(corners), 4096):
        row, column, z = _scanned(places[corners[start : start + 4096]], shape)
        distance = np.abs(z - truth[row, column])
        reached[row, column] = True
        if np.isfinite(distance).any():
            largest = max(largest, float(np.nanmax(distance)))
    return largest, float(reached[lattice].mean())


def _scanned(faces: Array, shape: tuple[int, int]) -> tuple[Array, Array, Array]:
    """Lattice points under triangles (F, 3, 3: column, row, z), scan line by scan line, and z there."""
    order = np.argsort(faces[:, :, 1], axis=1, kind="stable")
    a, b, c = np.moveaxis(np.take_along_axis(faces, order[:, :, None], axis=1), 1, 0)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    area[np.abs(area) < 1e-4] = np.nan
    across = (ab[:, 2] * ac[:, 1] - ab[:, 1] * ac[:, 2]) / area
    down = (ab[:, 0] * ac[:, 2] - ab[:, 2] * ac[:, 0]) / area

    face, row = _ranges(a[:, 1], c[:, 1], shape[0], np.isfinite(area))
    with np.errstate(divide="ignore", invalid="ignore"):
        along_ac = a[:, 0][face] + (row - a[:, 1][face]) * (ac[:, 0] / ac[:, 1])[face]
        along_ab = a[:, 0][face] + (row - a[:, 1][face]) * (ab[:, 0] / ab[:, 1])[face]
        along_bc = c[:, 0][face] + (row - c[:, 1][face]) * ((c - b)[:, 0] / (c - b)[:, 1])[face]
    # The side through b has two parts; a horizontal part (0 / 0 or x / 0) is covered by the other.
    upper = (row < b[:, 1][face]) | (c[:, 1] == b[:, 1])[face]
    other = np.where(upper, along_ab, along_bc)
    span, column = _ranges(
        np.minimum(along_ac, other), np.maximum(along_ac, other), shape[1], np.isfinite(other)
    )
    face, row = face[span], row[span]
    z = a[face, 2] + across[face] * (column - a[face, 0]) + down[face] * (row - a[face, 1])
    return row, column, z


def _ranges(low: Array, high: Array, stop: int, valid: Array) -> tuple[Array, Array]:
    """All whole numbers in [low, high] and [0, stop): of which range each is, and the number."""
    slack = 1e-6  # a mesh vertex that lies on a sample must reach it
    first = np.maximum(np.ceil(np.where(valid, low, 0) - slack), 0).astype(int)
    last = np.minimum(np.floor(np.where(valid, high, -1) + slack), stop - 1).astype(int)
    count = np.where(valid, np.maximum(last - first + 1, 0), 0)
    owner = np.repeat(np.arange(len(count)), count)
    offset = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
    return owner, first[owner] + offset


def _texture(albedo: Array, grid: PixelGrid, points: Array, longest: int) -> tuple[Array, Array]:
    """The albedo as 8-bit sRGB (h, w, 3), ``longest`` px at most, and where points (N, 3) lie on it (N, 2).

    Points are given before perspective moves them: where their pixel's ray meets the plane.
    Coordinates run from 0 to 1, rightwards and upwards, over the whole blocks of pixels.
    """
    factor = min(-(-max(grid.shape) // longest), *grid.shape)
    code = np.rint(255 * srgb(block_means(albedo, factor))).astype(np.uint8)
    rows, columns = code.shape[:2]
    across = (points[:, 0] - grid.x()[0]) / grid.pixel_size + 0.5
    down = (grid.y(0, 1)[0] - points[:, 1]) / grid.pixel_size + 0.5
    uv = np.stack([across / (columns * factor), 1 - down / (rows * factor)], axis=1)
    return np.broadcast_to(code.reshape(rows, columns, -1), (rows, columns, 3)), np.clip(uv, 0, 1)


def _seen_in_perspective(points: Array, grid: PixelGrid) -> Array:
    """Points (N, 3) moved along their rays from the plane to their height, as `PixelGrid.points` does."""
    if grid.camera is None:
        return points
    moved = points.copy()
    for axis in (0, 1):
        moved[:, axis] += (grid.camera[axis] - points[:, axis]) * points[:, 2] / grid.camera[2]
    return moved


def _save_glb(path: Path, points: Array, corners: Array, texture: Array, uv: Array, unit: str) -> None:
    """Write a textured mesh given in the grid's unit as binary glTF, 1000 of them to the metre."""
    import trimesh
    from PIL import Image

    visual: Any = trimesh.visual
    material = visual.material.PBRMaterial(
        name="albedo",
        baseColorTexture=Image.fromarray(np.ascontiguousarray(texture)),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    mesh = trimesh.Trimesh(
        points / 1000,
        corners,
        visual=visual.TextureVisuals(uv=uv, material=material),
        process=False,
        metadata={"frame": "x right, y up, z from the artwork to the camera", "unit": f"1 = 1000 {unit}"},
    )
    scene: Any = trimesh.Scene()
    scene.add_geometry(mesh, node_name="surface", geom_name="surface")
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
