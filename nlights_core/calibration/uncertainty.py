"""Uncertainty of height and normals by what all pixels of a tile share, and by what the model misses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nlights_core.calibration.fitting import Calibration
from nlights_core.calibration.linearisation import (
    CELL,
    coarse_grid,
    smooth_blocks,
    smooth_noise,
    smooth_residual,
)
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import simchony

SHARE = 0.45
"""Of what the parts below add up to: docs/accuracy.md says how many heights it covers, of captures that were not used
to choose it."""

WIDE = 4.0
"""Over how many blocks the errors that residuals hint at are smoothed."""


class SmoothErrors(NamedTuple):
    """Standard uncertainties that neighbours share, on coarse blocks.

    Attributes
    ----------
    height : (h, w) float32 array
        After the best constant, mm.
    slope : (h, w) float32 array
        Of a slope in one direction.
    noisier : (h, w) float32 array
        Factor of a normal's own noise, because gloss or rough paint tells more of slopes, or less, than matt paint.
    residual : float
        Smoothed residual beyond noise, rms over the blocks, as a share of the albedo: what the model misses.
    noise : float
        What noise alone leaves of it.
    """

    height: Array
    slope: Array
    noisier: Array
    residual: float
    noise: float


def smooth_errors(
    found: Calibration, lights: LightField, grid: PixelGrid, wandering: float = 0.0
) -> SmoothErrors:
    """Propagate the covariance of the shared unknowns, and what the model misses, to height and slopes.

    Parameters
    ----------
    found : Calibration
    lights : LightField
        Near lamps.
    grid : PixelGrid
        Of the reduced photographs.
    wandering : float
        Standard uncertainty of the place that a lamp's light comes from, beside that of the lamp, per axis, mm;
        0 where positions were not fitted.
    """
    equations = found.equations
    coarse = coarse_grid(grid)
    covariance = found.covariance.copy()
    # The last ones are the coordinates of the lamps, where they were fitted.
    last = np.arange(len(covariance) - 3 * len(found.shared.strengths), len(covariance))
    if found.positions:
        # A scatter that the photographs tell is no caution: it counts in full.
        covariance[last, last] = (found.positions / SHARE) ** 2
    if wandering:
        covariance[last, last] += wandering**2
    variance = np.einsum("mhw,mn,nhw->hw", equations.bends, covariance, equations.bends)
    across, down = (np.gradient(equations.bends, coarse.pixel_size, axis=axis) for axis in (2, 1))
    slope = np.einsum("mhw,mn,nhw->hw", across, covariance, across) / 2
    slope += np.einsum("mhw,mn,nhw->hw", down, covariance, down) / 2
    missed, missed_slope = _misfit(smooth_blocks(equations), lights, coarse)
    if found.strange.any():
        apart = block_means(found.apart - np.median(found.apart), CELL, coarse)
        missed = missed + (apart / SHARE) ** 2
    return SmoothErrors(
        (SHARE * np.sqrt(np.maximum(variance + missed, 0))).astype(np.float32),
        (SHARE * np.sqrt(np.maximum(slope + missed_slope, 0))).astype(np.float32),
        equations.noisier.astype(np.float32),
        smooth_residual(equations),
        smooth_noise(equations),
    )


def block_means(values: Array, edge: int, coarse: PixelGrid) -> Array:
    """Means over blocks of a map, the last ones in part beside it, (h, w)."""
    rows, columns = values.shape
    wide = np.pad(values, ((0, coarse.rows * edge - rows), (0, coarse.columns * edge - columns)), mode="edge")
    return np.asarray(wide.reshape(coarse.rows, edge, coarse.columns, edge).mean(axis=(1, 3)))


def _misfit(seen: Array, lights: LightField, coarse: PixelGrid) -> tuple[Array, Array]:
    """Variance of height and slope by what the model misses, (h, w) each; ``seen`` (L, h, w) is what it leaves.

    What it misses in the directions that the normals leave free can be seen; it is taken to miss as much in the three
    that the normals take.  All pairs of the ones and the others are tried.
    """
    from scipy.ndimage import gaussian_filter

    rays = lights.vectors(coarse.points(0, coarse.rows)).astype(np.float64)
    rays = np.moveaxis(rays / rays[..., 2:], 0, 2)
    basis, triangle = np.linalg.qr(rays, mode="complete")
    free = np.einsum("hwlk,lhw->khw", basis[..., 3:], seen)
    # Light = basis times triangle: a fault along a direction of the normals' space turns them by its inverse.
    turned = np.linalg.inv(triangle[..., :3, :])
    height, slope = np.zeros(coarse.shape), np.zeros(coarse.shape)
    for fault in free:
        for direction in range(3):
            across, up = (-turned[..., axis, direction] * fault for axis in (0, 1))
            height += simchony(across * coarse.pixel_size, -up * coarse.pixel_size) ** 2
            slope += (across**2 + up**2) / 2
    number = max(len(seen) - 3, 1)
    height, slope = (gaussian_filter(part / number, WIDE, mode="nearest") for part in (height, slope))
    return height, slope
