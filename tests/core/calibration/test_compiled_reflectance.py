"""Compiled loops say of samples what formulas over arrays say, and their derivatives are those of what they say."""

import numpy as np
import pytest

from nlights_core.calibration.compiled_elimination import (
    add_equations,
    eliminate_normals,
    linearise_samples,
    read_surface,
)
from nlights_core.calibration.compiled_reflectance import solve_normals
from nlights_core.calibration.reflectance import (
    FLAT_LOBES,
    KINDS,
    ROUGHNESSES,
    Reflectance,
    excess,
    highlights,
)

LAMPS, PIXELS = 8, 60
UNKNOWNS = 4 + LAMPS + len(KINDS) + len(FLAT_LOBES)
MISFIT, STEP, NO_LIMIT = 0.002, 0.05, np.inf
STEEP, DEPARTURE, GRAZING = 0.15, 0.3, 0.5
ALPHAS = np.array(ROUGHNESSES)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.fixture
def scene():
    """Lights, views, scaled normals, lobes and samples of some pixels."""
    random = np.random.default_rng(2)
    lights = random.normal(0, 1, (LAMPS, PIXELS, 3))
    lights[..., 2] = np.abs(lights[..., 2]) + 0.7
    views = unit(random.normal([0, 0, 1], 0.1, (PIXELS, 3)))
    scaled = random.normal([0, 0, 0.6], STEEP * 0.6, (PIXELS, 3))
    return lights.astype(np.float32), views.astype(np.float32), scaled, random.uniform(0, 1, len(KINDS))


def read(lights, views, scaled, gloss, departure=DEPARTURE):
    """What samples read, by `nlights_core.calibration.reflectance`, (L, N)."""
    albedo = np.linalg.norm(scaled, axis=-1)
    reflectance = Reflectance(np.asarray(gloss), departure, grazing=GRAZING)
    shine, rough = excess(
        reflectance, scaled / albedo[:, None], lights.astype(np.float64), views.astype(np.float64)
    )
    return np.einsum("lnk,nk->ln", lights, scaled) + shine + rough * albedo


def linearised(scene, flat_gloss=None, sought=None, **changed):
    lights, views, scaled, gloss = scene
    columns, slopes = np.empty((PIXELS, LAMPS, UNKNOWNS)), np.empty((PIXELS, LAMPS, 3))
    residuals, precisions = np.empty((2, PIXELS, LAMPS))
    none, ones = np.zeros((LAMPS, PIXELS), np.float32), np.ones((LAMPS, PIXELS), np.float32)
    given = {
        "images": none, "lights": lights, "weights": ones, "views": views, "raised_lights": lights,
        "raised_views": views, "dimmer": ones, "per_flat": ones,
    } | changed  # fmt: skip
    flat_gloss = np.zeros(len(FLAT_LOBES)) if flat_gloss is None else flat_gloss
    sought = np.arange(len(KINDS)) if sought is None else sought
    linearise_samples(
        *given.values(), scaled, gloss, ALPHAS, GRAZING, DEPARTURE, flat_gloss, sought, MISFIT, STEP, 0, PIXELS,
        columns, slopes, residuals, precisions,
    )  # fmt: skip
    return columns, slopes, residuals, precisions


def test_readings_are_those_of_the_formulas(scene):
    lights, views, scaled, gloss = scene
    images = np.random.default_rng(0).uniform(0, 1, (LAMPS, PIXELS)).astype(np.float32)
    weights = np.full((LAMPS, PIXELS), 500, np.float32)
    _, _, residuals, precisions = linearised(scene, images=images, weights=weights)
    expected = read(lights, views, scaled, gloss).T
    np.testing.assert_allclose(images.T - residuals, expected, rtol=1e-6)
    floor = 0.02 * np.linalg.norm(scaled, axis=-1)[:, None]
    variance = np.maximum(expected, floor) / 500 + (MISFIT * expected) ** 2
    np.testing.assert_allclose(precisions, 1 / variance, rtol=1e-5)


def test_readings_of_a_surface_are_those_of_the_formulas_for_the_pixels_asked_for(scene):
    lights, views, scaled, gloss = scene
    scaled[7, 2] = np.nan
    readings = np.full((LAMPS, PIXELS), -1.0)
    read_surface(lights, views, scaled, gloss, ALPHAS, GRAZING, DEPARTURE, 5, PIXELS - 2, readings)
    assert (readings[:, :5] == -1).all()
    assert (readings[:, -2:] == -1).all()
    expected = read(lights, views, scaled, gloss)
    assert np.isnan(readings[:, 7]).all()
    known = [5, 6, *range(8, PIXELS - 2)]
    assert readings[:, known] == pytest.approx(expected[:, known], rel=1e-5)


def test_what_is_not_used_has_no_say(scene):
    weights = np.ones((LAMPS, PIXELS), np.float32)
    weights[3, 7] = 0
    lights, views, scaled, gloss = scene
    scaled = scaled.copy()
    scaled[9] = np.nan
    columns, slopes, residuals, precisions = linearised((lights, views, scaled, gloss), weights=weights)
    for part in (columns, slopes, residuals, precisions):
        assert not part[7, 3].any()
        assert not part[9].any()
        assert np.isfinite(part).all()


def test_slopes_by_the_scaled_normal_are_those_of_small_differences(scene):
    lights, views, scaled, gloss = scene
    _, slopes, _, _ = linearised(scene)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        above, below = (read(lights, views, scaled + way * step, gloss) for way in (1, -1))
        np.testing.assert_allclose(slopes[..., axis], (above - below).T / 2e-6, rtol=1e-4, atol=1e-5)


def test_columns_of_the_surface_and_the_lamps_are_those_of_small_differences(scene):
    lights, views, scaled, gloss = scene
    columns = linearised(scene)[0]
    reading = read(lights, views, scaled, gloss)
    for k in range(LAMPS):
        # A lamp that is stronger by a share makes its own reading larger by that share, and no other's.
        expected = np.zeros((PIXELS, LAMPS))
        expected[:, k] = reading[k]
        np.testing.assert_allclose(columns[..., 1 + k], expected, rtol=1e-6)
    for j in range(len(KINDS)):
        more = gloss + 0.5 * np.eye(len(KINDS))[j]
        expected = (read(lights, views, scaled, more) - reading) / 0.5
        np.testing.assert_allclose(columns[..., 1 + LAMPS + j], expected.T, rtol=1e-5, atol=1e-9)
    expected = read(lights, views, scaled, gloss, DEPARTURE + 0.5) - read(lights, views, scaled, gloss)
    np.testing.assert_allclose(columns[..., 1 + LAMPS + len(KINDS)], expected.T / 0.5, rtol=1e-5, atol=1e-9)


def test_lobes_that_are_not_sought_have_no_column_and_change_no_other(scene):
    every, sought = linearised(scene)[0], np.array([1, 5, 14])
    some = linearised(scene, sought=sought)[0]
    kept = np.isin(np.arange(UNKNOWNS) - 1 - LAMPS, sought)
    lobes = np.isin(np.arange(UNKNOWNS) - 1 - LAMPS, np.arange(len(KINDS)))
    np.testing.assert_array_equal(some[..., kept | ~lobes], every[..., kept | ~lobes])
    assert not some[..., lobes & ~kept].any()
    assert every[..., lobes & ~kept].any(axis=(0, 1)).all()


def test_columns_of_light_that_is_always_there_are_what_frames_and_flats_have_of_it(scene):
    lights, views, scaled, gloss = scene
    per_flat = np.random.default_rng(1).uniform(0.5, 2, (LAMPS, PIXELS)).astype(np.float32)
    columns = linearised(scene, per_flat=per_flat)[0]
    per_flat = per_flat.astype(np.float64)
    reading, albedo = read(lights, views, scaled, gloss), np.linalg.norm(scaled, axis=-1)
    # A reading is the artwork's light over the flat's, and both are larger by what is always there.
    step = 1e-6
    for place, own in ((-2, 1), (-1, albedo)):
        expected = ((reading + per_flat * step * own) / (1 + per_flat * step) - reading) / step
        got = columns[..., 1 + LAMPS + len(KINDS) + 3 + place]
        np.testing.assert_allclose(got, expected.T, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("already", [0.0, 0.4])
def test_columns_of_a_glossy_flat_are_what_divides_the_reading(scene, already):
    lights, views, scaled, gloss = scene
    flat_gloss = np.full(len(FLAT_LOBES), already)
    columns = linearised(scene, flat_gloss)[0]
    rays, upright = unit(lights.astype(np.float64)), np.array([0.0, 0.0, 1.0])
    shine = highlights(upright, rays, views.astype(np.float64), FLAT_LOBES) / (0.9 * rays[..., 2])
    reading = read(lights, views, scaled, gloss)
    present = 1 + np.tensordot(flat_gloss, shine, 1)
    for j in range(len(FLAT_LOBES)):
        step = 1e-6
        expected = (reading * present / (present + step * shine[j]) - reading) / step
        got = columns[..., UNKNOWNS - len(FLAT_LOBES) + j]
        np.testing.assert_allclose(got, expected.T, rtol=1e-4, atol=1e-7)


def test_the_column_of_the_level_is_what_a_higher_surface_reads(scene):
    lights, views, scaled, gloss = scene
    random = np.random.default_rng(5)
    raised = (lights * random.uniform(0.99, 1.01, lights.shape)).astype(np.float32)
    seen = unit(views + random.normal(0, 0.01, views.shape)).astype(np.float32)
    dimmer = random.uniform(0.99, 1.01, (LAMPS, PIXELS)).astype(np.float32)
    columns = linearised(scene, raised_lights=raised, raised_views=seen, dimmer=dimmer)[0]
    # There is predicted what is seen there; the photograph, divided by another flat, reads `dimmer` times as much.
    change = read(raised, seen, scaled, gloss) - dimmer * read(lights, views, scaled, gloss)
    np.testing.assert_allclose(columns[..., 0], change.T / STEP, rtol=1e-4, atol=1e-5)


def solved(images, lights, views, gloss, departure, start, limit=NO_LIMIT):
    scaled, surprise = start.copy(), np.empty(PIXELS)
    weights = np.full((LAMPS, PIXELS), 1e6, np.float32)
    solve_normals(
        images.astype(np.float32), lights, weights, views, gloss, ALPHAS, GRAZING, departure, MISFIT, limit, 12, 0,
        PIXELS, scaled, surprise,
    )  # fmt: skip
    return scaled, surprise


def test_normals_of_glossy_rough_paint_are_found_from_matt_beginnings(scene):
    lights, views, scaled, _ = scene
    gloss = np.zeros(len(KINDS))
    gloss[[4, 5]] = 0.6
    images = read(lights, views, scaled, gloss)
    start = np.stack(
        [np.linalg.lstsq(lights[:, p], images[:, p], rcond=None)[0] for p in range(PIXELS)]
    ).astype(np.float64)
    assert np.abs(start - scaled).max() > 0.02
    found, surprise = solved(images, lights, views, gloss, DEPARTURE, start)
    np.testing.assert_allclose(found, scaled, atol=1e-5)
    # That of the last evaluation, before a step of 5e-5 at the most.
    assert surprise.max() < 0.05


def test_one_sample_that_is_wrong_hardly_moves_a_normal_where_the_loss_is_robust(scene):
    lights, views, scaled, _ = scene
    none = np.zeros(len(KINDS))
    images = read(lights, views, scaled, none, 0.0)
    images[2] *= 1.5
    apart = [
        np.abs(solved(images, lights, views, none, 0.0, scaled, limit)[0] - scaled).max()
        for limit in (NO_LIMIT, 2.4)
    ]
    assert apart[0] > 0.05
    assert apart[1] < 0.005


def test_a_normal_that_is_not_known_stays_so_and_surprises_nobody(scene):
    lights, views, scaled, gloss = scene
    scaled = scaled.copy()
    scaled[4] = np.nan
    found, surprise = solved(read(lights, views, scaled, gloss), lights, views, gloss, DEPARTURE, scaled)
    assert np.isnan(found[4]).all()
    assert np.isnan(surprise[4])
    assert np.isfinite(np.delete(found, 4, axis=0)).all()


def test_normals_are_eliminated_as_by_dense_matrices(scene):
    random = np.random.default_rng(3)
    scaled = scene[2]
    columns, slopes, _, _ = linearised(scene)
    precisions = random.uniform(1, 9, (PIXELS, LAMPS))
    precisions[5, 2] = 0
    slopes[8, :, 2] = 0  # all lights of this pixel lie in one plane: it has no normal
    residuals, bends = random.normal(size=(PIXELS, LAMPS)), random.normal(0, 0.1, (PIXELS, UNKNOWNS))
    inverses, tilts = np.empty((PIXELS, 6)), np.empty((2, UNKNOWNS, PIXELS))
    own = precisions.copy()
    eliminate_normals(columns, slopes, own, scaled, 0, PIXELS, inverses, tilts)
    matrix, scores = np.zeros((UNKNOWNS, UNKNOWNS)), np.empty((PIXELS, UNKNOWNS))
    add_equations(columns, slopes, own, residuals, inverses, bends, 0, PIXELS, matrix, scores)

    assert not own[8].any()
    assert not tilts[:, :, 8].any()
    assert not scores[8].any()
    total = np.zeros_like(matrix)
    for p in set(range(PIXELS)) - {8}:
        weights, jacobian = np.diag(precisions[p]), slopes[p]
        answer = np.linalg.inv(jacobian.T @ weights @ jacobian) @ jacobian.T @ weights
        turned = -answer @ columns[p]
        # Slopes of the surface are -bx / bz and -by / bz.
        for axis in range(2):
            step = 1e-7
            b, moved = scaled[p], scaled[p][:, None] + step * turned
            expected = (-moved[axis] / moved[2] + b[axis] / b[2]) / step
            np.testing.assert_allclose(tilts[axis, :, p], expected, rtol=1e-4, atol=1e-5)
        whole = columns[p] + columns[p, :, :1] * bends[p]
        left = whole - jacobian @ (answer @ whole)
        np.testing.assert_allclose(scores[p], left.T @ weights @ residuals[p], rtol=1e-6, atol=1e-9)
        total += left.T @ weights @ left
    np.testing.assert_allclose(matrix, np.triu(total), rtol=1e-7, atol=1e-9 * total.max())
