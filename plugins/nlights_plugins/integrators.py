"""Integrators: height from a field of normals."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import Integrator
from nlights_core.fields import HeightMap, NormalField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.normal_integration import PLAIN, least_squares_height, sample_rows
from nlights_core.integration.poisson import Stencil, frankot_chellappa
from nlights_core.integration.sight_lines import facing_rays, seen_gradient, seen_surface
from nlights_core.integration.weighted_integration import (
    evenly_certain,
    middle_uncertainty,
    relative_uncertainty,
    weighted_height,
)

FLATTENED_DEG = 70.0
"""Slopes that all count the same are limited to this angle: a single one could bend the whole."""


class SlopeIntegrator(Integrator):
    """Base of both integrators: whose rays are followed."""

    bytes_per_pixel: ClassVar[int] = PLAIN
    """Evenly certain and all known; others ask for more once they are seen."""

    perspective: bool = Field(
        default=True,
        description="follow the rays of the measured camera; without one, and when false, the "
        "camera is orthographic",
    )


class FrankotChellappa(SlopeIntegrator):
    """The surface whose Fourier series has the closest slopes.

    Its waves reach over the whole rectangle and know neither masks nor weights: a field with
    unknown pixels is integrated as `Simchony` would without weights, with six-point steps,
    whatever ``periodic`` says.
    """

    name: ClassVar[str] = "frankot-chellappa"
    bytes_per_pixel: ClassVar[int] = 36

    periodic: bool = Field(
        default=False,
        description="let the surface repeat itself beyond its borders, as in the original method; "
        "otherwise it is mirrored there",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.poisson.frankot_chellappa`."""
        grid = _seen(normals.grid, self.perspective)
        facing = facing_rays(normals.normals, grid)
        if not np.isfinite(facing).all():
            return HeightMap(_alike(normals.normals, grid, "6-point"), normals.grid)
        gradient = seen_gradient(normals.normals, facing, grid, FLATTENED_DEG)
        height = frankot_chellappa(*gradient, periodic=self.periodic)
        seen_surface(height, (0.0, 0.0), None if grid.camera is None else grid.camera[2])
        return HeightMap(height.astype(np.float32, copy=False), normals.grid)


class Simchony(SlopeIntegrator):
    """The surface whose steps from pixel to pixel are closest, with free borders."""

    name: ClassVar[str] = "simchony"

    stencil: Stencil = Field(
        default="6-point",
        description="how a step between two pixels follows from the slopes around it: from six "
        "pixels, or as the mean of two ('trapezoid', the paper's)",
    )
    weights: bool = Field(
        default=True,
        description="let steep and uncertain normals count less, where there are such; when false "
        "all count the same, and slopes are limited to 70 degrees",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.normal_integration.least_squares_height`.

        Where the slopes differ in certainty, `nlights_core.integration.weighted_integration.weighted_height`.
        """
        grid = _seen(normals.grid, self.perspective)
        if not self.weights or _even(normals, grid):
            return HeightMap(_alike(normals.normals, grid, self.stencil), normals.grid)
        height = weighted_height(normals.normals, grid, normals.confidence, stencil=self.stencil)
        return HeightMap(height.astype(np.float32, copy=False), normals.grid)


def _seen(grid: PixelGrid, perspective: bool) -> PixelGrid:
    return grid if perspective else replace(grid, camera=None)


def _even(field: NormalField, grid: PixelGrid) -> bool:
    """Test whether weights would matter little, on a sample of the rows."""
    rows = sample_rows(grid)
    facing = facing_rays(field.normals[rows], grid, rows)
    uncertainty = None
    if field.confidence is not None:
        stated = field.confidence[rows]
        uncertainty = relative_uncertainty(stated, middle_uncertainty(stated, np.isfinite(facing)))
    return evenly_certain(facing, uncertainty)


def _alike(normals: Array, grid: PixelGrid, stencil: Stencil) -> Array:
    return least_squares_height(normals, grid, stencil=stencil, steepest_deg=FLATTENED_DEG)
