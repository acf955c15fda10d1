"""Smooth errors of normals and height by the uncertainty of the lamps' measured positions.

Noise differs from pixel to pixel and averages out in the height.  A lamp that is a millimetre
off bends the whole field instead, and only this tells by how much.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nlights_core.fields import LightField
from nlights_core.files.reduction import block_means
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.solving.least_squares import COVERING, fit, multiply

BLOCKS = 32
"""Blocks along the longer side of the field: the errors are smooth."""

STEP = 0.1
"""Shift of a lamp by which derivatives are taken, mm."""


class PositionUncertainty(NamedTuple):
    """Root mean squares over the field.

    Attributes
    ----------
    normals : float
        Angle within which 68 % of the true normals lie, degrees.
    height : float
        Standard deviation of the height about its mean, mm.
    """

    normals: float
    height: float


def position_uncertainty(
    normals: Array, grid: PixelGrid, lights: LightField, uncertainty: float, *, photographed: bool
) -> PositionUncertainty | None:
    """Propagate the uncertainty of the lamps' positions to first order.

    Every coordinate of every lamp is uncertain by itself.  A wrong position makes the light L_i
    that a solver assumes wrong by dL_i, and the scaled normal b by
    ``-M^-1 sum L_i (dL_i . b)``, ``M = sum L_i L_i^T``.  The sum over all coordinates of the
    squares, times the variance of a coordinate, is the variance.  The height's follows from
    integrating the slopes' error of each coordinate.

    Parameters
    ----------
    normals : (H, W, 3) float32 array
        Unit normals; NaN where not known.  Only their means over blocks matter.
    grid : PixelGrid
        Where the pixels are, mm.
    lights : LightField
        Near lamps.
    uncertainty : float
        Standard uncertainty of each coordinate, mm.
    photographed : bool
        The photographs were divided by those of a flat, which hold each lamp's true
        irradiance; otherwise the irradiance is computed from the position, and wrong with it.

    Returns
    -------
    PositionUncertainty or None
        None for distant lamps, and where no block of the field is known.
    """
    if lights.positions is None:
        return None
    blocks, coarse = _block_means(normals, grid)
    known = np.isfinite(blocks).all(axis=-1)
    if not known.any():
        return None
    blocks[~known] = [0, 0, 1]
    n = np.moveaxis(blocks, -1, 0)
    points = coarse.points(0, coarse.rows)
    rays = _light(lights, points, photographed)
    inverse = fit(np.ones(rays.shape[:3]), rays, np.ones(rays.shape[:3]), np.inf).inverse
    angles, heights = np.zeros(coarse.shape), np.zeros(coarse.shape)
    for lamp in range(len(rays)):
        for axis in range(3):
            moved = np.array(lights.positions)
            moved[lamp, axis] += STEP
            shifted = _light(replace(lights, positions=moved), points, photographed)[lamp]
            change = np.sum((shifted - rays[lamp]) / STEP * blocks, axis=-1)
            wrong = -multiply(inverse, np.moveaxis(rays[lamp], -1, 0) * change)
            turned = wrong - n * np.sum(wrong * n, axis=0)
            angles += np.sum(turned**2, axis=0)
            # p = -n_x / n_z per column and q = n_y / n_z per row, differentiated.
            across, down = (wrong[:2] * n[2] - wrong[2] * n[:2]) / n[2] ** 2 * coarse.pixel_size
            heights += np.square(simchony(-across, down))
    component = uncertainty * np.sqrt(np.mean(angles[known]) / 2)
    return PositionUncertainty(
        float(np.degrees(COVERING * component)), float(uncertainty * np.sqrt(np.mean(heights[known])))
    )


def _block_means(normals: Array, grid: PixelGrid) -> tuple[Array, PixelGrid]:
    """Mean normals of blocks (h, w, 3), NaN where less than half is known, and the grid of the blocks."""
    edge = max(1, -(-max(grid.shape) // BLOCKS))
    means = block_means(normals, edge).astype(np.float64)
    return means, grid.reduced(edge)


def _light(lights: LightField, points: Array, photographed: bool) -> Array:
    """Light of each lamp as a solver takes it, (L, h, w, 3) float64."""
    assert lights.positions is not None
    rays = lights.positions[:, None, None, :] - np.moveaxis(points, 0, -1)
    if photographed:
        return np.asarray(rays / rays[..., 2:])
    squared = np.sum(rays**2, axis=-1, keepdims=True)
    reference = np.sum(lights.positions**2, axis=-1)[:, None, None, None]
    return np.asarray(rays / np.sqrt(squared) * reference / squared)
