"""A height is tied to heights that somebody measured, as far as they are surer, and to no more of them."""

import numpy as np
import pytest

from nlights_core.capture_warnings import gathered, read_warnings
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, KnownHeights
from nlights_core.frames import PixelGrid
from nlights_core.simulation.surfaces import bow, height_map, plane, wave
from nlights_plugins.known_heights import TiedToKnownHeights

GRID = PixelGrid(375, 500, 1.0)
RELIEF = wave(0.1, 9.0, angle_deg=30.0) + wave(0.05, 23.0, angle_deg=100.0)
BOW = bow(0.3, 500.0, 375.0)


def places(columns=5, rows=5, seed=0):
    """Places of a probe, nearly on a grid, over the whole field."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-225, 225, columns), np.linspace(-165, 165, rows))
    return x.ravel() + rng.normal(0, 8, x.size), y.ravel() + rng.normal(0, 6, y.size)


def measured(true, sigma, at=None, seed=0, stated=None, **more):
    x, y = places(seed=seed) if at is None else at
    z = true.height(x, y) + np.random.default_rng(seed + 100).normal(0, sigma, x.size)
    return KnownHeights(np.stack([x, y, z], axis=1), np.full(x.size, stated or sigma), **more)


class Told:
    """A trend, and what was warned of."""

    def __init__(self, folder, wrong, known, grid=GRID, height=None, **options):
        field = height_map(RELIEF + wrong, grid) if height is None else height
        with gathered(folder):
            self.trend = TiedToKnownHeights(**options).trend(HeightMap(field.height, grid, known))
        self.warnings = {warning.code: warning for warning in read_warnings(folder)}
        self.error = self.trend - height_map(wrong, grid).height
        self.error -= self.error.mean()


@pytest.fixture
def tied(tmp_path):
    return lambda *given, **named: Told(tmp_path, *given, **named)


@pytest.mark.parametrize("seed", range(4))
def test_a_bow_that_no_tile_can_tell_is_taken_out_by_25_points(tied, seed):
    told = tied(BOW, measured(RELIEF, 0.02, seed=seed))
    assert np.std(told.error) < 0.016  # nine terms of a parabola from 25 such points: 0.012
    assert np.abs(told.error).max() < 0.1  # in a corner, beyond the last point
    assert not set(told.warnings) - {"known-heights-outside"}


def test_a_true_bow_that_the_photographs_lost_is_put_back(tied):
    lost = bow(-0.3, 500.0, 375.0)
    field = height_map(RELIEF, GRID)
    told = tied(lost, measured(RELIEF + BOW, 0.02), height=field)
    assert np.std(told.error) < 0.016


def test_a_tilt_is_taken_from_the_known_heights_unless_their_frame_may_lean(tied):
    tilt = plane(0.002, -0.001)
    assert np.std(tied(BOW + tilt, measured(RELIEF, 0.02)).error) < 0.02
    leaning = measured(RELIEF + plane(0.01, 0.004), 0.02, tilted=True)
    told = tied(BOW, leaning)
    y, x = np.mgrid[-1 : 1 : GRID.rows * 1j, -1 : 1 : GRID.columns * 1j]
    terms = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    left = told.error.ravel()
    left = left - terms @ np.linalg.lstsq(terms, left)[0]
    assert np.std(left) < 0.016
    # The photographed tilt stays: what is removed has next to none of the frame's 5 mm.
    assert np.ptp(told.trend) < 0.6


@pytest.mark.parametrize("seed", range(4))
def test_points_that_are_less_sure_than_photographs_change_next_to_nothing(tied, seed):
    told = tied(plane(), measured(RELIEF, 0.5, seed=seed))
    assert np.std(told.error) < 0.06  # nine terms of a parabola from these points would be 0.3
    told = tied(plane(), measured(RELIEF, 0.5, seed=seed), bend_mm=0.01)
    assert np.std(told.error) < 0.06


def test_noisy_points_add_nothing_to_fine_relief(tied):
    told = tied(BOW, measured(RELIEF, 0.3, at=places(9, 7)))
    fine = told.trend - (np.roll(told.trend, 6, 1) + np.roll(told.trend, -6, 1)) / 2
    assert np.abs(fine[:, 6:-6]).max() < 2e-3


def test_good_points_leave_a_good_height_as_it_is(tied):
    for seed in range(3):
        assert np.std(tied(plane(), measured(RELIEF, 0.02, seed=seed)).error) < 0.013  # nine terms: 0.012


@pytest.mark.parametrize("odd", [{7: 1.0}, {0: 1.0}, {7: 0.15}, {7: 1.0, 8: 1.0, 20: -0.5}])
def test_odd_points_are_told_and_have_no_say(tied, odd):
    known = measured(RELIEF, 0.02)
    for i, off in odd.items():
        known.points[i, 2] += off
    told = tied(BOW, known)
    assert np.std(told.error) < 0.022
    warning = told.warnings["known-heights-odd"]
    assert f"{len(odd)} of 25" in warning.sentence
    assert f"({known.points[min(odd), 0]:.4g}," in warning.sentence
    assert warning.value == pytest.approx(max(map(abs, odd.values())), abs=0.1)


def test_sigmas_that_are_far_too_small_are_told(tied):
    told = tied(BOW, measured(RELIEF, 0.1, stated=0.02))
    assert told.warnings["known-heights-scatter"].value in (4.0, 8.0)
    assert np.std(told.error) < 0.07


def test_points_outside_the_field_are_told_and_the_others_used(tied):
    at = tuple(np.append(axis, far) for axis, far in zip(places(), ([260.0, 0.0], [0.0, 900.0]), strict=True))
    told = tied(BOW, measured(RELIEF, 0.02, at=at))
    warning = told.warnings["known-heights-outside"]
    assert "2 of 27" in warning.sentence
    assert "(260, 0), (0, 900)" in warning.sentence
    assert np.std(told.error) < 0.016


def test_a_part_of_the_field_without_points_is_told(tied):
    x, y = places(8, 8)
    left = x < 0
    told = tied(BOW, measured(RELIEF, 0.02, at=(x[left], y[left])))
    warning = told.warnings["known-heights-sparse"]
    assert "near x 249" in warning.sentence
    assert warning.value > 0.03


def test_a_scan_counts_by_cells_and_is_not_slower_for_it(tied):
    at = tuple(axis.ravel() for axis in np.meshgrid(np.linspace(-248, 248, 200), np.linspace(-185, 185, 150)))
    known = measured(RELIEF, 0.05, at=at)
    assert np.std(tied(BOW, known).error) < 0.01
    known.points[:300, 2] += 3.0  # two lines of the scan went wrong
    assert np.std(tied(BOW, known).error) < 0.02


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (places(2, 2), ["4 of 4 points", "at least 12"]),
        (tuple(axis + 2000 for axis in places()), ["0 of 25 points"]),
        (tuple(axis / 1000 for axis in places()), ["span 0.", "500 x 375 mm", "lengths are in mm"]),
        (tuple(axis * scale for axis, scale in zip(places(), (1, 0.05), strict=True)), ["a fifth of both"]),
    ],
)
def test_too_few_or_huddled_points_are_refused(tied, at, words):
    with pytest.raises(TileError) as fault:
        tied(BOW, measured(plane(), 0.02, at=at, source="probe.csv"))
    for word in ("probe.csv", *words):
        assert word in str(fault.value)


def test_points_of_another_artwork_are_refused(tied):
    with pytest.raises(TileError, match="agree neither with one another"):
        tied(BOW, measured(RELIEF, 3.0, stated=0.02))


def test_points_need_a_scale(tied):
    grid = PixelGrid(375, 500, 1.0, unit="px")
    with pytest.raises(TileError, match="scale of the photographs is not known"):
        tied(BOW, measured(RELIEF, 0.02), grid=grid)
