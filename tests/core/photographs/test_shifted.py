"""Photographs brought back: what moved lies where it was, what was not seen is not used, whatever the strips are."""

import numpy as np
import pytest
import tifffile

from nlights_core.capture import Encoding
from nlights_core.photographs.images import Photograph, is_saturated
from nlights_core.photographs.shifted import Shift, ShiftedPhotograph, noise_left

ROWS, COLUMNS = 60, 80


def picture(right=0.0, down=0.0):
    """A smooth picture, moved; its finest wave is seven pixels long."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    y, x = y - down, x - right
    light = 0.4 + 0.1 * np.sin(2 * np.pi * x / 7 + 1) * np.cos(2 * np.pi * y / 11) + 0.1 * np.sin((x + y) / 5)
    return light.astype(np.float32)


def write(folder, name, light):
    tifffile.imwrite(folder / name, light)
    return folder / name


def brought_back(path, shift, encoding=None):
    return ShiftedPhotograph(path, encoding or Encoding(), None, None, shift)


@pytest.mark.parametrize(("right", "down"), [(0.5, -0.3), (-2.25, 1.6), (3.0, 0.0), (0.0, -0.49)])
def test_a_picture_comes_back_to_where_it_was(tmp_path, right, down):
    path = write(tmp_path, "a.tif", picture(right, down))
    with brought_back(path, Shift(right, down)) as photograph:
        found = photograph.band(0, ROWS)[..., 0]
    inside = (slice(12, -12), slice(12, -12))
    np.testing.assert_allclose(found[inside], picture()[inside], atol=1e-3)


@pytest.mark.parametrize(("right", "down"), [(0.5, 0.5), (2.0, -1.0), (0.3, 1.1)])
def test_noise_is_left_as_is_said(tmp_path, right, down):
    noise = np.random.default_rng(2).normal(0.5, 0.01, (200, 220)).astype(np.float32)
    shift = Shift(right, down)
    with brought_back(write(tmp_path, "a.tif", noise), shift) as photograph:
        found = photograph.band(0, 200)[12:-12, 12:-12, 0]
    assert found.std() == pytest.approx(0.01 * noise_left([shift]), rel=0.02)


def test_strips_give_the_same_bytes(tmp_path):
    random = np.random.default_rng(1).random((ROWS, COLUMNS), np.float32)
    path = write(tmp_path, "a.tif", random)
    with brought_back(path, Shift(1.3, -2.6)) as photograph:
        whole = photograph.band(0, ROWS)
        for size in (1, 7, 33):
            parts = [photograph.band(a, min(a + size, ROWS)) for a in range(0, ROWS, size)]
            np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_what_rests_on_a_saturated_sample_or_on_none_is_saturated(tmp_path):
    light = picture()
    light[30, 40] = 1.0
    with brought_back(write(tmp_path, "a.tif", light), Shift(2.5, 0.0)) as photograph:
        found = is_saturated(photograph.band(0, ROWS))
    # The bright place lies 2.5 px to the left now, and the last columns were never seen.
    assert found[30, 36:40].all()
    assert found[:, -2:].all()
    assert not found[:, :30].any()
    assert not found[:25, :-3].any()


def test_movement_beyond_the_photograph_leaves_nothing(tmp_path):
    with brought_back(write(tmp_path, "a.tif", picture()), Shift(0.0, 200.0)) as photograph:
        assert is_saturated(photograph.band(10, 20)).all()


def test_without_a_saturation_level_every_number_stays_finite(tmp_path):
    path = write(tmp_path, "a.tif", 5 * picture())
    with brought_back(path, Shift(1.5, 0.5), encoding=Encoding(saturation="none")) as photograph:
        found = photograph.band(0, ROWS)
    assert np.isfinite(found).all()
    assert found.max() > 1.5


def test_the_dark_frames_pattern_stays_on_the_sensor(tmp_path):
    pattern = np.where(np.indices((ROWS, COLUMNS)).sum(axis=0) % 2, 0.05, 0.0).astype(np.float32)
    path = write(tmp_path, "a.tif", picture(0.5, 0.5) + pattern)
    dark = write(tmp_path, "dark.tif", pattern)
    with (
        Photograph(dark) as own,
        ShiftedPhotograph(path, Encoding(), None, own, Shift(0.5, 0.5)) as photograph,
    ):
        found = photograph.band(20, 40)[:, 12:-12, 0]
    np.testing.assert_allclose(found - pattern[20:40, 12:-12], picture()[20:40, 12:-12], atol=1e-3)


def test_where_the_artwork_moved_the_light_did_not(tmp_path):
    # Light that falls off to the right: exp(-0.5 x), x from -1 to 1 over the field.
    x = (2 * np.arange(COLUMNS) + 1) / COLUMNS - 1
    light = np.exp(-0.5 * x).astype(np.float32)
    path = write(tmp_path, "a.tif", picture(4.5) * light)
    with brought_back(path, Shift(4.5, 0.0, ((0.0, -0.5),))) as photograph:
        found = photograph.band(0, ROWS)[..., 0]
    np.testing.assert_allclose(found[12:-12, 12:-16], (picture() * light)[12:-12, 12:-16], atol=1e-3)
