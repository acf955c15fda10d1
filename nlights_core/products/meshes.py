"""Surfaces as light meshes for viewers: decimated, textured, with their deviation measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.files.reduction import block_means
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import read_only
from nlights_core.products.viewing import srgb_codes

REDUCED_PIXELS = 8_000_000
"""Block means leave at most so many samples of the height."""

REFINED = 4
"""Times the faces that are kept, the network has: fewer raise the rms deviation, more the largest."""

BANDS = 16
"""Bands of rows in which the deviation is measured."""

SQUARE = 128
"""Steps along the squares that the network starts from, at most; a power of two."""


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

    Block means reduce the height to at most `REDUCED_PIXELS`.  A right-triangulated irregular network
    over them [1]_, as fine as `REFINED` times ``faces`` allow, keeps the largest deviation small; then
    edges collapse in the order of their quadric error [2]_, which keeps the typical one small, until
    ``faces`` are left.  What is stated is measured, at every pixel of ``height``.

    glTF is in metres with y up and the viewer on the side of +z: the plane frame's axes stay as they
    are, so the artwork stands upright and faces the viewer, and 1000 mm become 1.  Where the scale is
    not known 1000 px become 1.

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
        "faces" and "vertices": how many were written; "largest_deviation_mm" and "rms_deviation_mm":
        of the mesh from the height along z, over all known pixels under it, in the grid's unit (mm);
        "covered": share of the known pixels that lie under it (its border lies half a block inside);
        "bridged": share of the unknown ones that do (gaps of less than half a block).

    Raises
    ------
    ValueError
        When no 2 x 2 pixels are known.

    References
    ----------
    .. [1] W. Evans, D. Kirkpatrick, G. Townsend, "Right-triangulated irregular networks",
       Algorithmica 30 (2001) 264-286.
    .. [2] M. Garland and P. S. Heckbert, "Surface simplification using quadric error metrics",
       SIGGRAPH 1997.
    """
    from nlights_core.products import compiled_meshes

    block = min(-(-max(grid.shape) // texture_px), *grid.shape)
    places, corners, found = _decimated(height, grid, faces)
    if not len(corners):
        raise ValueError(f"{path}: no 2 x 2 pixels of the height are known, so there is no surface to mesh")
    points = np.stack(
        [
            grid.x()[0] + grid.pixel_size * places[:, 0],
            grid.y(0, 1)[0] - grid.pixel_size * places[:, 1],
            places[:, 2],
        ],
        axis=1,
    )
    texture = _texture(albedo, block)
    uv = _on_texture(places, texture.shape[:2], block)
    points = _seen_in_perspective(points, grid) / 1000
    normals = np.empty(points.shape, np.float32)
    compiled_meshes.vertex_normals(points, corners, normals)
    _save_glb(Path(path), points, normals, corners, texture, uv, grid.unit)
    return {"faces": len(corners), "vertices": len(places), **found}


def _decimated(height: Array, grid: PixelGrid, faces: int) -> tuple[Array, Array, dict[str, float]]:
    """Vertices (column, row, z) and triangles of at most ``faces``, none where none are; their deviation."""
    factor = min(max(1, int(np.ceil(np.sqrt(height.size / REDUCED_PIXELS)))), *grid.shape)
    reduced = block_means(height, factor)
    if 2 * reduced.size <= REFINED * faces or min(reduced.shape) < 2:
        places, corners = _height_field(reduced)
    else:
        places, corners = refined(reduced, REFINED * faces)
    if len(corners) > faces:
        import fast_simplification

        # Collapsing in units of the lattice makes the result independent of the artwork's scale.
        step = np.array([1, 1, grid.pixel_size * factor])
        places, corners = fast_simplification.simplify(places / step, corners, target_count=faces)
        places = places * step
    # From blocks to pixels: the centre of the first block lies amid its pixels.
    places[:, :2] = places[:, :2] * factor + (factor - 1) / 2
    return places, corners, deviation(places, corners, height)


def _height_field(height: Array) -> tuple[Array, Array]:
    """Vertices (column, row, z) and triangles of a height map; only vertices that have a face."""
    known = np.isfinite(height)
    corners = triangles(known, np.arange(height.size).reshape(height.shape))
    used, corners = np.unique(corners, return_inverse=True)
    rows, columns = np.divmod(used, height.shape[1])
    places = np.stack([columns, rows, height.ravel()[used]], axis=1).astype(np.float64)
    return places, corners.reshape(-1, 3)


def refined(height: Array, faces: int) -> tuple[Array, Array]:
    """A right-triangulated irregular network over a height map, with the smallest tolerance it has faces for.

    Parameters
    ----------
    height : (h, w) float32 array
        NaN where not known: no triangle has such a corner, and around them the network is as fine as
        the map.  At least 2 x 2.
    faces : int
        About how many triangles there shall be, not counting those at the rims of what is not known.

    Returns
    -------
    places : (V, 3) float64 array
        Column, row and z of the vertices.
    corners : (F, 3) int32 array
        The triangles, counter-clockwise seen from the camera.
    """
    from nlights_core.products import compiled_meshes

    size = min(SQUARE, 1 << (min(height.shape) - 1).bit_length() - 1)
    squares = [(length - 1) // size for length in height.shape]
    # The squares' steps are a little longer than the map's where these are no multiple of a square.
    rows, columns = (
        np.rint(np.linspace(0, length - 1, count * size + 1)).astype(int)
        for length, count in zip(height.shape, squares, strict=True)
    )
    z = height[np.ix_(rows, columns)]
    errors = compiled_meshes.split_errors(z, size)
    # Every middle above the tolerance makes two triangles of two.
    splits = max(faces // 2 - squares[0] * squares[1], 1)
    known = errors[np.isfinite(errors)]
    tolerance = 2 * np.spacing(np.max(np.abs(z), where=np.isfinite(z), initial=0))
    if len(known) > splits:
        tolerance = max(tolerance, np.partition(known, -splits)[-splits])
    number = np.full(z.shape, -1, np.int32)
    _, count = compiled_meshes.network(z, errors, size, tolerance, number, np.empty((0, 3), np.int32))
    corners = np.empty((count, 3), np.int32)
    vertices, _ = compiled_meshes.network(z, errors, size, tolerance, number, corners)
    i, j = np.nonzero(number >= 0)
    places = np.empty((vertices, 3))
    places[number[i, j]] = np.stack([columns[j], rows[i], z[i, j]], axis=1)
    return places, corners


def deviation(places: Array, corners: Array, height: Array) -> dict[str, float]:
    """Deviation of a mesh from a height map along z, at every pixel.

    Parameters
    ----------
    places : (V, 3) float64 array
        Column, row and z of the vertices.
    corners : (F, 3) integer array
        The triangles; seen along z none overlaps another.
    height : (H, W) float32 array
        NaN where not known.

    Returns
    -------
    dict
        "largest_deviation_mm", "rms_deviation_mm", "covered" and "bridged", as `write_glb` says.
    """
    from nlights_core.products import compiled_meshes

    triangles, surface = np.asarray(corners, np.int32), read_only(np.ascontiguousarray(height, np.float32))

    def parts(band: slice) -> tuple[float, float, int, int, int]:
        return compiled_meshes.deviation(places, triangles, surface, band.start, band.stop)

    # Few bands: each looks through all triangles for its own.
    rows = max(1, -(-len(height) // BANDS))
    bands = [slice(start, min(start + rows, len(height))) for start in range(0, len(height), rows)]
    largest, squares, compared, reached, known = zip(*in_order(parts, bands), strict=True)
    count = sum(compared)
    return {
        "largest_deviation_mm": max(largest),
        "rms_deviation_mm": float(np.sqrt(sum(squares) / max(count, 1))),
        "covered": count / max(sum(known), 1),
        "bridged": (sum(reached) - count) / max(height.size - sum(known), 1),
    }


def _texture(albedo: Array, block: int) -> Array:
    """The albedo as 8-bit sRGB (h, w, 3), a pixel for each block of pixels."""
    code = srgb_codes(block_means(albedo, block), np.uint8)
    code = code.reshape(*code.shape[:2], -1)
    return np.ascontiguousarray(np.broadcast_to(code, (*code.shape[:2], 3)))


def _on_texture(places: Array, shape: tuple[int, int], block: int) -> Array:
    """Coordinates of vertices (column, row, z) on a texture of blocks: from 0 to 1, rightwards and upwards.

    Perspective moves a vertex, but not on the texture: it has the colour of its pixel.
    """
    across = (places[:, 0] + 0.5) / (shape[1] * block)
    down = (places[:, 1] + 0.5) / (shape[0] * block)
    uv = np.stack([across, 1 - down], axis=1)
    return np.clip(uv, 0, 1)


def _seen_in_perspective(points: Array, grid: PixelGrid) -> Array:
    """Points (N, 3) moved along their rays from the plane to their height, as `PixelGrid.points` does."""
    if grid.camera is None:
        return points
    moved = points.copy()
    for axis in (0, 1):
        moved[:, axis] += (grid.camera[axis] - points[:, axis]) * points[:, 2] / grid.camera[2]
    return moved


def _save_glb(
    path: Path, points: Array, normals: Array, corners: Array, texture: Array, uv: Array, unit: str
) -> None:
    """Write a textured mesh given in metres as binary glTF; ``unit`` is what 1000 were of."""
    import trimesh
    from PIL import Image

    visual: Any = trimesh.visual
    material = visual.material.PBRMaterial(
        name="albedo", baseColorTexture=Image.fromarray(texture), metallicFactor=0.0, roughnessFactor=1.0
    )
    mesh = trimesh.Trimesh(
        points,
        corners,
        vertex_normals=normals,
        visual=visual.TextureVisuals(uv=uv, material=material),
        process=False,
        metadata={"frame": "x right, y up, z from the artwork to the camera", "unit": f"1 = 1000 {unit}"},
    )
    scene: Any = trimesh.Scene()
    scene.add_geometry(mesh, node_name="surface", geom_name="surface")
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
