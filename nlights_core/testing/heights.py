"""Contracts of the kinds that make heights: integrators and detrends of the height."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from nlights_core.algorithms import HeightDetrend, Integrator
from nlights_core.fields import HeightMap, KnownHeights, NormalField
from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.surfaces import Surface, bow, height_map, normal_field, plane, wave
from nlights_core.testing.algorithms import (
    GRID,
    HILLS,
    AlgorithmContract,
    expect,
    expect_array,
    holed,
)


class IntegratorContract(AlgorithmContract):
    """Heights from exact normals.

    Attributes
    ----------
    algorithm : Integrator
        What is tested.
    tolerance_mm : float
        Greatest error on a tilted plane and on smooth hills, 0.5 mm pixels, parallel rays.
    perspective_tolerance_mm : float
        Greatest error on hills seen by a camera at the side.  The default passes an integrator
        that takes the rays for parallel; lower it for one that does not.
    """

    algorithm: ClassVar[Integrator]
    kind = Integrator
    tolerance_mm: ClassVar[float] = 0.02
    perspective_tolerance_mm: ClassVar[float] = 0.1

    def height(self, normals: NormalField) -> Array:
        """Height that the algorithm makes of normals, once its shape is known to be right."""
        found = self.algorithm.integrate(normals).height
        shape = normals.grid.shape
        expect(found.shape == shape, f"height must have the shape {shape}, not {found.shape}")
        return found

    def error(self, surface: Surface, grid: PixelGrid = GRID) -> float:
        """Greatest deviation from the true height once the constant is removed, mm."""
        deviation = self.height(normal_field(surface, grid)) - height_map(surface, grid).height
        return float(np.abs(deviation - deviation.mean()).max())

    def test_a_tilted_plane_is_recovered_in_mm_with_y_up(self) -> None:
        """A plane is lost by periodic transforms, and shows the signs of x and y."""
        error = self.error(plane(slope_x=0.05, slope_y=-0.03))
        expect(error <= self.tolerance_mm, f"plane wrong by {error:.3g} mm")

    def test_smooth_hills_are_recovered_in_mm(self) -> None:
        """Hills and hollows at unequal places show every flip."""
        error = self.error(HILLS)
        expect(error <= self.tolerance_mm, f"hills wrong by {error:.3g} mm")

    def test_hills_under_a_perspective_camera_are_recovered(self) -> None:
        """Real stands have a camera at a finite distance."""
        error = self.error(HILLS, PixelGrid(48, 64, 0.5, camera=(15.0, -10.0, 80.0)))
        expect(error <= self.perspective_tolerance_mm, f"hills in perspective wrong by {error:.3g} mm")

    def test_the_height_is_float32_on_the_same_grid_with_mean_0(self) -> None:
        """The constant is free; by agreement the mean over what is known is 0."""
        found = self.algorithm.integrate(normal_field(HILLS, GRID))
        expect_array(found.height, GRID.shape, "height")
        expect(found.grid == GRID, "the grid must be that of the normals")
        mean = abs(float(found.height.mean(dtype=np.float64)))
        expect(mean < 1e-4, f"the mean must be 0, not {mean:.3g} mm")

    def test_unknown_stays_unknown_and_does_not_spread(self) -> None:
        """NaN is a mask."""
        normals = normal_field(HILLS, GRID).normals
        hole = holed(GRID.shape)
        normals[hole] = np.nan
        found = self.height(NormalField(normals, GRID))
        expect(np.isnan(found[hole]).all(), "height was invented where no normal is known")
        expect(np.isfinite(found[~hole]).all(), "NaN spread to where the normal is known")
        mean = abs(float(found[~hole].mean(dtype=np.float64)))
        expect(mean < 1e-4, f"the mean over what is known must be 0, not {mean:.3g} mm")

    def test_normals_are_not_overwritten(self) -> None:
        """The normals are used again for the maps."""
        normals = normal_field(HILLS, GRID)
        before = normals.normals.copy()
        self.algorithm.integrate(normals)
        expect(np.array_equal(normals.normals, before), "the normals were overwritten")

    def test_twice_the_same(self) -> None:
        """The store takes equal keys for equal results."""
        first, second = (self.height(normal_field(HILLS, GRID)) for _ in range(2))
        expect(np.array_equal(first, second), "two runs differ")


class HeightDetrendContract(AlgorithmContract):
    """The smooth deformation in a height map.

    Attributes
    ----------
    algorithm : HeightDetrend
        What is tested.
    deformation : Surface
        What it must find: by default a bow of 0.8 mm and a tilt.
    tolerance_mm : float
        Greatest error of the trend.
    """

    algorithm: ClassVar[HeightDetrend]
    kind = HeightDetrend
    deformation: ClassVar[Surface] = bow(0.8, 32.0, 24.0) + plane(0.02, -0.01)
    tolerance_mm: ClassVar[float] = 0.01

    def given(self, surface: Surface, relief: Surface | None = None) -> HeightMap:
        """A height map, with known heights of the artwork's own relief where the algorithm needs them."""
        height = height_map(surface, GRID)
        if "known_heights" not in self.algorithm.needs:
            return height
        x, y = (at.ravel() for at in np.meshgrid(GRID.x()[2::6], np.linspace(-11.75, 11.75, 8)))
        points = np.stack([x, y, (relief or plane()).height(x, y)], axis=1)
        return replace(height, known=KnownHeights(points, np.full(len(points), 0.002)))

    def test_a_smooth_deformation_is_found(self) -> None:
        """The trend itself is returned, not the corrected height; its constant is free."""
        height = self.given(self.deformation)
        left = height.height - self.algorithm.trend(height)
        error = float(np.abs(left - left.mean()).max())
        expect(error <= self.tolerance_mm, f"the trend is wrong by {error:.3g} mm")

    def test_fine_relief_is_left_to_the_artwork(self) -> None:
        """A wave of 0.1 mm and 6 pixels is no deformation."""
        height = self.given(self.deformation + wave(0.1, 3.0, angle_deg=20.0), wave(0.1, 3.0, angle_deg=20.0))
        trend = self.algorithm.trend(height)
        error = trend - height_map(self.deformation, GRID).height
        worst = float(np.abs(error - error.mean()).max())
        expect(worst <= self.tolerance_mm + 0.02, f"{worst:.3g} mm of a fine wave went into the trend")

    def test_the_trend_is_float32_and_finite_where_the_height_is_not_known(self) -> None:
        """It can be added back everywhere."""
        height = self.given(self.deformation)
        truth = height.height.copy()
        height.height[holed(GRID.shape)] = np.nan
        trend = self.algorithm.trend(height)
        expect_array(trend, GRID.shape, "trend")
        expect(np.isfinite(trend).all(), "the trend must be finite everywhere")
        error = float(np.ptp(truth - trend))
        expect(error <= 4 * self.tolerance_mm, f"unknown pixels bend the trend by {error:.3g} mm")

    def test_the_height_is_not_overwritten_and_the_trend_repeats(self) -> None:
        """The height is used again; equal keys mean equal results."""
        height = self.given(self.deformation)
        before = height.height.copy()
        again = replace(height, height=before)
        first = self.algorithm.trend(height)
        expect(np.array_equal(height.height, before), "the height was overwritten")
        expect(np.array_equal(first, self.algorithm.trend(again)), "two runs differ")
