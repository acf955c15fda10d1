"""Robust solvers on surfaces that are matt, glossy or shadowed, and on photographed ones."""

from pathlib import Path

import numpy as np
import pytest

from nlights_core.capture import Encoding
from nlights_core.fields import LightField
from nlights_core.photographs.images import Photograph, grey
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.scenes import synthetic_stand
from nlights_plugins.least_squares import LeastSquares
from nlights_plugins.median_of_triplets import MedianOfTriplets
from nlights_plugins.rank_trim import RankTrim
from nlights_plugins.robust import Robust

DATA = Path(__file__).parents[3] / "shared" / "data" / "diligent"
ELECTRONS = 60_000
"""Of a white sample under the brightest lamp; a grey value averages some more of them."""


def photographed(finish, seed=0):
    """A rough surface under the eight lamps of a stand: images, lights, weights, true normals.

    Relative to the flat field, as the stage hands it to a solver: a dim lamp has a small weight.
    """
    random = np.random.default_rng(seed)
    shape = (60, 80)
    stand = synthetic_stand()
    rays = LightField(tuple(stand.lamps), positions=stand.lamp_positions()).vectors(np.zeros((3, 1, 1)))
    normals = np.concatenate([random.normal(0, 0.07, (*shape, 2)), np.ones((*shape, 1))], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = random.uniform(0.1, 0.8, shape)
    images = albedo * np.maximum(np.einsum("labk,hwk->lhw", rays / rays[..., 2:], normals), 0)
    weights = np.broadcast_to(random.uniform(0.2, 1, (8, 1, 1)), images.shape).astype(np.float32)
    if finish == "glossy":
        half = rays / np.linalg.norm(rays, axis=-1, keepdims=True) + [0, 0, 1]
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        images = images + 2 * np.maximum(np.einsum("labk,hwk->lhw", half, normals), 0) ** 40
    if finish == "shadowed":
        # Half shadows, which no threshold removes; one lamp in each pixel.
        lamp = random.integers(8, size=(1, *shape))
        images = images * np.where(np.arange(8)[:, None, None] == lamp, 0.5, 1)
    images = images + random.standard_normal(images.shape) * np.sqrt(images / weights / ELECTRONS)
    lights = (rays / rays[..., 2:]).astype(np.float32)
    return images.astype(np.float32), lights, weights, normals


def error(solver, images, lights, weights, truth):
    return float(angles_between(solver.solve(images, lights, weights).normals, truth).mean())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_matt_surface_is_solved_as_well_as_by_least_squares(seed):
    scene = photographed("matt", seed)
    assert error(Robust(), *scene) <= 1.01 * error(LeastSquares(), *scene)


@pytest.mark.parametrize(("finish", "share"), [("glossy", 0.6), ("shadowed", 0.1)])
def test_highlights_and_half_shadows_are_left_out_better_than_by_trimming(finish, share):
    scene = photographed(finish)
    assert error(Robust(), *scene) < error(RankTrim(), *scene)
    assert error(Robust(), *scene) < share * error(LeastSquares(), *scene)


@pytest.mark.parametrize(("finish", "share"), [("glossy", 0.4), ("shadowed", 0.9)])
def test_the_median_of_triplets_is_better_than_least_squares_on_outliers(finish, share):
    scene = photographed(finish)
    assert error(MedianOfTriplets(), *scene) < share * error(LeastSquares(), *scene)


@pytest.mark.parametrize("lamp", range(8))
@pytest.mark.parametrize("factor", [0.5, 2])
def test_any_lamp_may_be_wrong_even_one_of_high_leverage(lamp, factor):
    images, lights, weights, truth = photographed("matt")
    images[lamp] *= factor
    others = np.delete(np.arange(8), lamp)
    without = error(LeastSquares(), images[others], lights[others], weights[others], truth)
    assert error(Robust(), images, lights, weights, truth) <= 1.05 * without


def test_the_weights_say_which_samples_were_left_out():
    images, lights, weights, _ = photographed("matt")
    images[6] *= 2
    found = Robust().solve(images, lights, weights)
    assert (found.weights[6] == 0).mean() > 0.99
    assert (np.delete(found.weights, 6, axis=0) > 0).mean() > 0.99


@pytest.mark.parametrize("solver", [Robust(), RankTrim(), MedianOfTriplets()])
@pytest.mark.parametrize("count", [3, 4])
def test_three_or_four_lights_are_solved_like_least_squares(solver, count):
    images, lights, weights, truth = photographed("matt")
    chosen = [0, 3, 5, 6][:count]
    part = images[chosen], lights[chosen], weights[chosen]
    found, plain = solver.solve(*part), LeastSquares().solve(*part)
    known = np.isfinite(plain.albedo)
    assert known.mean() > 0.99
    assert np.isfinite(found.albedo[known]).all()
    if count == 3 or isinstance(solver, Robust):
        assert angles_between(found.normals, plain.normals)[known].max() < 0.05
    plain_error = angles_between(plain.normals, truth)[known].mean()
    assert angles_between(found.normals, truth)[known].mean() < 5 * plain_error


def diligent(thing):
    """Grey images (96, 1, n), lights, weights and true normals (1, n, 3) of an object's pixels."""
    from scipy.io import loadmat

    folder = DATA / thing
    if not folder.exists():
        pytest.skip(f"diligent/{thing} is not beside the project")
    truth = loadmat(folder / "Normal_gt.mat")["Normal_gt"]
    inside = np.any(truth != 0, axis=-1)
    directions = np.loadtxt(folder / "light_directions.txt", dtype=np.float32)
    intensities = np.loadtxt(folder / "light_intensities.txt", dtype=np.float32)
    names = (folder / "filenames.txt").read_text().split()
    images = np.empty((len(names), 1, np.count_nonzero(inside)), np.float32)
    for image, name, intensity in zip(images, names, intensities, strict=True):
        with Photograph(folder / name, Encoding(saturation="none"), folder) as photograph:
            image[0] = grey(photograph.band(0, len(inside))[inside] / intensity)
    return images, directions[:, None, None], np.ones_like(images), truth[inside][None]


# The lights nearest to 15 degrees and to 45 degrees above the horizon on each of four sides.
RIG = [91, 7, 43, 48, 92, 55, 44, 0]


@pytest.mark.parametrize(("thing", "robust", "trimmed"), [("ball", 2.45, 2.37), ("bear", 6.3, 6.59)])
def test_photographed_objects_are_solved_as_well_as_by_l1(thing, robust, trimmed):
    images, lights, weights, truth = diligent(thing)
    assert error(Robust(), images, lights, weights, truth) <= robust
    assert error(RankTrim(shadow=0), images, lights, weights, truth) == pytest.approx(trimmed, abs=0.03)
    few = images[RIG], lights[RIG], weights[RIG], truth
    assert error(Robust(), *few) <= error(LeastSquares(), *few)
