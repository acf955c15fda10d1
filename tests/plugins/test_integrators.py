"""The integrators as a recipe uses them: normals in, millimetres out."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from nlights_core.errors import TileError
from nlights_core.fields import NormalField
from nlights_core.frames import PixelGrid
from nlights_core.integration.multigrid import MULTIGRID
from nlights_core.integration.normal_integration import MASKED
from nlights_core.memory import VARIABLE
from nlights_plugins.integrators import FrankotChellappa, Simchony

INTEGRATION = Path(__file__).parents[2].parent / "shared" / "data" / "integration"
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


def cone(grid, degrees):
    """A cone whose flanks rise by this angle towards its middle, and its normals."""
    x, y = np.meshgrid(grid.x(), grid.y())
    radius = np.maximum(np.hypot(x, y), 1e-9)
    slope = np.tan(np.radians(degrees))
    return -slope * radius, unit(np.stack([slope * x / radius, slope * y / radius, np.ones_like(x)], axis=-1))


def test_a_steep_spot_is_believed_by_weights_and_cut_without():
    grid = PixelGrid(81, 81, 0.25)
    truth, normals = cone(grid, 80)
    spot = np.hypot(*np.meshgrid(grid.x(), grid.y())) < 4
    normals[~spot] = 0, 0, 1
    truth = np.where(spot, truth, truth[spot].min())
    believed, cut = (
        np.ptp(Simchony(weights=weights).integrate(NormalField(normals, grid)).height)
        for weights in (True, False)
    )
    assert believed == pytest.approx(np.ptp(truth), rel=0.05)
    assert cut < 0.6 * np.ptp(truth)


def test_an_even_field_is_transformed_directly_and_weights_change_nothing():
    _, normals = bump(ORTHOGRAPHIC)
    confidence = np.random.default_rng(3).uniform(0.1, 0.4, ORTHOGRAPHIC.shape).astype(np.float32)
    confidence[3, 4] = np.nan
    heights = [
        Simchony(weights=weights).integrate(NormalField(normals, ORTHOGRAPHIC, stated)).height
        for weights, stated in ((False, None), (True, None), (True, confidence))
    ]
    assert np.array_equal(heights[0], heights[1])
    assert np.array_equal(heights[0], heights[2])


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_stated_uncertainty_keeps_a_bad_part_to_itself_in_any_unit(camera):
    grid = PixelGrid(60, 81, 0.5, camera)
    z, normals = bump(grid)
    rng = np.random.default_rng(11)
    bad = np.zeros(grid.shape, bool)
    bad[20:40, 50:75] = True
    normals = unit(normals + np.where(bad, 0.3, 0.002)[..., None] * rng.standard_normal(normals.shape))
    confidence = np.where(bad, 17.0, 0.11).astype(np.float32)
    true = z if camera is None else Simchony().integrate(NormalField(bump(grid)[1], grid)).height
    errors = []
    for stated in (confidence, 60 * confidence, None):
        found = Simchony().integrate(NormalField(normals, grid, stated)).height
        errors.append(np.std((found - true)[~bad]))
    without = Simchony(weights=False).integrate(NormalField(normals, grid, confidence)).height
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    assert errors[0] < 0.25 * np.std((without - true)[~bad])


def test_steepness_is_measured_against_the_viewing_ray():
    # A wall that the camera at its side sees at a slant of 30 degrees, though it is past upright.
    grid = PixelGrid(40, 50, 1.0, (-400.0, 0.0, 100.0))
    towards = np.radians(95)
    normals = np.broadcast_to(
        unit(np.array([-np.sin(towards), 0.0, np.cos(towards)])), (*grid.shape, 3)
    ).copy()
    rays = np.stack(np.broadcast_arrays(grid.x(), grid.y()[:, None], 0.0), axis=-1) - grid.camera
    t = 1 / (rays @ normals[0, 0].astype(float))
    height = Simchony().integrate(NormalField(normals, grid)).height
    truth = grid.camera[2] * (1 - t / t.mean())
    assert np.abs(height - truth).max() < 1e-4 * np.ptp(truth)


@pytest.mark.skipif(not (INTEGRATION / "vase.mat").exists(), reason="the vase is not beside the repository")
def test_the_masked_vase_is_right_to_a_twentieth_of_a_pixel():
    from scipy.io import loadmat

    vase = loadmat(INTEGRATION / "vase.mat")
    known = vase["mask"] > 0
    normals = unit(np.stack([-vase["q"], vase["p"], np.ones(known.shape)], axis=-1))
    normals[~known] = np.nan
    found = Simchony().integrate(NormalField(normals, PixelGrid(*known.shape, 1.0, unit="px"))).height
    assert np.std((found - vase["u"])[known]) < 0.055


def object_seen_by_pinhole(folder):
    """Measured normals of DiLiGenT on the grid of its camera, and the measured depth, mm."""
    import imagecodecs

    normals = imagecodecs.imread((folder / "normal_map.png").read_bytes()) * (2 / 65535) - 1
    mask = imagecodecs.imread((folder / "mask.png").read_bytes())
    inside = mask.reshape(*mask.shape[:2], -1)[..., 0] > 0
    k = np.loadtxt(folder / "K.txt")
    normals[..., 1] *= k[0, 0] / k[1, 1]
    normals = unit(normals)
    normals[~inside] = np.nan
    rows, columns = inside.shape
    camera = (k[0, 2] - (columns - 1) / 2, (rows - 1) / 2 - k[1, 2], k[0, 0])
    depth = np.load(folder / "depth_gt.npz")["depth_gt"]
    return NormalField(normals, PixelGrid(rows, columns, 1.0, camera, "px")), np.where(inside, depth, np.nan)


@pytest.mark.parametrize(("name", "most"), [("bear", 0.05), ("cow", 0.12), ("pot1", 0.5), ("cat", 0.1)])
def test_depths_of_real_objects_come_out_of_their_normals(name, most):
    folder = INTEGRATION / "diligent_depth" / name
    if not folder.exists():
        pytest.skip("the depths of DiLiGenT are not beside the repository")
    field, depth = object_seen_by_pinhole(folder)
    found = field.grid.camera[2] - Simchony().integrate(field).height.astype(float)
    found *= np.nanmedian(depth / found)
    assert np.nanmean(np.abs(found - depth)) < most


@pytest.mark.parametrize("route", ["direct", "masked", "labyrinth", "weighted"])
def test_no_more_memory_is_taken_than_is_stated_or_refused(route, monkeypatch):
    grid = PixelGrid(2000, 3000, 0.1, CAMERA) if route in ("direct", "masked") else PixelGrid(900, 1200, 0.1)
    rng = np.random.default_rng(4)
    slopes = rng.normal(0, 0.05, (*grid.shape, 2)).astype(np.float32)
    normals = unit(np.concatenate([slopes, np.ones((*grid.shape, 1), np.float32)], axis=-1))
    confidence = np.full(grid.shape, 0.2, np.float32)
    if route != "direct":
        normals[300:340, 400:420] = normals[:, :5] = np.nan
    if route == "labyrinth":
        normals[200::200, 10:] = normals[300::200, :-10] = np.nan
    if route == "weighted":
        confidence[500:600] = 5
    stated = (
        {"direct": Simchony.bytes_per_pixel, "masked": MASKED}.get(route, MULTIGRID)
        * grid.rows
        * grid.columns
    )
    field = NormalField(normals, grid, confidence)
    tracemalloc.start()
    try:
        Simchony().integrate(field)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < stated
    monkeypatch.setenv(VARIABLE, str(stated - 1))
    if route != "direct":  # which is compared before a tile is begun
        with pytest.raises(TileError, match=r"integrator: .* needs .* of memory, but NLIGHTS_MEMORY allows"):
            Simchony().integrate(field)
