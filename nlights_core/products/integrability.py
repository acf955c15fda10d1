"""Integrability: the part of measured normals that no surface can have is taken out of them.

Every surface's slopes are free of curl, noise is not: half of it is curl.  The height that was
integrated from the normals shows which part of them a surface can have, so that normals corrected
by it have about three quarters of the error.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array, PixelGrid

HALO = 6
"""Rows beyond a band that its corrections depend on."""

STEEPEST_DEG = 80.0
"""Steeper normals are left as they are: there the slope is hardly a number."""

OWN, AROUND = 0.350, 0.207
"""What is left of a pixel's own variance, and of the mean of its 3 x 3 neighbourhood, by Parseval's
theorem for white noise: in all 0.557."""


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
    from nlights_core.products import compiled_integrability as kernels

    first, last = max(start - HALO, 0), min(stop + HALO, grid.rows)
    around, surface = normals[first:last], height[first:last]
    rows, columns, margin = last - first, grid.columns, kernels.BEFORE + kernels.AFTER
    x, y, distance = np.zeros(columns), np.zeros(rows), 0.0
    if perspective and grid.camera is not None:
        distance = float(grid.camera[2])
        x = (grid.x() - grid.camera[0]) / distance
        y = (grid.y(first, last) - grid.camera[1]) / distance
    across, beside = (np.empty((rows, columns + margin), np.float32) for _ in range(2))
    down, below = (np.empty((rows + margin, columns), np.float32) for _ in range(2))
    cosine = float(np.cos(np.radians(STEEPEST_DEG)))
    kernels.steps_of_normals(around, grid.pixel_size, cosine, x, y, across, down)
    kernels.subtract_height_steps(across, surface, distance, 0, beside)
    kernels.subtract_height_steps(down, surface, distance, 1, below)
    out = np.empty((stop - start, columns, 3), np.float32)
    kernels.correct_normals(around, across, down, beside, below, grid.pixel_size, x, y, out, start - first)
    return out


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
    from nlights_core.products import compiled_integrability

    first, last = max(start - 1, 0), min(stop + 1, len(confidence))
    out = np.empty((stop - start, confidence.shape[1]), np.float32)
    compiled_integrability.smoothed_uncertainty(confidence[first:last], start - first, OWN, AROUND, out)
    return out
