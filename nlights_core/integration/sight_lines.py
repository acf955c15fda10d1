"""Gradients and heights along the rays that see a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import island_means, islands, plane, row_slices, sum_per_island
from nlights_core.machine.band_threads import in_order

ALL = slice(None)
"""All rows."""

LINES = 16
"""Lines that are worked on at once: they fit into a core's cache."""


def facing_rays(normals: Array, grid: PixelGrid, rows: slice = ALL) -> Array:
    """Divisor of each normal's slope: how far the normal faces the pixel's ray.

    It is ``-n.E``, where ``E = (P0 - C) / C_z`` is the ray from the camera C to the pixel's point
    P0 of the plane, as long as it is for 1 of height; so it is the cosine of the angle to the ray
    times ``|E|``, and n_z where the camera is orthographic.

    Parameters
    ----------
    normals : (H, W, 3) float array
        Unit vectors in the plane frame; NaN where not known.
    grid : PixelGrid
        Of the whole field.  Without a camera its rays are parallel.
    rows : slice
        Rows of the grid that these normals are.

    Returns
    -------
    (H, W) array
        In the precision of the normals, above 0; NaN where not known and where the surface would be seen from behind.
    """
    facing = np.empty(normals.shape[:2], normals.dtype)
    x, down = ray_slopes(grid, rows, normals.dtype)
    for lines in row_slices(len(normals)):
        n, y = normals[lines], down[lines]
        facing[lines] = n[..., 2] - n[..., 0] * x - n[..., 1] * y
    facing[~(facing > 0)] = np.nan
    return facing


def seen_gradient(
    normals: Array, facing: Array, grid: PixelGrid, steepest_deg: float, rows: slice = ALL
) -> tuple[Array, Array]:
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
    rows : slice
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
    x, down = ray_slopes(grid, rows, normals.dtype)
    for lines in row_slices(len(normals)):
        y = down[lines]
        sine = np.sqrt(np.maximum(1 + x**2 + y**2 - facing[lines] ** 2, 0))
        scale = grid.pixel_size / np.maximum(facing[lines], sine / steepest)
        per_column[lines] = -normals[lines, :, 0] * scale
        per_row[lines] = normals[lines, :, 1] * scale
    return per_column, per_row


def ray_slopes(grid: PixelGrid, rows: slice, precision: DTypeLike) -> tuple[Array, Array]:
    """Distance that the pixels' rays go sideways for 1 of depth.

    Parameters
    ----------
    grid : PixelGrid
        Without a camera its rays are parallel.
    rows : slice
        The rows that are wanted.
    precision : dtype

    Returns
    -------
    x, y : (W,) and (h, 1) arrays
    """
    x, y = grid.x(), grid.y()[rows, None]
    if grid.camera is None:
        return np.zeros(x.shape, precision), np.zeros(y.shape, precision)
    camera = grid.camera
    across, down = (x - camera[0]) / camera[2], (y - camera[1]) / camera[2]
    return across.astype(precision), down.astype(precision)


def seen_surface(scaled_log: Array, tilt: tuple[float, float], camera_height: float | None) -> None:
    """Make z, in place, of the integral of `seen_gradient`.

    The constant that the integral leaves free is a factor of t, not a shift of z: it is chosen
    so that z has mean 0, on each island of known pixels by itself.

    Parameters
    ----------
    scaled_log : (H, W) float array
        ``-C_z log t`` up to a constant and a plane, in the camera's unit; NaN where not known.
        Becomes ``z = C_z (1 - t)`` of the point that each pixel sees.
    tilt : two floats
        Step of that plane per column and per row.
    camera_height : float, optional
        C_z: distance of the camera from the plane.  None: the integral is z already.
    """
    label, count = islands(np.isfinite(scaled_log))
    plane_x, plane_y = plane(scaled_log.shape, tilt, scaled_log.dtype)

    def nearness(lines: slice) -> Array:
        part = scaled_log[lines]
        part += plane_x
        part += plane_y[lines]
        if camera_height is not None:
            part /= -camera_height
            np.expm1(part, out=part)
        return sum_per_island(part, label, count, lines)

    means = island_means(in_order(nearness, row_slices(len(scaled_log), LINES)), label, scaled_log.size)
    # Of 1 - t, but for the sign, which expm1 gives: 1 - t = -expm1.
    factors = np.ones_like(means) if camera_height is None else -camera_height / (1 + means)
    means, factors = means.astype(scaled_log.dtype), factors.astype(scaled_log.dtype)

    def centred(lines: slice) -> None:
        part = scaled_log[lines]
        here = label[lines] if label.size > 1 else label
        part -= means[here]
        part *= factors[here]

    list(in_order(centred, row_slices(len(scaled_log), LINES)))


def perspective_height(scaled_log: Array, camera_height: float) -> Array:
    """The z of `seen_surface`, without a plane and as an array of its own."""
    height = scaled_log.copy()
    seen_surface(height, (0.0, 0.0), camera_height)
    return height
