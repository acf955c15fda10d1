"""Surfaces: their formulas against each other and against geometry."""

import numpy as np
import pytest

from nlights_core.frames import PixelGrid
from nlights_core.simulation.surfaces import (
    Stroke,
    bow,
    height_map,
    normal_field,
    peaks,
    plane,
    seen_points,
    sphere_cap,
    strokes,
    wave,
)

TWO_STROKES = strokes([Stroke(3.0, -2.0, 9.0, 4.0, 30.0, 0.5), Stroke(-1.0, 1.0, 6.0, 6.0, 0.0, -0.2)])
SURFACES = {
    "plane": plane(0.1, -0.2, 3.0),
    "sphere": sphere_cap(40.0, 2.0, (1.0, -2.0)),
    "bow": bow(0.8, 30.0, 20.0),
    "wave": wave(0.3, 7.0, 25.0, 0.4),
    "peaks": peaks(2.0, 12.0),
    "strokes": TWO_STROKES,
    "sum": plane(0.1, 0.0) + wave(0.3, 7.0) + TWO_STROKES,
}


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_slopes_are_the_derivatives_of_the_height(surface):
    x, y = np.random.default_rng(1).uniform(-10, 10, (2, 20, 30))
    step = 1e-5
    across, up = surface.slopes(x, y)
    np.testing.assert_allclose(
        across, (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step), atol=1e-8
    )
    np.testing.assert_allclose(
        up, (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step), atol=1e-8
    )


def test_the_normals_of_a_sphere_point_away_from_its_centre():
    x, y = np.meshgrid(np.linspace(-20, 20, 9), np.linspace(-15, 15, 7))
    ball = sphere_cap(40.0, top=2.0)
    away = np.stack([x, y, ball.height(x, y) + 38.0], axis=-1) / 40.0
    np.testing.assert_allclose(ball.normals(x, y), away, atol=1e-12)


def test_a_sphere_is_unknown_beside_itself():
    assert np.isnan(sphere_cap(5.0).height(np.array([6.0]), np.array([0.0]))).all()


def test_a_bow_is_as_high_as_its_sag_and_has_mean_0():
    x, y = np.meshgrid((np.arange(500) - 249.5), (np.arange(400) - 199.5))
    shape = bow(0.8, 500.0, 400.0)
    assert abs(shape.height(x, y).mean()) < 1e-5
    corner, centre = shape.height(np.array([250.0, 0.0]), np.array([200.0, 0.0]))
    assert centre - corner == pytest.approx(0.8)


def test_the_highest_peak_is_as_high_as_asked():
    x, y = np.meshgrid(np.linspace(-12, 12, 601), np.linspace(-12, 12, 601))
    assert peaks(2.0, 12.0).height(x, y).max() == pytest.approx(2.0, rel=1e-3)


def test_strokes_are_the_same_on_a_grid_as_point_by_point():
    x, y = np.meshgrid(np.linspace(-12, 14, 40), np.linspace(-9, 9, 30))
    together = TWO_STROKES.height(x, y)
    singly = [
        TWO_STROKES.height(np.array([a]), np.array([b]))[0] for a, b in zip(x.flat, y.flat, strict=True)
    ]
    np.testing.assert_array_equal(together.ravel(), singly)
    assert np.abs(together).max() > 0.1


def test_seen_points_lie_on_the_surface_and_on_the_rays():
    grid = PixelGrid(30, 40, 10.0, camera=(20.0, -10.0, 1500.0))
    surface = wave(8.0, 150.0, 40.0) + plane(0.02, 0.05, 3.0)
    x, y, z = seen_points(surface, grid, 5, 20)
    np.testing.assert_allclose(z, surface.height(x, y), atol=1e-9)
    share = z / 1500.0
    np.testing.assert_allclose(x, grid.x() + (20.0 - grid.x()) * share, atol=1e-9)
    rows = grid.y(5, 20)[:, None]
    np.testing.assert_allclose(y, rows + (-10.0 - rows) * share, atol=1e-9)


def test_the_perspective_of_a_tilted_plane_follows_the_closed_form():
    grid = PixelGrid(30, 40, 10.0, camera=(0.0, 0.0, 1500.0))
    x0 = np.tile(grid.x(), (30, 1))
    exact = 0.1 * x0 / (1 + 0.1 * x0 / 1500.0)
    np.testing.assert_allclose(height_map(plane(slope_x=0.1), grid).height, exact, atol=1e-5)
    assert np.abs(exact - 0.1 * x0).max() > 0.2


def test_a_surface_that_hides_parts_of_itself_is_refused():
    with pytest.raises(ValueError, match="too steep"):
        seen_points(wave(40.0, 20.0), PixelGrid(30, 40, 10.0, camera=(0.0, 0.0, 100.0)))


def test_normals_on_a_grid_are_float32_with_y_up():
    field = normal_field(plane(slope_y=1.0), PixelGrid(3, 4, 0.5))
    assert field.normals.dtype == np.float32
    np.testing.assert_allclose(field.normals[2, 1], [0, -np.sqrt(0.5), np.sqrt(0.5)], atol=1e-7)
    assert height_map(plane(slope_y=1.0), field.grid).height[0, 0] == 0.5
