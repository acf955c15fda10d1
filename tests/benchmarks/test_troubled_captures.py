"""Troubled captures have the trouble that they are named by, and no other."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile
from troubled_captures import Trouble, changed_lamps, look, photograph, simulate_troubled

from nlights_core.configurations import load_stand
from nlights_core.manifest import load_capture
from nlights_core.simulation.captures import set_up
from nlights_core.simulation.surfaces import plane

STAND = load_stand("horizontal")
STILL = np.zeros(2)


def simulated(folder, trouble):
    simulate_troubled(folder, STAND, scene="drawing", width=64, seed=5, trouble=trouble)
    return folder


def test_without_a_trouble_photographs_are_those_of_the_simulator():
    studio = set_up(STAND, "relief", 80, False, 3)
    truth = studio.truth(0, studio.grid.rows)
    view = look(studio, STILL)
    lamps = changed_lamps(studio, Trouble(), 3)
    for lamp, (matt, _, _) in zip(lamps, studio.radiance(0, studio.grid.rows, truth), strict=True):
        taken = photograph(studio, lamp, view)
        np.testing.assert_allclose(taken.light, matt, rtol=2e-5)


def test_a_moved_photograph_shows_the_colours_so_many_pixels_to_the_right_and_down():
    drawing = set_up(STAND, "drawing", 80, False, 3)
    level = replace(drawing, scene=replace(drawing.scene, surface=plane()))
    white = replace(level, scene=replace(level.scene, albedo=lambda x, y: np.ones((*x.shape, 3))))
    lamp = changed_lamps(level, Trouble(), 3)[0]
    there, here, light = (
        photograph(studio, lamp, look(studio, np.array(shift))).light
        for studio, shift in ((level, (3, 2)), (level, (0, 0)), (white, (0, 0)))
    )
    np.testing.assert_allclose((there / light)[2:, 3:], (here / light)[:-2, :-3], rtol=1e-9)


def test_lamps_change_by_what_is_asked_and_the_artwork_stays_where_its_truth_is():
    studio = set_up(STAND, "plane", 40, False, 3)
    drifts, shifts = [], []
    for seed in range(100):
        lamps = changed_lamps(studio, Trouble(drift=0.02, moved_px=0.7), seed)
        drifts += [lamp.factor - 1 for lamp in lamps]
        shifts.append([lamp.shift_px for lamp in lamps])
    assert np.sqrt(np.mean(np.square(drifts))) == pytest.approx(0.02, rel=0.1)
    np.testing.assert_allclose(np.mean(shifts, axis=1), 0, atol=1e-12)
    assert 0.7 < np.abs(shifts).max() < 1.3
    aims = [lamp.group.axes for lamp in changed_lamps(studio, Trouble(aim_deg=0.5), 1)]
    for group, axes in zip(studio.groups, aims, strict=True):
        turned = np.degrees(np.arccos((group.axes * axes).sum(axis=1)))
        np.testing.assert_allclose(turned, 0.5, rtol=0.02)


def test_stray_light_lies_on_photographs_and_flats_but_not_on_the_dark_frame(tmp_path):
    # The gain differs between the two captures: the mean is held against the spread, which stray light leaves.
    def mean_over_spread(folder):
        dark = tifffile.imread(folder / "dark.tif").astype(float)
        assert dark.mean() == pytest.approx(256, abs=1)
        flats = np.stack([tifffile.imread(path) for path in sorted((folder / "flat").iterdir())]) - dark
        return flats.mean() / flats.std()

    sound = mean_over_spread(simulated(tmp_path / "sound", Trouble()))
    veiled = mean_over_spread(simulated(tmp_path / "veiled", Trouble(additive=0.03)))
    assert veiled / sound == pytest.approx(1.03, abs=0.001)


def test_gold_has_no_truth_and_a_missing_lamp_no_photograph(tmp_path):
    folder = simulated(tmp_path / "capture", Trouble(gilded=0.25, missing=True, averaged_stated=True))
    hidden = np.isnan(tifffile.imread(folder / "truth" / "height.tif"))
    assert 0.15 < hidden.mean() < 0.5
    np.testing.assert_array_equal(hidden, np.isnan(tifffile.imread(folder / "truth" / "normals.tif")).any(-1))
    tile = load_capture(folder)[0]
    assert len(tile.frames) == len(STAND.lamps) - 1
    assert tile.flats_averaged == 16
    assert tile.sensor is None


def test_exchanged_photographs_stand_under_each_others_names(tmp_path):
    sound, exchanged = (
        load_capture(simulated(tmp_path / name, trouble))[0]
        for name, trouble in (("sound", Trouble()), ("exchanged", Trouble(exchanged=True)))
    )

    def files(tile):
        return {lamp: path.name for lamp, path in tile.frames.items()}

    moved = [lamp for lamp, name in files(sound).items() if files(exchanged)[lamp] != name]
    assert len(moved) == 2
    assert files(exchanged)[moved[0]] == files(sound)[moved[1]]


def test_an_artwork_above_the_flats_is_so_in_its_truth_and_nowhere_else(tmp_path):
    low, high = (
        tifffile.imread(simulated(tmp_path / str(level), Trouble(level_mm=level)) / "truth" / "height.tif")
        for level in (0, 10)
    )
    # The camera sees a raised point a little further out on the artwork, so that heights are not shifted exactly.
    assert (high - low).mean() == pytest.approx(10, abs=0.01)
    flats = [tifffile.imread(tmp_path / name / "flat" / "light_1.tif") for name in ("0", "10")]
    ratio = (flats[0].astype(float) - 256) / (flats[1] - 256.0)
    assert ratio.std() / ratio.mean() < 0.01
