"""Flat fields: smooth, continued past the frame, and read along each lamp's ray."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.configurations import load_stand
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.photographs.flat_fields import (
    block_size,
    extend_beyond_frame,
    natural_vignetting,
    read_flat_field,
    vignetting,
    write_flat_field,
)


def horizontal() -> LightField:
    stand = load_stand("horizontal")
    positions = stand.lamp_positions()
    axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    exponents = np.full(8, stand.lamp.exponent)
    return LightField(tuple(stand.lamps), positions=positions, axes=axes, exponents=exponents)


GRID = PixelGrid(750, 1000, 0.5, (0.0, 0.0, 1542.0))


def lensed_flat_field():
    """What the horizontal stand's lensed lamps give on the plane, known only in the frame."""
    block = block_size(GRID)
    x, y = GRID.reduced(block).x(), GRID.reduced(block).y()
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
    lights = horizontal()
    return lights, extend_beyond_frame(lights.vectors(points)[..., 2:], x, y, block * GRID.pixel_size)


def test_inside_the_frame_the_flat_field_is_what_was_given():
    lights, flat_field = lensed_flat_field()
    points = GRID.points(0, GRID.rows)[:, 8:-8:31, 8:-8:37]
    truth = lights.vectors(points)[..., 2]
    for i in range(8):
        found = flat_field.at(i, points[0], points[1])[..., 0]
        np.testing.assert_allclose(found, truth[i], rtol=2e-3)


def test_past_the_frame_it_is_right_to_a_few_percent_and_farther_out_of_the_right_size():
    lights, flat_field = lensed_flat_field()
    x, y = (a.astype(np.float32) for a in np.meshgrid([-285.0, 285.0], np.linspace(-180, 180, 9)))
    truth = lights.vectors(np.stack([x, y, 0 * x]))[..., 2]
    for i in range(8):
        np.testing.assert_allclose(flat_field.at(i, x, y)[..., 0], truth[i], rtol=0.3)
    near = x * 0 + np.sign(x) * 255
    truth = lights.vectors(np.stack([near, y, 0 * x]))[..., 2]
    for i in range(8):
        np.testing.assert_allclose(flat_field.at(i, near, y)[..., 0], truth[i], rtol=0.05)


def test_read_along_the_lamps_ray_the_emission_cancels_at_any_height():
    lights = horizontal()
    z = 8.0
    points = GRID.points(0, GRID.rows, np.full(GRID.shape, z))[:, ::150, ::150]
    foot = lights.plane_points(points)
    bare = LightField(lights.lamps, positions=lights.positions)
    for i in range(8):
        on_plane = np.stack([foot[i, 0], foot[i, 1], 0 * foot[i, 0]])
        with_lens = lights.only(i).vectors(points)[0] / lights.only(i).vectors(on_plane)[0, ..., 2:]
        without = bare.only(i).vectors(points)[0] / bare.only(i).vectors(on_plane)[0, ..., 2:]
        np.testing.assert_allclose(with_lens, without, rtol=1e-4)


def test_a_point_of_the_plane_is_its_own_foot():
    points = GRID.points(0, 5)
    foot = horizontal().plane_points(points)
    for i in range(8):
        np.testing.assert_allclose(foot[i], points[:2], atol=1e-4)


CAMERA = (0.0, 0.0, 1542.0)


def photographed(lens: float, aim_deg: float = 0.0):
    """Readings of lensed lamps, seen through a lens with so much vignetting, and their places."""
    x, y = GRID.reduced(5).x(), GRID.reduced(5).y()
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
    lights = horizontal()
    axes = lights.axes + np.radians(aim_deg) * np.random.default_rng(2).normal(size=(8, 3))
    lights = replace(lights, axes=axes / np.linalg.norm(axes, axis=1, keepdims=True))
    # Only where they are is told, not how they shine.
    bare = LightField(lights.lamps, positions=lights.positions)
    dimmed = np.exp(lens * natural_vignetting(CAMERA, points[0], points[1]))
    return lights, bare, lights.vectors(points)[..., 2:] * dimmed[..., None], x, y


def test_natural_vignetting_is_the_fourth_power_of_the_cosine():
    angle = np.arctan(300 / 1542)
    found = natural_vignetting((10.0, 0.0, 1542.0), np.array([190.0]), np.array([240.0]))
    np.testing.assert_allclose(np.exp(found), np.cos(angle) ** 4, rtol=1e-12)


@pytest.mark.parametrize("lens", [0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("aim_deg", [0.0, 2.0])
def test_vignetting_is_told_from_the_lamps_own_fall_off(lens, aim_deg):
    _, bare, reading, x, y = photographed(lens, aim_deg)
    reading[2, 10:20, 30:40] = np.nan
    assert vignetting(reading, bare, x, y, CAMERA) == pytest.approx(lens, abs=0.05)


def test_vignetting_of_a_single_lamp_or_of_lamps_that_disagree_is_hardly_believed():
    _, bare, reading, x, y = photographed(1.0)
    assert vignetting(reading[:1], bare.only(0), x, y, CAMERA) == 0.5
    points = np.meshgrid(x, y)
    for i, odd in enumerate([-9, 7, 5, -8, 9, -4, -6, 3]):
        reading[i] *= np.exp(odd * natural_vignetting(CAMERA, *points))[..., None]
    assert 0 < vignetting(reading, bare, x, y, CAMERA) < 1


def test_the_lamps_light_is_read_at_its_foot_but_the_lens_at_the_pixel():
    lights, bare, reading, x, y = photographed(1.0)
    lens = vignetting(reading, bare, x, y, CAMERA)
    flat_field = replace(
        extend_beyond_frame(reading, x, y, 5 * GRID.pixel_size), camera=CAMERA, vignetting=lens
    )
    pixels = GRID.points(0, GRID.rows)[:, 150:-150:50, 150:-150:50]
    points = GRID.points(0, GRID.rows, np.full(GRID.shape, 8.0))[:, 150:-150:50, 150:-150:50]
    feet = lights.plane_points(points)
    for i, (foot_x, foot_y) in enumerate(feet):
        light = lights.only(i).vectors(np.stack([foot_x, foot_y, 0 * foot_x]))[0, ..., 2]
        truth = light * np.exp(natural_vignetting(CAMERA, pixels[0], pixels[1]))
        np.testing.assert_allclose(flat_field.at(i, foot_x, foot_y, pixels[:2])[..., 0], truth, rtol=1e-3)


def test_holes_are_bridged_and_a_flat_field_mostly_unknown_is_refused():
    x, y = GRID.reduced(4).x(), GRID.reduced(4).y()
    reading = np.ones((1, len(y), len(x), 1), np.float32)
    reading[0, 10:20, 10:20] = np.nan
    flat_field = extend_beyond_frame(reading, x, y, 2.0)
    np.testing.assert_allclose(flat_field.logarithm, 0, atol=1e-6)
    reading[0, :, : 2 * len(x) // 3] = np.nan
    with pytest.raises(TileError, match="lamp 1"):
        extend_beyond_frame(reading, x, y, 2.0)


@pytest.mark.parametrize("camera", [None, (0.5, -0.1, 1542.25)])
def test_a_flat_field_is_read_back_as_it_was_written(tmp_path, camera):
    flat_field = replace(lensed_flat_field()[1], camera=camera, vignetting=0.9)
    write_flat_field(tmp_path, flat_field)
    again = read_flat_field(tmp_path)
    np.testing.assert_array_equal(again.logarithm, flat_field.logarithm)
    assert (again.left, again.top, again.step) == (flat_field.left, flat_field.top, flat_field.step)
    assert (again.camera, again.vignetting) == (flat_field.camera, flat_field.vignetting)


def test_in_the_frame_only_is_shown_to_people():
    _, flat_field = lensed_flat_field()
    inside = flat_field.inside(GRID)
    block = block_size(GRID)
    assert inside.shape[1:3] == (GRID.rows // block, GRID.columns // block)
