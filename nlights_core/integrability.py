"""Integrability: the part of measured normals that no surface can have is taken out of them.

Every surface's slopes are free of curl, noise is not: half of it is curl.  The height that was
integrated from the normals shows which part of them a surface can have, so that normals corrected
by it have about three quarters of the error.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration import height_steps

HALO = 6
"""Rows beyond a band that its corrections depend on."""

STEEPEST_DEG = 80.0
"""Steeper normals are left as they are: there the slope is hardly a number."""

OWN, AROUND = 0.350, 0.207
"""What is left of a pixel's own variance, and of the mean of its 3 x 3 neighbourhood, by Parseval's
theorem for white noise: in all 0.557."""

_BETWEEN = np.array([3, -25, 150, 150, -25, 3]) / 256
"""A value midway between the middle two of six samples."""


def integrable_normals(
    normals: Array, height: Array, grid: PixelGrid, start: int, stop: int, *, perspective: bool
) -> Array:
    """Correct the normals of a band of rows by the height that was integrated from them.

    What the measured slopes predict for the step from a pixel to the next, less the step that the
    height has there, is the curl's; it is read off between the pixels (`height_steps`), brought
    back onto them by interpolation, and subtracted.  A surface's own waves of four pixels and
    more are kept to 1 %.  Where height or normal is not known nothing is subtracted.

    Parameters
    ----------
    normals : (H, W, 3) float32 array
        Unit normals, plane frame; NaN where not known.
    height : (H, W) float32 array
        Integrated from these normals, mm.
    grid : PixelGrid
        Of the whole field.
    start, stop : int
        The band; the rows around it are looked at too.
    perspective : bool
        Whether the integrator took the camera for a pinhole.

    Returns
    -------
    (stop - start, W, 3) float32 array
        Unit normals.

    Notes
    -----
    Orthogonal projection onto integrable fields: R. T. Frankot, R. Chellappa, IEEE TPAMI 10
    (1988) 439-451, here with the free borders and the masks of the height.
    """
    first, last = max(start - HALO, 0), min(stop + HALO, grid.rows)
    around = normals[first:last]
    with np.errstate(divide="ignore", invalid="ignore"):
        known = around[..., 2] > np.cos(np.radians(STEEPEST_DEG))
        scale = np.where(known, grid.pixel_size / around[..., 2], np.nan).astype(np.float64)
    across, down = -around[..., 0] * scale, around[..., 1] * scale
    surface = np.asarray(height[first:last], np.float64)
    x = y = np.zeros(1)
    if perspective and grid.camera is not None:
        camera = grid.camera
        x = (grid.x() - camera[0]) / (grid.pixel_size * camera[2])
        y = (grid.y(first, last) - camera[1])[:, None] / (grid.pixel_size * camera[2])
        facing = 1 + across * x - down * y
        across, down = across / facing, down / facing
        surface = -camera[2] * np.log1p(-surface / camera[2])
    across = across - _curl(across, surface)
    down = down - _curl(down.T, surface.T).T
    facing = 1 - across * x + down * y
    band = slice(start - first, stop - first)
    corrected = np.stack([-across, down, grid.pixel_size * facing], axis=-1)[band]
    corrected /= np.linalg.norm(corrected, axis=-1, keepdims=True)
    return np.where(known[band, :, None], corrected, around[band]).astype(np.float32)


def _curl(slopes: Array, height: Array) -> Array:
    """What slopes along lines say beyond the height's own steps, at the pixels, (n, N)."""
    missed = height_steps(slopes, "6-point") - np.diff(height, axis=1)
    reach = len(_BETWEEN) // 2
    # No step crosses a border, and none of the surplus does.
    padded = np.pad(np.nan_to_num(missed), ((0, 0), (reach, reach)))
    count = slopes.shape[1]
    return np.asarray(sum(w * padded[:, k : k + count] for k, w in enumerate(_BETWEEN)))


def integrable_uncertainty(confidence: Array, start: int, stop: int) -> Array:
    """Standard uncertainty of corrected normals, degrees.

    Parameters
    ----------
    confidence : (H, W) float32 array
        Of the measured normals; NaN where not known.
    start, stop : int
        The band of rows.

    Returns
    -------
    (stop - start, W) float32 array
    """
    from scipy.ndimage import uniform_filter

    first, last = max(start - 1, 0), min(stop + 1, len(confidence))
    variance = np.square(confidence[first:last], dtype=np.float64)
    known = np.isfinite(variance)
    total = uniform_filter(np.where(known, variance, 0), 3, mode="nearest")
    share = uniform_filter(known.astype(np.float64), 3, mode="nearest")
    left = OWN * variance + AROUND * total / np.maximum(share, 1 / 9)
    out: Array = np.sqrt(left[start - first : stop - first]).astype(np.float32)
    return out
