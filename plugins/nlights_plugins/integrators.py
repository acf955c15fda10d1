"""Integrators: height from a field of normals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import Integrator
from nlights_core.fields import HeightMap, NormalField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration import (
    Stencil,
    frankot_chellappa,
    mean_per_island,
    simchony,
)
from nlights_core.masked_integration import (
    evenly_certain,
    masked_least_squares,
    relative_uncertainty,
    weighted_least_squares,
)
from nlights_core.sight_lines import facing_rays, perspective_height, seen_gradient

FLATTENED_DEG = 70.0
"""Slopes that all count the same are limited to this angle: a single one could bend the whole."""

STEEPEST_DEG = 89.5
"""Slopes that count by their certainty are limited to this angle to the viewing ray."""


class SlopeIntegrator(Integrator):
    """What both integrators share: whose rays are followed."""

    bytes_per_pixel: ClassVar[int] = 136

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

    periodic: bool = Field(
        default=False,
        description="let the surface repeat itself beyond its borders, as in the original method; "
        "otherwise it is mirrored there",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.frankot_chellappa`."""
        grid = _seen(normals.grid, self.perspective)
        facing = facing_rays(normals.normals, grid)
        solve = partial(frankot_chellappa, periodic=self.periodic)
        scaled_log = _alike(normals.normals, facing, grid, solve, "6-point")
        return _height_map(scaled_log, grid, normals.grid)


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
        """Integrate a whole field; see `nlights_core.integration.simchony`.

        Where the slopes differ in certainty, `nlights_core.masked_integration.weighted_least_squares`.
        """
        grid = _seen(normals.grid, self.perspective)
        facing = facing_rays(normals.normals, grid)
        uncertainty = None
        if self.weights and normals.confidence is not None:
            uncertainty = relative_uncertainty(normals.confidence, np.isfinite(facing))
        if not self.weights or evenly_certain(facing, uncertainty):
            solve = partial(simchony, stencil=self.stencil)
            scaled_log = _alike(normals.normals, facing, grid, solve, self.stencil)
        else:
            gradient = seen_gradient(normals.normals, facing, grid, STEEPEST_DEG)
            scaled_log = weighted_least_squares(*gradient, facing, uncertainty, grid, stencil=self.stencil)
        return _height_map(scaled_log, grid, normals.grid)


def _seen(grid: PixelGrid, perspective: bool) -> PixelGrid:
    return grid if perspective else replace(grid, camera=None)


def _alike(
    normals: Array,
    facing: Array,
    grid: PixelGrid,
    solve: Callable[[Array, Array], Array],
    stencil: Stencil,
) -> Array:
    """Integral of slopes that count the same: by ``solve`` where all are known, else with a mask."""
    per_column, per_row = seen_gradient(normals, facing, grid, FLATTENED_DEG)
    if np.isfinite(facing).all():
        return solve(per_column, per_row)
    return masked_least_squares(per_column, per_row, stencil=stencil)


def _height_map(scaled_log: Array, seen: PixelGrid, grid: PixelGrid) -> HeightMap:
    """z of mean 0 on every island, out of the integral along the rays of ``seen``."""
    height = scaled_log if seen.camera is None else perspective_height(scaled_log, seen.camera[2])
    height -= mean_per_island(height)
    return HeightMap(height.astype(np.float32, copy=False), grid)
