"""Gradients and heights along the rays that see a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration import bands, mean_per_island


def facing_rays(normals: Array, grid: PixelGrid) -> Array:
    """How far each normal faces the pixel's ray: what divides its slope.

    It is ``-n.E``, where ``E = (P0 - C) / C_z`` is the ray from the camera C to the pixel's point
    P0 of the plane, as long as it is for 1 of height; so it is the cosine of the angle to the ray
    times ``|E|``, and n_z where the camera is orthographic.

    Parameters
    ----------
    normals : (H, W, 3) float array
        Unit vectors in the plane frame; NaN where not known.
    grid : PixelGrid
        Without a camera its rays are parallel.

    Returns
    -------
    (H, W) array
        In the precision of the normals, above 0; NaN where not known and where the surface would be seen from behind.
    """
    facing = np.empty(grid.shape, normals.dtype)
    for lines in bands(grid.rows):
        x, y = ray_slopes(grid, lines, normals.dtype)
        n = normals[lines]
        facing[lines] = n[..., 2] - n[..., 0] * x - n[..., 1] * y
    facing[~(facing > 0)] = np.nan
    return facing


def seen_gradient(normals: Array, facing: Array, grid: PixelGrid, steepest_deg: float) -> tuple[Array, Array]:
    """Gradients of a surface along the rays that see it, integrable on the photograph's grid.

    A point of the surface lies at ``C + t (P0 - C)`` on the ray from a pinhole C through the
    pixel's point P0 of the plane.  Not z but log t has a gradient that the normal alone decides;
    what is returned are the steps of ``-C_z log t``, a length that is z to first order, and that
    is z itself where the camera is orthographic.

    Parameters
    ----------
    normals : (H, W, 3) float array
        Unit vectors in the plane frame.
    facing : (H, W) float array
        As `facing_rays` gives it.
    grid : PixelGrid
        The same.
    steepest_deg : float
        Slopes against the plane across the ray are limited to this angle, degrees.

    Returns
    -------
    per_column, per_row : (H, W) arrays
        In the precision of the normals and the grid's unit; NaN where ``facing`` is.

    References
    ----------
    J.-D. Durou, F. Courteille, "Integration of a normal field without boundary condition", in:
    Photometric Analysis for Computer Vision, ICCV workshop (2007).
    """
    per_column, per_row = np.empty_like(facing), np.empty_like(facing)
    steepest = float(np.tan(np.radians(steepest_deg)))
    for lines in bands(grid.rows):
        x, y = ray_slopes(grid, lines, normals.dtype)
        sine = np.sqrt(np.maximum(1 + x**2 + y**2 - facing[lines] ** 2, 0))
        scale = grid.pixel_size / np.maximum(facing[lines], sine / steepest)
        per_column[lines] = -normals[lines, :, 0] * scale
        per_row[lines] = normals[lines, :, 1] * scale
    return per_column, per_row


def ray_slopes(grid: PixelGrid, lines: slice, precision: DTypeLike) -> tuple[Array, Array]:
    """How far sideways the pixels' rays go for 1 of depth.

    Parameters
    ----------
    grid : PixelGrid
        Without a camera its rays are parallel.
    lines : slice
        The rows that are wanted.
    precision : dtype

    Returns
    -------
    x, y : (W,) and (h, 1) arrays
    """
    x, y = grid.x(), grid.y(lines.start, lines.stop)[:, None]
    if grid.camera is None:
        return np.zeros(x.shape, precision), np.zeros(y.shape, precision)
    camera = grid.camera
    across, down = (x - camera[0]) / camera[2], (y - camera[1]) / camera[2]
    return across.astype(precision), down.astype(precision)


def perspective_height(scaled_log: Array, camera_height: float) -> Array:
    """z from the integral of `seen_gradient`, ``-C_z log t``.

    The constant that the integral leaves free is a factor of t, not a shift of z: it is chosen
    so that z has mean 0, on each island of known pixels by itself.

    Parameters
    ----------
    scaled_log : (H, W) float array
        ``-C_z log t`` up to a constant, in the camera's unit; NaN where not known.
    camera_height : float
        C_z: distance of the camera from the plane.

    Returns
    -------
    (H, W) float array
        ``z = C_z (1 - t)`` of the point that each pixel sees.
    """
    nearness = -np.expm1(scaled_log / -camera_height)
    mean = mean_per_island(nearness)
    height: Array = camera_height * (nearness - mean) / (1 - mean)
    return height
