"""Kernels: what they find is what numpy finds, with any number of threads, from any installation."""

import os
import subprocess
import sys

import numpy as np
import pytest

from nlights_core.algorithms import PHOTONS, Solution
from nlights_core.machine import kernel_switch
from nlights_core.simulation.evaluation import angles_between
from nlights_core.solving import kernels
from nlights_plugins.least_squares import LeastSquares
from nlights_plugins.median_of_triplets import MedianOfTriplets
from nlights_plugins.progressive import Progressive
from nlights_plugins.rank_trim import RankTrim
from nlights_plugins.robust import Robust

pytest.importorskip("numba")

SHAPE = (13, 41)

SOLVERS = [
    LeastSquares(),
    Robust(),
    RankTrim(),
    RankTrim(darkest=0.3, brightest=0),
]


def directions(count: int) -> np.ndarray:
    """Light vectors (count, 1, 1, 3) float32 of two rings, relative to a flat field."""
    turn = 2 * np.pi * np.arange(count) / count
    height = np.radians(np.where(np.arange(count) % 2, 50, 25))
    rays = np.stack([np.cos(turn), np.sin(turn), np.tan(height)], axis=-1) / np.tan(height)[:, None]
    return rays[:, None, None].astype(np.float32)


def scene(count: int, wrong: float = 0.3, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noisy images of a matt surface, of which a share shows one light too bright; normals."""
    random = np.random.default_rng(seed)
    normals = np.concatenate([random.normal(0, 0.1, (*SHAPE, 2)), np.ones((*SHAPE, 1))], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    images = np.einsum("lhwk,hwk->lhw", np.broadcast_to(directions(count), (count, *SHAPE, 3)), normals)
    images = np.maximum(images * random.uniform(0.1, 0.9, SHAPE), 0)
    images += np.sqrt(images / PHOTONS) * random.standard_normal(images.shape)
    glossy = random.random(SHAPE) < wrong
    images[random.integers(0, count, SHAPE)[glossy], *np.nonzero(glossy)] *= 1.7
    return images.astype(np.float32), random.uniform(0.5, 2, images.shape).astype(np.float32), normals


def both(solver, images, lights, weights, monkeypatch):
    """What the kernel and what numpy finds."""
    monkeypatch.delenv(kernel_switch.SWITCH, raising=False)
    fast = solver.solve(images, lights, weights)
    monkeypatch.setenv(kernel_switch.SWITCH, "off")
    return fast, solver.solve(images, lights, weights)


def assert_equal(fast, plain):
    # Rounding moves the weights of a reweighted fit a little, and they move the normal: 0.001 degrees.
    rounding = 2e-5
    for found, expected in zip(fast, plain, strict=True):
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(fast.normals, plain.normals, atol=rounding)
    np.testing.assert_allclose(fast.albedo, plain.albedo, rtol=rounding)
    np.testing.assert_allclose(fast.confidence, plain.confidence, rtol=3e-3)
    np.testing.assert_allclose(fast.weights, plain.weights, atol=3e-3)
    np.testing.assert_array_equal(fast.weights > 0, plain.weights > 0)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("count", [3, 4, 5, 8, 17, 96])
def test_the_kernel_finds_what_numpy_finds(solver, count, monkeypatch):
    images, weights, _ = scene(count)
    assert_equal(*both(solver, images, directions(count), weights, monkeypatch))


def chosen(found, pixels):
    """The solution of some pixels, (h, w) flags."""
    return Solution(*(part[pixels] for part in found[:3]), found.weights[:, pixels])


@pytest.mark.parametrize("solver", [Progressive(), Progressive(keep=3)])
@pytest.mark.parametrize("count", [3, 5, 8, 17])
def test_progressive_discards_alike_but_where_two_samples_are_equally_wrong(solver, count, monkeypatch):
    images, weights, _ = scene(count)
    weights[0, :4] = weights[1, 2:6] = 0
    images[2, 9] = np.nan
    fast, plain = both(solver, images, directions(count), weights, monkeypatch)
    alike = ((fast.weights > 0) == (plain.weights > 0)).all(axis=0)
    assert alike.mean() >= 0.99
    assert_equal(chosen(fast, alike), chosen(plain, alike))


@pytest.mark.parametrize("solver", [MedianOfTriplets(), MedianOfTriplets(most=20)])
@pytest.mark.parametrize("count", [3, 4, 5, 8, 17])
def test_medians_are_alike_but_where_two_triplets_share_the_middle(solver, count, monkeypatch):
    images, weights, _ = scene(count)
    weights[0, :4] = weights[1, 2:6] = weights[2, 3] = 0
    images[2, 9] = np.nan
    images[:, 10] = 0
    fast, plain = both(solver, images, directions(count), weights, monkeypatch)
    np.testing.assert_array_equal(np.isnan(fast.albedo), np.isnan(plain.albedo))
    alike = np.isnan(plain.albedo) | np.isclose(fast.normals, plain.normals, atol=2e-5).all(axis=-1)
    assert alike.mean() >= 0.99
    assert_equal(chosen(fast, alike), chosen(plain, alike))


@pytest.mark.parametrize("squeeze", [0.1, 0.02])
def test_progressive_keeps_lights_that_would_else_be_badly_spread(squeeze, monkeypatch):
    images, weights, _ = scene(8, wrong=0.0)
    lights = directions(8) * np.float32([1, squeeze, 1])
    fast, plain = both(Progressive(keep=3, condition=30.0), images, lights, weights, monkeypatch)
    alike = ((fast.weights > 0) == (plain.weights > 0)).all(axis=0)
    assert alike.mean() >= 0.98
    if squeeze == 0.1:
        assert ((plain.weights > 0).sum(axis=0) > 3).any()


@pytest.mark.parametrize("solver", [*SOLVERS, Robust(shadow=0)])
def test_lights_that_differ_from_pixel_to_pixel_are_followed(solver, monkeypatch):
    images, weights, _ = scene(8)
    spread = np.random.default_rng(1).uniform(0.9, 1.1, (8, *SHAPE, 3)).astype(np.float32)
    assert_equal(*both(solver, images, directions(8) * spread, weights, monkeypatch))


@pytest.mark.parametrize("solver", SOLVERS)
def test_what_must_not_be_used_is_ignored_and_too_little_stays_unknown(solver, monkeypatch):
    images, weights, _ = scene(8)
    random = np.random.default_rng(2)
    weights[random.random(images.shape) < 0.3] = 0
    weights[3:, 5] = 0
    weights[2:, 6] = 0
    weights[:, 7] = 0
    images[:, 8] = 0
    images[:, 9] = -images[:, 9]
    images[random.random(images.shape) < 0.05] = np.nan
    images[random.random(images.shape) < 0.05] *= 0.01
    fast, plain = both(solver, images, directions(8), weights, monkeypatch)
    assert_equal(fast, plain)
    assert np.isnan(fast.normals[6:10]).all()
    assert (fast.weights[:, 6:10] == 0).all()
    assert 0.5 < np.isfinite(fast.albedo).mean() < 1


@pytest.mark.parametrize("condition", [3.0, 5.0, 100.0])
@pytest.mark.parametrize("squeeze", [1.0, 0.1, 0.02, 0.004])
def test_badly_spread_lights_are_judged_alike(condition, squeeze, monkeypatch):
    images, weights, _ = scene(8, wrong=0.0)
    lights = directions(8) * np.float32([1, squeeze, 1])
    fast, plain = both(LeastSquares(condition=condition), images, lights, weights, monkeypatch)
    np.testing.assert_array_equal(np.isnan(fast.albedo), np.isnan(plain.albedo))
    # A sample rounded in its last digit moves the result as much as the lights are badly spread.
    np.testing.assert_allclose(fast.normals, plain.normals, atol=1e-6 / squeeze)


@pytest.mark.parametrize("unit", [1e-12, 1e9])
def test_weights_may_be_in_any_unit(unit, monkeypatch):
    images, weights, normals = scene(8, wrong=0.0)
    fast, plain = both(LeastSquares(), images, directions(8), weights * np.float32(unit), monkeypatch)
    np.testing.assert_allclose(fast.normals, plain.normals, atol=3e-6)
    assert angles_between(fast.normals, normals).mean() < 0.5


def test_the_number_of_threads_changes_no_bit(monkeypatch):
    images, weights, _ = scene(8)
    lights = np.tile(directions(8), (1, *SHAPE, 1))
    whole = Robust().solve(images, lights, weights)
    monkeypatch.setattr(kernels, "TASK", 128)
    monkeypatch.setattr(kernels, "SAMPLES", 1024)
    parts = Robust().solve(images, lights, weights)
    for one, other in zip(whole, parts, strict=True):
        assert one.tobytes() == other.tobytes()


def test_inputs_are_not_overwritten():
    images, weights, _ = scene(8)
    kept = images.copy(), weights.copy()
    for array in (images, weights):
        array.setflags(write=False)
    Robust().solve(images, directions(8), weights)
    np.testing.assert_array_equal(images, kept[0])
    np.testing.assert_array_equal(weights, kept[1])


def test_importing_the_core_does_not_import_numba():
    code = "import sys, nlights_core.solving.band_solving, nlights_plugins; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_switch_leaves_the_work_to_numpy():
    code = (
        "import sys, numpy as np\n"
        "from nlights_plugins.robust import Robust\n"
        "lights = np.float32([[1, 0, 1], [0, 1, 1], [-1, -1, 1]])[:, None, None]\n"
        "Robust().solve(np.ones((3, 1, 1), np.float32), lights, np.ones((3, 1, 1), np.float32))\n"
        "sys.exit('numba' in sys.modules)"
    )
    environment = {**os.environ, kernel_switch.SWITCH: "off"}
    assert subprocess.run([sys.executable, "-c", code], env=environment, check=False).returncode == 0
