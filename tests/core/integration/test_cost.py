"""What an integration says before it starts and while it works, and where it ends in any case."""

import numpy as np
import pytest

from nlights_core.capture_warnings import gathered, read_warnings
from nlights_core.frames import PixelGrid
from nlights_core.integration import cost, masked_integration, weighted_integration
from nlights_core.integration.multigrid import solve_weighted, weighted_laplacian
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.integration.weighted_integration import weighted_height
from nlights_core.machine.progress import noting, telling


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def table(rng, rows=160, columns=220):
    """A relief with steep walls; beside it black background, whose normals are noise or unknown."""
    y, x = np.mgrid[:rows, :columns]
    radius = np.hypot(x - 0.4 * columns, y - 0.5 * rows)
    wall = np.where(np.abs(radius - 0.3 * rows) < 3, -8.0, 0.0)
    p, q = wall * (x - 0.4 * columns) / radius.clip(1), wall * (y - 0.5 * rows) / radius.clip(1)
    normals = np.stack([-p, q, np.ones_like(p)], axis=-1)
    black = radius > 0.3 * rows + 3
    normals[black] += rng.normal(0, 0.8, (int(black.sum()), 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[black & (rng.uniform(size=black.shape) < 0.4)] = np.nan
    confidence = np.where(black, 30 * rng.uniform(0.1, 3, black.shape), 0.3)
    return normals.astype(np.float32), PixelGrid(rows, columns, 0.1), confidence.astype(np.float32)


def meander(rng, rows=48, columns=301):
    """Rough normals seen through one corridor that goes to and fro, a pixel wide."""
    normals = np.full((rows, columns, 3), np.nan)
    normals[::2] = normals[1::4, -1] = normals[3::4, 0] = 0, 0, 1
    normals[..., :2] += rng.normal(0, 0.1, (rows, columns, 2))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals.astype(np.float32), PixelGrid(rows, columns, 1.0)


def test_progress_grows_while_weighted_steps_and_masks_are_solved(rng):
    normals, grid, confidence = table(rng)
    for work in (
        lambda: weighted_height(normals, grid, confidence),
        lambda: least_squares_height(normals, grid),
    ):
        told = []
        with telling(told.append):
            work()
        assert len(told) > 8
        assert told == sorted(told)
        assert 0 <= told[0] < 0.2 < 0.6 < told[-1] <= 1


def test_time_and_memory_are_said_before_the_first_iteration(rng, monkeypatch):
    monkeypatch.setattr(cost, "WORTH_SAYING", 0.0)
    normals, grid, confidence = table(rng)
    heard = []
    with noting(lambda sentence: heard.append(sentence)), telling(lambda share: heard.append(share)):
        weighted_height(normals, grid, confidence)
    assert heard[0].startswith("integrator: normals of very different certainty, 0.0352 megapixels: at most")
    assert heard[0].endswith("seconds and 0.0 GiB")
    assert all(isinstance(other, float) for other in heard[1:])


def test_the_bound_on_time_grows_with_pixels_and_falls_with_cores(monkeypatch):
    monkeypatch.setattr(cost, "cores", lambda: 1)
    alone = cost.expected_seconds(22_000_000, 0, 280)
    assert alone == pytest.approx(22 * 280 * cost.CYCLE)
    assert cost.expected_seconds(44_000_000, 0, 280) == pytest.approx(2 * alone)
    monkeypatch.setattr(cost, "cores", lambda: 4)
    assert alone / 4 < cost.expected_seconds(22_000_000, 0, 280) < alone


@pytest.mark.parametrize(("size", "said"), [(100, False), (22_000_000, True)])
def test_only_what_takes_long_is_announced(size, said, monkeypatch):
    monkeypatch.setenv("NLIGHTS_MEMORY", "100GiB")
    heard = []
    with noting(heard.append):
        cost.announce("a field", size, 64, 0, 280)
    assert bool(heard) == said
    assert all(sentence.endswith("minutes and 1.3 GiB") for sentence in heard)


def test_iterations_that_ran_out_are_told_and_kept_beside_the_height(rng, monkeypatch, tmp_path):
    monkeypatch.setattr(weighted_integration, "LAST_ITERATIONS", 2)
    normals, grid, confidence = table(rng)
    heard = []
    with noting(heard.append), gathered(tmp_path):
        height = weighted_height(normals, grid, confidence)
    assert np.isfinite(height[np.nan_to_num(normals[..., 2]) > 0]).all()
    (warning,) = read_warnings(tmp_path)
    assert (warning.code, heard) == ("height-unsettled", [warning.sentence])
    assert warning.value > weighted_integration.LAST_TOLERANCE
    assert "after 2 iterations" in warning.sentence
    assert "mask what is not the artwork" in warning.sentence


def test_a_labyrinth_ends_at_its_limit_and_says_so(rng, monkeypatch, tmp_path):
    monkeypatch.setattr(masked_integration, "LABYRINTH_ITERATIONS", 3)
    with gathered(tmp_path):
        height = least_squares_height(*meander(rng))
    (warning,) = read_warnings(tmp_path)
    assert warning.code == "height-unsettled"
    assert warning.value > masked_integration.SINGLE
    assert "after 3 iterations" in warning.sentence
    assert np.nanstd(height) > 0


def test_the_share_that_is_left_is_measured_against_the_whole(rng):
    weights = [rng.uniform(0.1, 9, shape).astype(np.float32) for shape in ((70, 89), (69, 90))]
    truth = rng.standard_normal((70, 90)).cumsum(axis=0).cumsum(axis=1)
    lefts = []
    for most in (1, 3, 50):
        height = np.zeros_like(truth)
        lefts.append(solve_weighted(height, weighted_laplacian(truth, *weights), weights, 1e-6, most))
    assert lefts[0] == pytest.approx(1, rel=1e-6)
    assert lefts[0] > lefts[1] > lefts[2]
    assert lefts[2] <= 1e-6
    assert np.std(height - truth) < 1e-4 * np.std(truth)
