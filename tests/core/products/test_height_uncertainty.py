"""The uncertainty of a height: noise through the integrator as in trials, coarse maps as straight lines."""

import numpy as np
import pytest

from nlights_core.frames import PixelGrid
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.products.height_uncertainty import Stretched, height_noise
from nlights_core.solving.least_squares import COVERING


@pytest.mark.parametrize(("shape", "pixel"), [((96, 128), 0.5), ((40, 200), 0.1), ((150, 150), 2.0)])
def test_noise_of_normals_makes_the_height_as_uncertain_as_in_trials(shape, pixel):
    random, grid, confidence = np.random.default_rng(1), PixelGrid(*shape, pixel), 0.3
    squares = []
    for _ in range(30):
        slopes = random.normal(0, np.radians(confidence) / COVERING, (2, *shape))
        normals = np.stack([*-slopes, np.ones(shape)], axis=-1)
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
        height = least_squares_height(normals, grid)
        squares.append(np.mean((height - height.mean()) ** 2, dtype=float))
    trials = np.sqrt(np.mean(squares))
    # The integrator's steps are means over pixels, which lowers the finest noise a little.
    assert height_noise(confidence, grid) == pytest.approx(trials, rel=0.12)


def test_confidence_is_the_angle_within_which_68_percent_of_such_normals_lie():
    slopes = np.random.default_rng(2).normal(0, np.radians(0.3) / COVERING, (2, 100_000))
    assert np.mean(np.degrees(np.hypot(*slopes)) < 0.3) == pytest.approx(0.68, abs=0.005)


def test_noise_grows_with_the_pixel_and_with_the_angle():
    small, wide = PixelGrid(60, 80, 0.5), PixelGrid(60, 80, 1.0)
    assert height_noise(0.2, wide) == pytest.approx(2 * height_noise(0.2, small))
    assert height_noise(0.4, small) == pytest.approx(2 * height_noise(0.2, small))
    assert height_noise(0.0, small) == 0


@pytest.mark.parametrize(("parts", "shape"), [((3, 4), (36, 48)), ((5, 7), (50, 77)), ((1, 1), (9, 11))])
def test_a_plane_on_blocks_is_stretched_to_the_plane_between_their_middles(parts, shape):
    def at(count, length):
        return np.clip((np.arange(length) + 0.5) * count / length - 0.5, 0, count - 1)

    coarse = (2 * np.arange(parts[0])[:, None] - 0.5 * np.arange(parts[1]) + 3).astype(np.float32)
    expected = 2 * at(parts[0], shape[0])[:, None] - 0.5 * at(parts[1], shape[1]) + 3
    found = Stretched(coarse, shape)
    np.testing.assert_allclose(found[0 : shape[0]], expected, atol=1e-5)
    np.testing.assert_array_equal(found[4:7], found[0 : shape[0]][4:7])
    assert found[4:7].dtype == np.float32


def test_stretched_values_stay_between_those_of_the_blocks():
    coarse = np.random.default_rng(0).uniform(1, 2, (6, 8)).astype(np.float32)
    found = Stretched(coarse, (61, 83))[0:61]
    assert coarse.min() <= found.min()
    assert found.max() <= coarse.max()
    assert found.shape == (61, 83)
