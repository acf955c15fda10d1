"""What a calibration found is taken out of samples, and what a flat cannot say is left out."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.correction import (
    known_lights,
    leave_out_unreached,
    take_out_gloss,
    unreached,
)
from nlights_core.calibration.reflectance import FLAT_LOBES, KINDS, Reflectance, excess, highlights
from nlights_core.calibration.sampling import (
    corrected,
    flat_field_of,
    mean_flat,
    view_directions,
    within_flat,
)
from nlights_core.calibration.unknowns import nothing
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.photographs.development import Band, Raw
from nlights_core.photographs.flat_fields import FlatField

STAND = load_stand("horizontal")
LIGHTS = LightField(tuple(STAND.lamps), positions=STAND.lamp_positions())
GRID = PixelGrid(60, 80, STAND.field_mm[0] / 80, tuple(float(c) for c in STAND.camera_position))
RNG = np.random.default_rng(0)


@pytest.fixture
def flat_field():
    logarithm = np.log(RNG.uniform(0.3, 0.8, (8, 7, 9, 3))).astype(np.float32)
    x, y = GRID.x(), GRID.y()
    return FlatField(logarithm, float(x[0]), float(y[0]), 62.0, GRID.camera, 0.0)


def glossy_band(reflectance):
    """A band of coloured samples of a rough, glossy surface, and its true scaled normals."""
    rows = slice(20, 32)
    points = GRID.points(rows.start, rows.stop)
    lights = LIGHTS.vectors(points)
    lights = (lights / lights[..., 2].mean(axis=0)[None, ..., None]).astype(np.float32)
    normals = RNG.normal([0, 0, 1], 0.05, (12, 80, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = RNG.uniform(0.2, 0.9, (12, 80, 3))
    colours = np.array([0.3, 0.5, 0.2])
    grey = albedo @ colours
    views = view_directions(GRID, points).astype(np.float64)
    shine, rough = excess(reflectance, normals, lights.astype(np.float64), views)
    body = np.einsum("lhwk,hwk->lhw", lights, normals) + rough
    images = body[..., None] * albedo + shine[..., None]
    weights = np.full(shine.shape, 1000, np.float32)
    band = Band(
        20, 32, images.astype(np.float32), weights, np.zeros(shine.shape, bool), lights, None,
        (body * grey + shine).astype(np.float32),
    )  # fmt: skip
    return band, normals, albedo, grey


def test_what_is_left_of_glossy_rough_paint_is_matt():
    gloss = np.zeros(len(KINDS))
    gloss[[3, 5, 10]] = 0.5, 0.6, 0.2
    reflectance = Reflectance(gloss, 0.4)
    band, normals, albedo, grey = glossy_band(reflectance)
    body = np.einsum("lhwk,hwk->lhw", band.lights, normals)
    assert np.abs(band.grey - body * grey).max() > 0.05
    plain = take_out_gloss(band, GRID, None, reflectance)
    np.testing.assert_allclose(plain.grey, body * grey, atol=2e-4)
    np.testing.assert_allclose(plain.images, body[..., None] * albedo, atol=5e-4)


def test_a_pixel_without_a_normal_stays_as_it_was():
    gloss = np.zeros(len(KINDS))
    gloss[4] = 1
    band, *_ = glossy_band(Reflectance(gloss, 0.0))
    band.weights[2:, 3, 7] = 0
    plain = take_out_gloss(band, GRID, None, Reflectance(gloss, 0.0))
    np.testing.assert_array_equal(plain.grey[:, 3, 7], band.grey[:, 3, 7])
    np.testing.assert_array_equal(plain.images[:, 3, 7], band.images[:, 3, 7])
    assert np.isfinite(plain.images).all()
    assert np.abs(plain.grey[:, 3, 8] - band.grey[:, 3, 8]).max() > 1e-3


def test_strengths_and_light_of_the_room_go_to_the_lamps(flat_field):
    shared = replace(nothing(8), strengths=np.linspace(-0.1, 0.1, 8), room=0.03)
    known = known_lights(LIGHTS, flat_field, shared)
    np.testing.assert_allclose(known.power[:, 0], np.exp(shared.strengths))
    np.testing.assert_allclose(known.ambient, 0.03 * mean_flat(flat_field))
    assert not known_lights(LIGHTS, flat_field, nothing(8)).ambient.any()


def test_frames_and_flats_lose_the_light_that_is_always_there(flat_field):
    shared = replace(nothing(8), additive=0.02, room=0.01, strengths=np.linspace(-0.1, 0.1, 8))
    mean = mean_flat(flat_field)
    assert mean == pytest.approx(np.exp(flat_field.logarithm).mean())
    light = RNG.uniform(0.1, 0.5, (8, 4, 5, 3)).astype(np.float32)
    scaled = RNG.normal([0, 0, 0.6], 0.05, (4, 5, 3))
    reflected = np.linalg.norm(scaled, axis=-1)
    drift = np.exp(shared.strengths)[:, None, None, None]
    images = drift * light + mean * (0.02 + 0.01 * reflected)[..., None]
    raw = Raw(0, 4, images.astype(np.float32), np.zeros((8, 4, 5), bool), np.ones((4, 5), bool))
    np.testing.assert_allclose(corrected(raw, flat_field, shared, scaled).images, light, atol=1e-6)
    lit = np.exp(flat_field_of(flat_field, LIGHTS, shared).logarithm)
    np.testing.assert_allclose(lit, np.exp(flat_field.logarithm) - 0.03 * mean, atol=1e-6)
    assert flat_field_of(flat_field, LIGHTS, nothing(8)) is flat_field


def test_a_flat_loses_its_highlights(flat_field):
    shared = nothing(8)
    shared.flat_gloss[1] = 0.7
    lit = flat_field_of(flat_field, LIGHTS, shared).logarithm - flat_field.logarithm
    assert (lit < 0).all()
    # At one of its places, by hand.
    row, column, lamp = 3, 6, 2
    point = np.array([flat_field.left + 62 * column, flat_field.top - 62 * row, 0])
    ray, view = LIGHTS.positions[lamp] - point, np.array(GRID.camera) - point
    ray, view = ray / np.linalg.norm(ray), view / np.linalg.norm(view)
    shine = 0.7 / 0.9 * float(highlights(np.array([0.0, 0, 1]), ray, view, FLAT_LOBES)[1])
    np.testing.assert_allclose(lit[lamp, row, column], -np.log1p(shine / ray[2]), rtol=1e-4)


@pytest.mark.parametrize("level", [0.0, 5.0, 20.0, -20.0])
def test_rays_that_miss_the_flat_are_counted_and_left_out(level):
    height = np.full(GRID.shape, level, np.float32)
    points = GRID.points(0, GRID.rows, height)
    expected = np.zeros((8, *GRID.shape), bool)
    edge = 0.01 * GRID.columns + 0.5
    half = [(n / 2 + edge) * GRID.pixel_size for n in (GRID.columns, GRID.rows)]
    for k, position in enumerate(LIGHTS.positions):
        share = position[2] / (position[2] - level)
        landed = position[:2, None, None] + (points[:2] - position[:2, None, None]) * share
        expected[k] = (np.abs(landed[0]) <= half[0]) & (np.abs(landed[1]) <= half[1])
    np.testing.assert_array_equal(within_flat(GRID, LIGHTS, points, 0.01), expected)
    assert unreached(GRID, height, LIGHTS) == pytest.approx(1 - expected.mean())
    assert (unreached(GRID, height, LIGHTS) > 0) == (level != 0)
    band, *_ = glossy_band(Reflectance(np.zeros(len(KINDS)), 0.0))
    left = leave_out_unreached(band, GRID, height[20:32], LIGHTS)
    np.testing.assert_array_equal(left.weights > 0, expected[:, 20:32])
