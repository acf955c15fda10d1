"""Integration against surfaces whose height is known by formula, by other means or by others."""

from pathlib import Path

import numpy as np
import pytest

from nlights_core.frames import PixelGrid
from nlights_core.integration.masked_integration import masked_least_squares
from nlights_core.integration.masked_poisson import masked_laplacian
from nlights_core.integration.multigrid import (
    Multigrid,
    laplacian_product,
    subtract_laplacian,
    weighted_laplacian,
)
from nlights_core.integration.poisson import (
    frankot_chellappa,
    height_steps,
    mean_per_island,
    simchony,
    solve_poisson,
)
from nlights_core.integration.sight_lines import facing_rays, perspective_height, seen_gradient
from nlights_core.integration.weighted_integration import (
    evenly_certain,
    middle_uncertainty,
    relative_uncertainty,
    weighted_height,
)

DATA = Path(__file__).parents[3].parent / "shared" / "data"
VASE = DATA / "integration" / "vase.mat"
PSBOX = DATA / "golden" / "psbox_demo.npz"

METHODS = {
    "periodic": lambda p, q: frankot_chellappa(p, q, periodic=True),
    "mirrored": frankot_chellappa,
    "6-point": simchony,
    "trapezoid": lambda p, q: simchony(p, q, stencil="trapezoid"),
    "masked": masked_least_squares,
}


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def peaks(size):
    """MATLAB's peaks on [-3, 3]^2 with its exact steps per column and per row."""
    step = 6 / (size - 1)
    x, y = np.meshgrid(np.linspace(-3, 3, size), np.linspace(-3, 3, size))
    a = 3 * (1 - x) ** 2 * np.exp(-(x**2) - (y + 1) ** 2)
    a_x = (-6 * (1 - x) - 6 * x * (1 - x) ** 2) * np.exp(-(x**2) - (y + 1) ** 2)
    e = np.exp(-(x**2) - y**2)
    b, b_x, b_y = (-10 * f for f in (x / 5 - x**3 - y**5, 0.2 - 3 * x**2, -5 * y**4))
    c = -np.exp(-((x + 1) ** 2) - y**2) / 3
    z_x = a_x + (b_x - 2 * x * b) * e - 2 * (x + 1) * c
    z_y = -2 * (y + 1) * a + (b_y - 2 * y * b) * e - 2 * y * c
    return a + b * e + c, z_x * step, z_y * step


def parabola(shape):
    """A tilted bowl, for which the trapezoid is exact, with its steps."""
    r, c = np.indices(shape, float)
    z = 1e-3 * (c - 30) ** 2 + 2e-3 * (r - 11) * (c - 5) - 3e-3 * r**2 + 0.2 * c
    return z, 2e-3 * (c - 30) + 2e-3 * (r - 11) + 0.2, 2e-3 * (c - 5) - 6e-3 * r


def unlike(found, true):
    """Greatest difference after the best constant, as a share of the true range."""
    difference = found - true
    return np.nanmax(np.abs(difference - np.nanmean(difference))) / np.ptp(true)


def rms_after_constant(found, true):
    return np.std(found - true)


def dense_least_squares(per_column, per_row, known):
    """The same least squares with trapezoid steps, by a dense matrix."""
    index = np.cumsum(known).reshape(known.shape) - 1
    rows, steps = [], []
    for gradient, (dr, dc) in ((per_column, (0, 1)), (per_row, (1, 0))):
        for r, c in np.argwhere(known):
            if r + dr < known.shape[0] and c + dc < known.shape[1] and known[r + dr, c + dc]:
                row = np.zeros(known.sum())
                row[index[r + dr, c + dc]], row[index[r, c]] = 1, -1
                rows.append(row)
                steps.append((gradient[r, c] + gradient[r + dr, c + dc]) / 2)
    height = np.full(known.shape, np.nan)
    height[known] = np.linalg.lstsq(np.array(rows), np.array(steps))[0]
    return height


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "shape", [(64, 64), (37, 83), (50, 31), (1, 9), (9, 1), (2, 2), (3, 2), (2, 5), (1, 1)]
)
def test_a_plane_is_exact_at_any_size(method, shape):
    r, c = np.indices(shape)
    z = 0.7 * c - 0.3 * r
    found = METHODS[method](np.full(shape, 0.7), np.full(shape, -0.3))
    assert np.abs(found - (z - z.mean())).max() < 1e-10


@pytest.mark.parametrize(("stencil", "limit"), [("trapezoid", 6e-5), ("6-point", 1e-8)])
def test_peaks_are_recovered_by_simchony(stencil, limit):
    z, p, q = peaks(512)
    assert unlike(simchony(p, q, stencil=stencil), z) < limit


def test_six_points_are_better_than_the_trapezoid_on_an_odd_rectangle():
    z, p, q = (a[:401, 100:457] for a in peaks(512))
    assert unlike(simchony(p, q), z) < 1e-8 < 1e-6 < unlike(simchony(p, q, stencil="trapezoid"), z)


def gain(method, period):
    """Amplitude that is left of a wave of 1, far from the borders."""
    c = np.arange(600)
    phase = 2 * np.pi * (c + 0.3) / period
    slope = -2 * np.pi / period * np.sin(phase)
    found = method(slope[None], np.zeros((1, 600)))[0, 100:-100]
    parts = np.stack([np.cos(phase), np.sin(phase), np.ones(600), c / 600], axis=1)[100:-100]
    return np.linalg.lstsq(parts, found)[0][0]


@pytest.mark.parametrize(
    ("stencil", "gains"),
    [
        ("trapezoid", {3: 0.605, 4: 0.785, 6: 0.907, 8: 0.948, 12: 0.977, 20: 0.992}),
        ("6-point", {3: 0.839, 4: 0.964, 6: 0.996, 8: 0.9993, 12: 0.9999, 20: 1.0}),
    ],
)
def test_simchony_passes_waves_with_the_gain_of_its_stencil(stencil, gains):
    for period, expected in gains.items():
        assert gain(METHODS[stencil], period) == pytest.approx(expected, abs=6e-4)


def test_frankot_chellappa_passes_every_wave_whole():
    for period in (3, 4, 6, 8, 12, 20):
        assert gain(METHODS["periodic"], period) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(("stencil", "limit"), [("trapezoid", 4e-2), ("6-point", 5e-4)])
def test_a_wave_of_eight_pixels_survives(stencil, limit):
    r, c = np.indices((120, 160))
    z = np.cos(2 * np.pi * c / 8) + np.sin(2 * np.pi * r / 8)
    p, q = -np.pi / 4 * np.sin(2 * np.pi * c / 8), np.pi / 4 * np.cos(2 * np.pi * r / 8)
    inner = np.s_[20:-20, 20:-20]
    assert unlike(simchony(p, q, stencil=stencil)[inner], z[inner]) < limit


@pytest.mark.parametrize("shape", [(40, 57), (33, 64), (31, 31)])
def test_mirroring_equals_the_transform_of_four_mirrored_copies(rng, shape):
    p, q = rng.standard_normal((2, *shape))
    p4 = np.block([[p, -p[:, ::-1]], [p[::-1], -p[::-1, ::-1]]])
    q4 = np.block([[q, q[:, ::-1]], [-q[::-1], -q[::-1, ::-1]]])
    four = frankot_chellappa(p4, q4, periodic=True, remove_plane=False)[: shape[0], : shape[1]]
    one = frankot_chellappa(p, q, remove_plane=False)
    assert np.abs(one - four).max() < 1e-14 * np.ptp(four)


def test_simchony_is_the_exact_least_squares_with_free_borders(rng):
    p, q = rng.standard_normal((2, 6, 9))
    expected = dense_least_squares(p, q, np.ones(p.shape, bool))
    assert simchony(p, q, stencil="trapezoid") == pytest.approx(expected - expected.mean(), abs=1e-12)


def test_simchony_keeps_to_the_least_squares_where_transforms_are_slow(rng):
    p, q = rng.standard_normal((2, 2111, 2))
    found = simchony(p, q, stencil="trapezoid")
    assert rms_after_constant(found, masked_least_squares(p, q, stencil="trapezoid")) < 1e-6


def test_slow_waves_survive_in_float32_across_a_whole_photograph():
    c = np.arange(11656)
    z = np.cos(np.pi * (c + 0.5) / 11656)
    p = (-np.pi / 11656 * np.sin(np.pi * (c + 0.5) / 11656)).astype(np.float32)
    for method in (simchony, frankot_chellappa):
        found = method(p[None], np.zeros_like(p[None]), remove_plane=False)
        assert found.dtype == np.float32
        assert unlike(found[0], z) < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_gradients_are_not_overwritten(rng, method):
    p, q = rng.standard_normal((2, 20, 21)).astype(np.float32)
    before = p.copy(), q.copy()
    METHODS[method](p, q)
    assert np.array_equal(p, before[0])
    assert np.array_equal(q, before[1])


@pytest.mark.parametrize("degree", range(6))
def test_six_points_are_exact_up_to_the_fifth_power(degree):
    x = np.linspace(-1, 1, 12)
    steps = height_steps((x**degree)[None], "6-point")[0] * (x[1] - x[0])
    exact = np.diff(x ** (degree + 1)) / (degree + 1)
    assert steps[2:-2] == pytest.approx(exact[2:-2], abs=1e-14)
    if degree <= 3:
        assert steps == pytest.approx(exact, abs=1e-14)


@pytest.mark.parametrize(("known", "power"), [(2, 1), (3, 1), (4, 3), (5, 3), (6, 3)])
def test_between_unknown_pixels_a_step_takes_the_best_formula_that_fits(known, power):
    x = np.arange(12.0)
    line = x**power
    line[2 + known :] = np.nan
    line[:2] = np.nan
    steps = height_steps(line[None], "6-point")[0]
    exact = np.diff(x ** (power + 1)) / (power + 1)
    assert steps[2 : 1 + known] == pytest.approx(exact[2 : 1 + known], rel=1e-13)
    assert np.isnan(np.delete(steps, np.s_[2 : 1 + known])).all()


def serpent(shape):
    """A corridor six pixels wide that winds through the rectangle, its turns two pixels wide."""
    known = np.zeros(shape, bool)
    for i, r in enumerate(range(0, shape[0] - 6, 8)):
        known[r : r + 6] = True
        if i:
            known[r - 2 : r, -2:] |= i % 2 == 1
            known[r - 2 : r, :2] |= i % 2 == 0
    return known


def awkward_masks(shape, rng):
    r, c = np.indices(shape)
    turned = np.abs(0.9 * (c - 70) + 0.43 * (r - 50)) + np.abs(0.9 * (r - 50) - 0.43 * (c - 70)) < 55
    holes = np.ones(shape, bool)
    for _ in range(40):
        centre = rng.integers(0, shape)
        holes &= np.hypot(r - centre[0], c - centre[1]) > rng.integers(1, 8)
    bridge = (c < 50) | (c > 90) | (r == 40)
    return {"turned": turned, "holes": holes, "bridge": bridge, "serpent": serpent(shape)}


@pytest.mark.parametrize("mask", ["turned", "holes", "bridge", "serpent"])
@pytest.mark.parametrize(("dtype", "limit"), [(np.float64, 1e-6), (np.float32, 1e-6)])
def test_awkward_masks_are_solved_to_a_millionth(rng, mask, dtype, limit):
    z, p, q = parabola((101, 143))
    known = awkward_masks(z.shape, rng)[mask]
    found = masked_least_squares(*(np.where(known, g, np.nan).astype(dtype) for g in (p, q)))
    true = np.where(known, z, np.nan)
    assert found.dtype == dtype
    assert np.nanmax(np.abs(found - (true - mean_per_island(true)))) < limit * np.ptp(z)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_hundreds_of_small_islands_do_not_upset_one_another(rng, dtype):
    z, p, q = parabola((101, 143))
    known = rng.random(z.shape) > 0.45
    found = masked_least_squares(*(np.where(known, g, np.nan).astype(dtype) for g in (p, q)))
    true = np.where(known, z, np.nan)
    assert np.nanmax(np.abs(found - (true - mean_per_island(true)))) < 2e-6 * np.ptp(z)


def test_with_a_mask_it_is_the_exact_least_squares(rng):
    p, q = rng.standard_normal((2, 7, 9))
    known = np.ones(p.shape, bool)
    known[2:5, 3:5] = False
    known[0, 8] = False
    expected = dense_least_squares(p, q, known)
    p[~known] = np.nan
    found = masked_least_squares(p, q, stencil="trapezoid")
    assert found == pytest.approx(expected - np.nanmean(expected), abs=1e-7, nan_ok=True)


def test_unknown_stays_unknown_and_does_not_spread():
    z, p, q = parabola((30, 40))
    p[4:9, 6:20] = np.nan
    q[20, 30] = np.nan
    unknown = np.isnan(p) | np.isnan(q)
    found = masked_least_squares(p, q)
    assert np.array_equal(np.isnan(found), unknown)
    assert unlike(found, z) < 1e-6


def test_islands_have_mean_zero_each_and_a_lone_pixel_is_zero():
    z, p, q = parabola((20, 30))
    p[:, 12] = np.nan
    p[5:8, 20:23] = np.nan
    p[6, 21] = 0.4
    found = masked_least_squares(p, q)
    left = z[:, :12]
    assert found[:, :12] == pytest.approx(left - left.mean(), abs=1e-6)
    assert found[6, 21] == 0
    right = np.where(np.isnan(found), np.nan, z)[:, 13:]
    right[6, 8] = np.nan
    found[6, 21] = np.nan
    assert found[:, 13:] == pytest.approx(right - np.nanmean(right), abs=1e-6, nan_ok=True)


def test_a_masked_plane_is_exact():
    r, c = np.indices((40, 50))
    known = np.hypot(r - 20, c - 20) > 6
    p, q = np.where(known, 0.7, np.nan), np.where(known, -0.3, np.nan)
    z = np.where(known, 0.7 * c - 0.3 * r, np.nan)
    assert np.nanmax(np.abs(masked_least_squares(p, q) - (z - np.nanmean(z)))) < 1e-10


def test_of_nothing_known_nothing_is_made():
    nothing = np.full((5, 6), np.nan)
    assert np.isnan(masked_least_squares(nothing, nothing)).all()


def sphere_seen_from(grid, radius, top):
    """t along each pixel's ray to a sphere whose highest point is (0, 0, top), and its normals."""
    camera = np.array(grid.camera)
    rays = np.stack(np.broadcast_arrays(grid.x(), grid.y()[:, None], 0.0), axis=-1) - camera
    to_camera = camera - [0, 0, top - radius]
    a, b = (rays**2).sum(-1), rays @ to_camera
    t = (-b - np.sqrt(b**2 - a * ((to_camera**2).sum() - radius**2))) / a
    return t, (to_camera + t[..., None] * rays) / radius


@pytest.mark.parametrize("camera", [(0.0, 0.0, 1500.0), (40.0, -25.0, 900.0)])
def test_a_sphere_seen_by_a_pinhole_is_recovered(camera):
    grid = PixelGrid(150, 200, 2.5, camera)
    t, normals = sphere_seen_from(grid, 1500.0, 4.0)
    z = camera[2] * (1 - t / t.mean())
    gradient = seen_gradient(normals, facing_rays(normals, grid), grid, 89.0)
    found = perspective_height(simchony(*gradient), camera[2])
    assert np.abs(found - z).max() < 1e-8 * np.ptp(z)
    parallel = seen_gradient(normals, normals[..., 2], PixelGrid(150, 200, 2.5), 89.0)
    assert unlike(simchony(*parallel), z) > 1e-3


def test_what_is_seen_decides_what_is_known_not_the_horizon():
    grid = PixelGrid(1, 3, 100.0, (0.0, 0.0, 100.0))
    angles = np.radians([-60.0, 95.0, -95.0])
    normals = np.stack([np.sin(angles), np.zeros(3), np.cos(angles)], axis=-1)[None]
    facing = facing_rays(normals, grid)
    # The rays lean by -45, 0 and 45 degrees; the last normal is below the horizon and yet seen.
    assert np.isnan(facing).tolist() == [[True, True, False]]
    assert facing[0, 2] == pytest.approx(np.sqrt(2) * np.cos(np.radians(50)))


@pytest.mark.parametrize("camera", [None, (30.0, -20.0, 100.0)])
def test_slopes_are_limited_by_their_angle_to_the_ray(camera, rng):
    grid = PixelGrid(9, 11, 5.0, camera)
    normals = rng.standard_normal((9, 11, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    facing = facing_rays(normals, grid)
    free, limited = (seen_gradient(normals, facing, grid, angle) for angle in (89.999, 60.0))
    ray = (
        1.0
        if camera is None
        else np.sqrt(1 + ((grid.x() - 30) / 100) ** 2 + ((grid.y()[:, None] + 20) / 100) ** 2)
    )
    steep = np.arccos(np.minimum(facing / ray, 1)) > np.radians(60)
    for before, after in zip(free, limited, strict=True):
        assert np.array_equal(np.isnan(before), np.isnan(facing))
        assert after[~steep] == pytest.approx(before[~steep], nan_ok=True)
        assert (np.abs(after[steep]) < np.abs(before[steep])).all()


@pytest.fixture
def hemisphere():
    """Heights of a ball that fills its mask to the rim, its normals and its grid, lengths in px."""
    grid = PixelGrid(121, 131, 1.0, unit="px")
    x, y = np.meshgrid(grid.x(), grid.y())
    squared = 50.0**2 - x**2 - y**2
    z = np.sqrt(np.where(squared > 0, squared, np.nan))
    return z, np.stack([x, y, z], axis=-1) / 50, grid


def shaken(normals, degrees, rng):
    """Normals each turned by an angle of this standard deviation about either axis."""
    turned = normals + np.radians(degrees) * rng.standard_normal(normals.shape)
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def test_a_noisy_ball_is_recovered_to_its_steep_rim(hemisphere, rng):
    z, normals, grid = hemisphere
    noisy = shaken(normals, 0.3, rng)
    facing = facing_rays(noisy, grid)
    noisy[np.isnan(facing)] = np.nan
    known = np.isfinite(facing)
    inner = known & (z > 15)
    weighted = weighted_height(noisy, grid) - z
    limited, believed = (
        masked_least_squares(*seen_gradient(noisy, facing, grid, angle)) - z for angle in (70.0, 89.5)
    )
    assert np.std(weighted[known]) < 0.3 * np.std(limited[known])
    assert np.std(weighted[inner]) < min(0.25 * np.std(believed[inner]), np.std(limited[inner]))


def test_a_part_stated_to_be_uncertain_does_not_bend_the_rest(rng):
    z, p, q = (0.05 * a for a in peaks(160))
    grid = PixelGrid(160, 160, 6 / 159, unit="px")
    normals = np.stack([-p, q, np.full_like(p, grid.pixel_size)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    uncertain = np.zeros(p.shape, bool)
    uncertain[50:110, 60:100] = True
    sigma = np.where(uncertain, 20.0, 0.2)
    noisy = shaken(normals, sigma[..., None], rng)
    noisy[..., 2] = np.maximum(noisy[..., 2], 0.01)
    unweighted = simchony(*seen_gradient(noisy, facing_rays(noisy, grid), grid, 70.0))
    weighted, not_stated = (weighted_height(noisy, grid, stated) for stated in (sigma, None))
    errors = [np.std((found - z)[~uncertain]) for found in (weighted, not_stated, unweighted)]
    assert errors[0] < 0.8 * errors[1]
    assert errors[0] < 0.1 * errors[2]


def test_equal_uncertainties_weigh_as_none(hemisphere):
    _, normals, grid = hemisphere
    expected = weighted_height(normals, grid)
    for value in (0.3, 7.0):
        stated = np.full(grid.shape, value)
        assert np.array_equal(weighted_height(normals, grid, stated), expected, equal_nan=True)


def test_only_ratios_of_uncertainties_matter_and_unstated_ones_are_middling():
    stated = np.array([[0.2, 0.4, 0.8, np.nan, 0.0]])
    known = np.ones(stated.shape, bool)
    for unit in (1.0, 0.017, 60.0):
        middle = middle_uncertainty(stated * unit, known)
        assert relative_uncertainty(stated * unit, middle)[0] == pytest.approx([0.5, 1, 2, 1, 1])
    unstated = np.full((2, 2), np.nan)
    middle = middle_uncertainty(unstated, np.ones((2, 2), bool))
    assert (relative_uncertainty(unstated, middle) == 1).all()


def test_a_few_uncertain_slopes_leave_a_field_even_and_many_do_not():
    facing = np.full((100, 100), 0.9)
    for pixels, even in ((0, True), (10, True), (11, False)):
        facing.flat[:pixels] = 0.2
        assert evenly_certain(facing, None) is even
    facing[:] = 0.9
    uncertainty = np.where(np.arange(100) < 3, 9.0, 1.0) * np.ones((100, 1))
    assert not evenly_certain(facing, uncertainty)
    assert evenly_certain(np.full((3, 3), np.nan), None)


def test_a_tear_is_smeared_far_less_than_by_equal_weights():
    # Half a hill: the height jumps by 6 px along its cut, which no normal shows.
    r, c = np.indices((120, 120)) - 59.5
    z = np.where(c > 0, 6 * np.exp(-(r**2 + c**2) / 128), 0)
    normals = np.stack([z * c / 64, -z * r / 64, np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    grid = PixelGrid(120, 120, 1.0, unit="px")
    alike = simchony(*seen_gradient(normals, facing_rays(normals, grid), grid, 89.5))
    assert rms_after_constant(weighted_height(normals, grid), z) < 0.4 * rms_after_constant(alike, z)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_weights_keep_masks_islands_and_precision(rng, dtype):
    z, p, q = parabola((60, 71))
    known = rng.random(z.shape) > 0.1
    known[:, 40] = False
    normals = np.stack([-p, q, np.ones_like(p)], axis=-1) / np.sqrt(1 + p**2 + q**2)[..., None]
    normals = np.where(known[..., None], normals, np.nan).astype(dtype)
    before, stated = normals.copy(), rng.uniform(1, 5, z.shape)
    found = weighted_height(normals, PixelGrid(60, 71, 1.0), stated)
    assert found.dtype == dtype
    assert np.array_equal(np.isnan(found), ~known)
    true = np.where(known, z, np.nan)
    assert np.nanmax(np.abs(found - (true - mean_per_island(true)))) < 1e-3 * np.ptp(z)
    assert np.array_equal(normals, before, equal_nan=True)
    nothing = np.full((5, 6, 3), np.nan, dtype)
    assert np.isnan(weighted_height(nothing, PixelGrid(5, 6, 1.0))).all()


@pytest.mark.parametrize("widest", [0.0, 6.0])
@pytest.mark.parametrize("shape", [(70, 91), (1, 700), (513, 3)])
def test_multigrid_takes_away_most_of_an_error_whatever_the_weights(rng, shape, widest):
    rows, columns = shape
    across = 10 ** -rng.uniform(0, widest, (rows, columns - 1)).astype(np.float32)
    down = 10 ** -rng.uniform(0, widest, (rows - 1, columns)).astype(np.float32)
    error = rng.standard_normal(shape)
    residual = weighted_laplacian(error, across, down)
    left = error - Multigrid(across, down).correct(residual)
    energies = [np.vdot(e, weighted_laplacian(e, across, down)) for e in (error, left)]
    assert energies[1] < 0.25 * energies[0]


# (method, full field, rows 83:310 and columns 90:180 as MATLAB counts them)
VASE_MARKS = [("periodic", 2.15, 13.4), ("mirrored", 2.11, 1.27), ("masked", 0.108, 0.072)]


@pytest.mark.skipif(not VASE.exists(), reason="the Durou-Queau vase is not beside the repository")
@pytest.mark.parametrize(("method", "full", "cropped"), VASE_MARKS)
def test_the_vase_is_as_wrong_as_its_authors_say(method, full, cropped):
    from scipy.io import loadmat

    vase = loadmat(VASE)
    for window, expected in ((np.s_[:, :], full), (np.s_[82:310, 89:180], cropped)):
        p, q, u, mask = (vase[k][window] for k in ("q", "p", "u", "mask"))
        known = mask > 0
        if method == "periodic":
            found = frankot_chellappa(p, q, periodic=True, remove_plane=False)
        elif method == "mirrored":
            found = simchony(p, q, stencil="trapezoid")
        else:
            found = masked_least_squares(np.where(known, p, np.nan), q, stencil="trapezoid")
            better = masked_least_squares(np.where(known, p, np.nan), q)
            assert rms_after_constant(better[known], u[known]) < 0.8 * expected
        assert rms_after_constant(found[known], u[known]) == pytest.approx(expected, rel=5e-3)


@pytest.mark.skipif(not PSBOX.exists(), reason="PSBox's own results are not beside the repository")
def test_mirrored_frankot_chellappa_reproduces_psbox():
    golden = np.load(PSBOX)
    # Row 0 is the bottom row in this file, so its q along y is the step per row.
    found = frankot_chellappa(golden["p"].astype(float), golden["q"].astype(float), remove_plane=False)
    known = np.isfinite(golden["Z"])
    assert unlike(found[known], golden["Z"][known].astype(float)) < 1e-6


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (6, 1), (2, 2), (64, 33), (7, 200)])
def test_the_solution_has_the_laplacian_that_was_asked_for(shape, rng):
    source = rng.standard_normal(shape)
    found = solve_poisson(source)
    out = np.empty(shape)
    masked_laplacian(found, np.ones(shape, bool), out)
    assert out == pytest.approx(source - source.mean(), abs=1e-10)
    assert abs(found.mean()) < 1e-10


def test_what_is_left_of_a_residual_is_what_the_laplacian_says(rng):
    height, other = rng.standard_normal((2, 700, 400))
    across, down = rng.random((700, 399), np.float32), rng.random((699, 400), np.float32)
    excess = weighted_laplacian(height, across, down)
    out = np.empty_like(other)
    subtract_laplacian(other, 0.7, height, across, down, out)
    assert out == pytest.approx(other - 0.7 * excess, abs=1e-12)
    assert laplacian_product(other, height, across, down) == pytest.approx(np.vdot(other, excess))
