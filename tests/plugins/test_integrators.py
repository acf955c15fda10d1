"""The integrators as a recipe uses them: normals in, millimetres out."""

import numpy as np
import pytest

from nlights_core.fields import NormalField
from nlights_core.frames import PixelGrid
from nlights_plugins.integrators import FrankotChellappa, Simchony

CAMERA = (0.0, 0.0, 1500.0)
ORTHOGRAPHIC = PixelGrid(60, 81, 0.5)

INTEGRATORS = [Simchony(), Simchony(stencil="trapezoid"), FrankotChellappa()]


def unit(normals):
    return (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def bump(grid, sigma=4.0, height=1.5):
    """A Gaussian bump off the centre and its normals, orthographic."""
    x, y = np.meshgrid(grid.x() - 3, grid.y() + 2)
    z = height * np.exp(-(x**2 + y**2) / (2 * sigma**2))
    return z, unit(np.stack([x * z / sigma**2, y * z / sigma**2, np.ones_like(z)], axis=-1))


def seen_plane(grid, normal):
    """Height of a tilted plane seen by the camera's rays, scaled about the camera to mean 0."""
    rays = np.stack(np.broadcast_arrays(grid.x(), grid.y()[:, None], 0.0), axis=-1) - grid.camera
    t = 1 / (rays @ np.asarray(normal))
    return grid.camera[2] * (1 - t / t.mean()), np.broadcast_to(unit(np.asarray(normal)), (*grid.shape, 3))


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=repr)
def test_a_bump_is_recovered_in_millimetres_right_side_up(integrator):
    z, normals = bump(ORTHOGRAPHIC)
    found = integrator.integrate(NormalField(normals, ORTHOGRAPHIC))
    assert found.height.dtype == np.float32
    assert found.grid is ORTHOGRAPHIC
    assert abs(found.height.mean(dtype=float)) < 1e-7
    assert np.abs(found.height - (z - z.mean())).max() < 4e-3


@pytest.mark.parametrize("integrator", [*INTEGRATORS, FrankotChellappa(periodic=True)], ids=repr)
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 3), (3, 2), (5, 4), (63, 31)])
def test_a_tilted_plane_is_recovered_at_any_size(integrator, shape):
    grid = PixelGrid(*shape, 0.5)
    normals = np.broadcast_to(unit(np.array([0.3, -0.2, 1.0])), (*shape, 3))
    z = -0.3 * grid.x() + 0.2 * grid.y()[:, None]
    found = integrator.integrate(NormalField(normals, grid)).height
    assert found == pytest.approx(z, abs=1e-5)


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=repr)
def test_a_tilted_plane_seen_by_the_camera_needs_perspective(integrator):
    grid = PixelGrid(150, 200, 2.5, CAMERA)
    z, normals = seen_plane(grid, (-0.1, 0.05, 1.0))
    field = NormalField(normals, grid)
    limit = 2e-3 if isinstance(integrator, FrankotChellappa) else 2e-6
    assert np.abs(integrator.integrate(field).height - z).max() < limit * np.ptp(z)
    shortcut = integrator.model_copy(update={"perspective": False})
    assert np.abs(shortcut.integrate(field).height - z).max() > 5e-3 * np.ptp(z)


def test_perspective_without_a_camera_changes_nothing():
    _, normals = bump(ORTHOGRAPHIC)
    field = NormalField(normals, ORTHOGRAPHIC)
    heights = [Simchony(perspective=p).integrate(field).height for p in (True, False)]
    assert np.array_equal(*heights)


@pytest.mark.parametrize("integrator", [*INTEGRATORS, FrankotChellappa(periodic=True)], ids=repr)
@pytest.mark.parametrize("camera", [None, CAMERA])
def test_unknown_stays_unknown_and_does_not_spread(integrator, camera):
    grid = PixelGrid(60, 81, 0.5, camera)
    z, normals = bump(grid)
    normals[10:20, 30:44] = np.nan
    normals[40, 50, 0] = np.nan
    unknown = np.isnan(normals).any(axis=-1)
    before = normals.copy()
    found = integrator.integrate(NormalField(normals, grid)).height
    assert np.array_equal(np.isnan(found), unknown)
    assert np.array_equal(normals, before, equal_nan=True)
    assert abs(np.nanmean(found, dtype=float)) < 1e-7
    z[unknown] = np.nan
    assert np.nanmax(np.abs(found - (z - np.nanmean(z)))) < (4e-3 if camera is None else 1e-2)


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_each_island_has_mean_zero(camera):
    grid = PixelGrid(60, 81, 0.5, camera)
    normals = np.broadcast_to(unit(np.array([0.3, -0.2, 1.0])), (*grid.shape, 3)).copy()
    normals[:, 40] = np.nan
    normals[30, :40] = np.nan
    found = Simchony().integrate(NormalField(normals, grid)).height
    for island in (np.s_[:30, :40], np.s_[31:, :40], np.s_[:, 41:]):
        assert abs(found[island].mean(dtype=float)) < 1e-6
        assert np.ptp(found[island]) > 1


@pytest.mark.parametrize("integrator", INTEGRATORS, ids=repr)
def test_a_field_wholly_unknown_stays_so_and_a_lone_pixel_is_zero(integrator):
    normals = np.full((4, 5, 3), np.nan, np.float32)
    grid = PixelGrid(4, 5, 0.5, CAMERA)
    assert np.isnan(integrator.integrate(NormalField(normals, grid)).height).all()
    normals[1, 2] = 0.6, 0, 0.8
    found = integrator.integrate(NormalField(normals, grid)).height
    assert found[1, 2] == 0
    assert np.isnan(found).sum() == 19


def test_a_normal_below_the_horizon_is_unknown():
    z, normals = bump(ORTHOGRAPHIC)
    normals[30, 40] = 0.6, 0, -0.8
    found = Simchony().integrate(NormalField(normals, ORTHOGRAPHIC)).height
    assert np.argwhere(np.isnan(found)).tolist() == [[30, 40]]
    z[30, 40] = np.nan
    assert np.nanmax(np.abs(found - (z - np.nanmean(z)))) < 1e-3


def test_periodic_bends_what_does_not_repeat_and_mirroring_does_not():
    x, y = np.meshgrid(ORTHOGRAPHIC.x(), ORTHOGRAPHIC.y())
    z = x * y / 50
    field = NormalField(unit(np.stack([-y / 50, -x / 50, np.ones_like(x)], axis=-1)), ORTHOGRAPHIC)
    errors = [np.std(FrankotChellappa(periodic=p).integrate(field).height - z) for p in (True, False)]
    assert errors[0] > 0.3 * np.std(z)
    assert errors[1] < 0.01 * np.std(z)


def test_a_steep_flank_is_cut_unless_its_slope_is_believed():
    # A cone of 80 degrees: 5.67 mm up for every mm inwards.
    x = np.linspace(-10, 10, 81)
    xx, yy = np.meshgrid(x, -x)
    radius = np.maximum(np.hypot(xx, yy), 1e-9)
    slope = np.tan(np.radians(80))
    normals = np.stack([slope * xx / radius, slope * yy / radius, np.ones_like(radius)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    field = NormalField(normals.astype(np.float32), PixelGrid(81, 81, 0.25))
    truth = -slope * radius
    believed = Simchony(steepest_deg=85).integrate(field).height
    limited = Simchony().integrate(field).height
    assert np.ptp(believed[40]) == pytest.approx(np.ptp(truth[40]), rel=0.05)
    assert np.ptp(limited[40]) == pytest.approx(np.tan(np.radians(70)) * np.ptp(radius[40]), rel=0.05)
