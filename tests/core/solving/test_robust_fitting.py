"""Robust fits: what is an outlier, what is only noise, and pixels that stand for themselves."""

import numpy as np
import pytest

from nlights_core.algorithms import PHOTONS, Solution
from nlights_core.simulation.evaluation import angles_between
from nlights_core.solving import least_squares, robust_fitting
from nlights_core.solving.triplets import median_of_triplets

CONDITION = 100.0


def rig(count):
    """Directions of lamps in two rings, 25 and 50 degrees above the horizon; (count, 1, 3) float32."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    height = np.radians(np.where(np.arange(count) % 2, 50, 25))
    rays = np.stack([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)], axis=-1)
    return rays[:, None].astype(np.float32)


def matt(count, pixels, noise=0.0, seed=0):
    """Images (count, pixels) of a matt surface, lights, and the true normals (pixels, 3)."""
    random = np.random.default_rng(seed)
    normals = np.concatenate([random.uniform(-0.25, 0.25, (pixels, 2)), np.ones((pixels, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = random.uniform(0.1, 0.9, pixels)
    images = albedo * np.einsum("lnk,nk->ln", rig(count), normals)
    images = images + noise * np.sqrt(images) * random.standard_normal(images.shape)
    return images.astype(np.float32), rig(count), normals


def normals_of(fit):
    return (fit.scaled / np.linalg.norm(fit.scaled, axis=0)).T


def mean_error(fit, truth):
    return angles_between(normals_of(fit), truth).mean()


def reweighted(images, lights, weights=None, noise=0.005):
    """Weights as shares of what the noise stands for."""
    scale = np.float32(1 / (noise**2 * PHOTONS))
    weights = np.ones_like(images) if weights is None else weights
    kept, found = robust_fitting.reweigh(images, lights, weights * scale, CONDITION)
    return kept / scale, found


def test_where_there_is_nothing_but_noise_least_squares_stand():
    images, lights, truth = matt(8, 20_000, noise=0.005)
    weights, robust = reweighted(images, lights)
    plain = least_squares.fit(images, lights, np.ones_like(images), CONDITION)
    assert (weights.min(axis=0) > 0.9999).mean() > 0.98
    assert mean_error(robust, truth) <= 1.01 * mean_error(plain, truth)


def test_noise_beyond_the_stated_is_taken_for_noise_when_there_are_many_lights():
    images, lights, truth = matt(96, 2000, noise=0.02)
    _, robust = reweighted(images, lights)
    plain = least_squares.fit(images, lights, np.ones_like(images), CONDITION)
    # Tukey's biweight keeps 95 % of the efficiency, which is 1 / sqrt(0.95) = 1.026 in the angle.
    assert mean_error(robust, truth) <= 1.026 * mean_error(plain, truth)


@pytest.mark.parametrize("factor", [0.0, 0.4, 3.0])
def test_two_wrong_lights_of_eight_are_found_out(factor):
    images, lights, truth = matt(8, 2000, noise=0.002)
    images[1] *= factor
    images[6] *= factor
    weights, robust = reweighted(images, lights)
    right = np.delete(np.arange(8), [1, 6])
    oracle = least_squares.fit(images[right], lights[right], np.ones((6, 2000)), CONDITION)
    assert mean_error(robust, truth) <= 1.2 * mean_error(oracle, truth)
    assert (weights[[1, 6]] == 0).mean() > 0.99


def test_a_third_of_many_lights_may_be_wrong():
    images, lights, truth = matt(60, 500, noise=0.005)
    images[::3] *= np.random.default_rng(5).uniform(1.5, 6, (20, 500)).astype(np.float32)
    _, robust = reweighted(images, lights)
    plain = least_squares.fit(images, lights, np.ones_like(images), CONDITION)
    assert mean_error(plain, truth) > 3
    assert mean_error(robust, truth) < 0.3


def test_images_in_an_arbitrary_unit_are_not_taken_for_noise():
    images, lights, truth = matt(12, 500)
    images[4] *= 2
    _, robust = reweighted(images * np.float32(1e-5), lights)
    assert mean_error(robust, truth) < 0.05


def test_four_lights_are_left_to_least_squares():
    images, lights, _ = matt(4, 50)
    images[2] *= 2
    weights, robust = reweighted(images, lights)
    plain = least_squares.fit(images, lights, np.ones_like(images), CONDITION)
    np.testing.assert_allclose(weights, 1, rtol=1e-6)
    np.testing.assert_allclose(robust.scaled, plain.scaled, rtol=1e-6)


def test_black_pixels_and_pixels_with_two_lights_stay_unknown():
    images, lights, truth = matt(8, 6)
    weights = np.ones_like(images)
    images[3] *= 2
    images[:, 1] = 0
    weights[2:, 4] = 0
    _, robust = reweighted(images, lights, weights)
    assert np.isnan(robust.scaled[:, 4]).all()
    assert (robust.scaled[:, 1] == 0).all()
    others = [0, 2, 3, 5]
    normals = robust.scaled[:, others] / np.linalg.norm(robust.scaled[:, others], axis=0)
    assert angles_between(normals.T, truth[others]).max() < 0.05


def test_rank_trimming_keeps_the_ranks_between_the_shares_of_the_usable_samples():
    images = np.arange(10, dtype=np.float32)[::-1, None].repeat(2, axis=1)
    weights = np.full_like(images, 0.5)
    weights[:5, 1] = 0
    kept = robust_fitting.trim_by_rank(images, weights, 0.2, 0.1)
    assert images[kept[:, 0] > 0, 0].tolist() == [8, 7, 6, 5, 4, 3, 2]
    assert images[kept[:, 1] > 0, 1].tolist() == [3, 2, 1]
    assert set(kept.ravel()) == {0.0, 0.5}


def test_the_median_of_triplets_outvotes_a_wrong_light():
    images, lights, truth = matt(8, 300)
    images[5] *= 2
    found = median_of_triplets(images, lights, np.ones_like(images), 120)
    normals = (found / np.linalg.norm(found, axis=0)).T
    assert angles_between(normals, truth).max() < 0.05


def test_with_three_lights_the_median_of_triplets_is_their_solution_and_with_two_unknown():
    images, lights, truth = matt(3, 5)
    weights = np.ones_like(images)
    weights[1, 2] = 0
    found = median_of_triplets(images, lights, weights, 120)
    assert np.isnan(found[:, 2]).all()
    others = [0, 1, 3, 4]
    normals = (found / np.linalg.norm(found, axis=0)).T
    assert angles_between(normals[others], truth[others]).max() < 0.01


@pytest.mark.parametrize("shared", [True, False])
def test_blocks_put_every_pixel_back_in_its_place(shared, monkeypatch):
    monkeypatch.setattr(robust_fitting, "BLOCK_SAMPLES", 100)
    random = np.random.default_rng(3)
    images, weights = random.random((2, 5, 7, 9), dtype=np.float32)
    lights = random.random((5, 1, 1, 3) if shared else (5, 7, 9, 3), dtype=np.float32)

    def echo(images, lights, weights):
        rays = np.broadcast_to(lights, (*images.shape, 3))
        return Solution(rays[1] * images[2, :, None], images[0], weights[4], weights * images)

    found = robust_fitting.in_blocks(echo, images, lights, weights)
    normals = np.broadcast_to(lights, (5, 7, 9, 3))[1] * images[2, ..., None]
    assert np.array_equal(found.normals, normals)
    assert np.array_equal(found.albedo, images[0])
    assert np.array_equal(found.confidence, weights[4])
    assert np.array_equal(found.weights, weights * images)
