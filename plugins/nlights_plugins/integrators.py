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


class FrankotChellappa(Integrator):
    """The surface whose Fourier series has the closest slopes.

    Its waves reach over the whole rectangle and know no mask: a field with unknown pixels is
    integrated as `Simchony` would, with six-point steps, whatever ``periodic`` says.
    """

    name: ClassVar[str] = "frankot-chellappa"
    bytes_per_pixel: ClassVar[int] = 72

    periodic: bool = Field(
        default=False,
        description="let the surface repeat itself beyond its borders, as in the original method; "
        "otherwise it is mirrored there",
    )
    perspective: bool = Field(
        default=True,
        description="follow the rays of the measured camera; without one, and when false, the "
        "camera is orthographic",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.frankot_chellappa`."""
        return _integrate(
            normals, partial(frankot_chellappa, periodic=self.periodic), "6-point", self.perspective
        )


class Simchony(Integrator):
    """The surface whose steps from pixel to pixel are closest, with free borders."""

    name: ClassVar[str] = "simchony"
    bytes_per_pixel: ClassVar[int] = 72

    stencil: Stencil = Field(
        default="6-point",
        description="how a step between two pixels follows from the slopes around it: from six "
        "pixels, or as the mean of two ('trapezoid', the paper's)",
    )
    perspective: bool = Field(
        default=True,
        description="follow the rays of the measured camera; without one, and when false, the "
        "camera is orthographic",
    )

    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field; see `nlights_core.integration.simchony`."""
        return _integrate(normals, partial(simchony, stencil=self.stencil), self.stencil, self.perspective)


def _integrate(
    normals: NormalField, solve: Callable[[Array, Array], Array], stencil: Stencil, perspective: bool
) -> HeightMap:
    """Height by ``solve`` where all is known, by masked least squares where not."""
    grid = normals.grid
    camera = grid.camera if perspective else None
    per_column, per_row = normals.gradient()
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
