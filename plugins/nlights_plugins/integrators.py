"""Integrators: height from a field of normals."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import Integrator
from nlights_core.fields import HeightMap, NormalField
from nlights_core.frames import Array
from nlights_core.integration import (
    Stencil,
    frankot_chellappa,
    mean_per_island,
    perspective_gradient,
    perspective_height,
    simchony,
)
from nlights_core.masked_integration import masked_least_squares


class SlopeIntegrator(Integrator):
    """What both integrators share: whose rays are followed, and how steep a slope is believed."""

    bytes_per_pixel: ClassVar[int] = 72

    perspective: bool = Field(
        default=True,
        description="follow the rays of the measured camera; without one, and when false, the "
        "camera is orthographic",
    )
    steepest_deg: float = Field(
        default=70.0,
        gt=0,
        lt=90,
        description="slopes are limited to this angle, degrees: near the horizon a normal says little "
        "about the slope",
    )


class FrankotChellappa(SlopeIntegrator):
    """The surface whose Fourier series has the closest slopes.

    Its waves reach over the whole rectangle and know no mask: a field with unknown pixels is
    integrated as `Simchony` would, with six-point steps, whatever ``periodic`` says.
    """

    name: ClassVar[str] = "frankot-chellappa"

    periodic: bool = Field(
        default=False,
        description="let the surface repeat itself beyond its borders, as in the original method; "
        "otherwise it is mirrored there",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.frankot_chellappa`."""
        return _integrate(self, normals, partial(frankot_chellappa, periodic=self.periodic), "6-point")


class Simchony(SlopeIntegrator):
    """The surface whose steps from pixel to pixel are closest, with free borders."""

    name: ClassVar[str] = "simchony"

    stencil: Stencil = Field(
        default="6-point",
        description="how a step between two pixels follows from the slopes around it: from six "
        "pixels, or as the mean of two ('trapezoid', the paper's)",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.simchony`."""
        return _integrate(self, normals, partial(simchony, stencil=self.stencil), self.stencil)


def _integrate(
    options: SlopeIntegrator, normals: NormalField, solve: Callable[[Array, Array], Array], stencil: Stencil
) -> HeightMap:
    """Height by ``solve`` where all is known, by masked least squares where not."""
    grid = normals.grid
    camera = grid.camera if options.perspective else None
    per_column, per_row = normals.gradient(options.steepest_deg)
    if camera is not None:
        per_column, per_row = perspective_gradient(per_column, per_row, grid)
    if np.isfinite(per_column).all() and np.isfinite(per_row).all():
        height = solve(per_column, per_row)
    else:
        height = masked_least_squares(per_column, per_row, stencil=stencil)
    del per_column, per_row
    if camera is not None:
        height = perspective_height(height, camera[2])
    height -= mean_per_island(height)
    return HeightMap(height.astype(np.float32, copy=False), grid)
