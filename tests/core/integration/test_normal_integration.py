"""Straight from normals to heights: the same as by the gradient, whatever the threads and the loops."""

import numpy as np
import pytest

from nlights_core.frames import PixelGrid
from nlights_core.integration.masked_integration import masked_least_squares
from nlights_core.integration.masked_poisson import masked_laplacian, solve_embedded
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.integration.poisson import add_divergence, simchony, solve_poisson
from nlights_core.integration.sight_lines import facing_rays, perspective_height, seen_gradient
from nlights_core.integration.weighted_integration import weighted_height
from nlights_core.machine import band_threads, kernel_switch


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def waves(grid, rng, noise=0.003):
    """Normals of a tilted surface with waves of some 40 pixels, and noise."""
    x, y = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    p = 0.05 * np.sin(x / 7) + 0.02 * np.cos(y / 90) + noise * rng.standard_normal(x.shape)
    q = 0.05 * np.sin(y / 9) + 0.03 + noise * rng.standard_normal(x.shape)
    normals = np.stack([-p, q, np.ones_like(p)], axis=-1)
    return (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def spotted(normals, rng, spots):
    """The same with spots of two by three pixels unknown, and one corner."""
    normals = normals.copy()
    for r, c in rng.integers(0, np.array(normals.shape[:2]) - 3, (spots, 2)):
        normals[r : r + 2, c : c + 3] = np.nan
    normals[:30, :50] = np.nan
    return normals


@pytest.mark.parametrize("camera", [None, (30.0, -20.0, 900.0)])
@pytest.mark.parametrize("stencil", ["6-point", "trapezoid"])
@pytest.mark.parametrize("spots", [0, 12])
def test_straight_from_normals_it_is_the_same_height(camera, stencil, spots, rng):
    grid = PixelGrid(290, 201, 0.5, camera)
    normals = waves(grid, rng)
    # Steeper than the limit, seen from behind, and beside a border.
    normals[100, 40:44], normals[200, 60], normals[289, 0] = (0.99, 0, 0.141), (0, 0.6, -0.8), (0, 0.6, 0.8)
    if spots:
        normals = spotted(normals, rng, spots)
    else:
        normals[200, 60] = 0, 0, 1
    found = least_squares_height(normals, grid, stencil=stencil)
    exact = normals.astype(float)
    gradient = seen_gradient(exact, facing_rays(exact, grid), grid, 70.0)
    method = masked_least_squares if spots else simchony
    expected = method(*gradient, stencil=stencil)
    expected = perspective_height(expected, camera[2]) if camera else expected
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 2e-6 * np.nanmax(np.abs(expected))


@pytest.mark.parametrize("shape", [(700, 900), (3, 4000), (4000, 3), (811, 1009)])
def test_single_precision_is_right_to_a_thousandth_of_a_pixel(shape, rng):
    source = rng.standard_normal(shape)
    source -= source.mean()
    exact = solve_poisson(source)
    assert np.std(solve_poisson(source.astype(np.float32)) - exact) < 1e-5 * np.std(exact)
    grid = PixelGrid(*shape, 1.0, unit="px")
    normals = waves(grid, rng)
    gradient = seen_gradient(normals.astype(float), normals[..., 2].astype(float), grid, 70.0)
    assert np.std(least_squares_height(normals, grid) - simchony(*gradient)) < 1e-4


def everything(normals, grid, rng):
    """Heights by all routes: direct, masked, weighted."""
    stated = rng.uniform(0.1, 9, grid.shape).astype(np.float32)
    holed = spotted(normals, rng, 9)
    return [
        least_squares_height(normals, grid),
        least_squares_height(holed, grid),
        weighted_height(holed, grid, stated),
    ]


def test_the_number_of_threads_changes_no_bit(monkeypatch):
    grid = PixelGrid(600, 513, 0.5, (30.0, -20.0, 900.0))
    normals = waves(grid, np.random.default_rng(1))
    found = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(band_threads, "cores", lambda threads=threads: threads)
        found.append(everything(normals, grid, np.random.default_rng(2)))
    for other in found[1:]:
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(found[0], other, strict=True))


def test_without_compiled_loops_the_heights_are_the_same(monkeypatch):
    grid = PixelGrid(200, 171, 0.5, (30.0, -20.0, 900.0))
    normals = waves(grid, np.random.default_rng(1))
    found = []
    for switch in ("on", "off"):
        monkeypatch.setenv(kernel_switch.SWITCH, switch)
        found.append(everything(normals, grid, np.random.default_rng(2)))
    for (fast, plain), share in zip(zip(*found, strict=True), (2e-6, 5e-6, 5e-4), strict=True):
        assert np.array_equal(np.isnan(fast), np.isnan(plain))
        assert np.nanmax(np.abs(fast - plain)) < share * np.nanmax(np.abs(plain))


def test_a_memory_map_is_read_and_left_as_it_is(tmp_path, rng):
    grid = PixelGrid(300, 70, 0.5)
    normals = waves(grid, rng)
    np.save(tmp_path / "normals.npy", normals)
    mapped = np.load(tmp_path / "normals.npy", mmap_mode="r")
    assert np.array_equal(least_squares_height(mapped, grid), least_squares_height(normals, grid))


def test_unknown_spots_take_few_solutions_of_the_whole_rectangle(rng):
    grid = PixelGrid(600, 700, 1.0)
    normals = spotted(waves(grid, rng), rng, 30)
    facing = facing_rays(normals, grid)
    source = np.zeros(grid.shape, np.float32)
    for out, gradient in zip((source, source.T), seen_gradient(normals, facing, grid, 70.0), strict=True):
        add_divergence(out, gradient if out is source else gradient.T, "6-point", 0.0)
    before, left = source.copy(), np.empty_like(source)
    known = np.isfinite(facing)
    height, share = solve_embedded(source, known, 1e-6, most_iterations=10)
    assert share <= 1e-6
    masked_laplacian(height, known, left)
    assert np.abs(before - left).max() < 1e-3 * np.abs(before).max()
