"""The study of tolerance: its arithmetic on known surfaces, and what it must find."""

import csv
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.configurations import load_stand
from nlights_core.errors import NlightsError
from nlights_core.frames import PixelGrid
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import BLACK_LEVEL
from nlights_flows.commands import cli
from nlights_flows.tolerance import plots as tolerance_plots
from nlights_flows.tolerance import stand_errors
from nlights_flows.tolerance.stand_errors import (
    Sweep,
    along_axis,
    at_random,
    choose_sweep,
    of_strength,
    parse_errors,
    towards,
)
from nlights_flows.tolerance.study import (
    WITH,
    WITHOUT,
    Spread,
    compared_recipes,
    largest_within,
    plane_distances,
    spread,
    study,
    worst,
)

GRID = PixelGrid(60, 80, 6.25, (0.0, 0.0, 1542.0))


@pytest.fixture
def tile(painting):
    return load_capture(painting)[0]


@pytest.fixture(scope="module")
def along_z():
    """Without and with flat field, 1 to 100 mm, as small as it can be trusted."""
    return study("horizontal", along_axis((1.0, 10.0, 100.0), "z"), load_recipe("default"), width=96)


def summary(found, recipe):
    return {one.error: one for one in worst(found, recipe)}


# The arithmetic.


def test_a_range_is_spaced_evenly_on_a_logarithmic_scale():
    errors = np.array(parse_errors("0.1..100:13"))
    assert len(errors) == 13
    np.testing.assert_allclose(np.diff(np.log10(errors)), 3 / 12)
    assert len(parse_errors(".5..5e1")) == stand_errors.COUNT


def test_a_list_is_sorted_and_freed_of_doubles():
    assert parse_errors("5, 0.5,1,5") == (0.5, 1.0, 5.0)


@pytest.mark.parametrize(
    "text", ["", "0", "-1", "5..1", "0..10", "1..1", "1..10:1", "1..10:999", "1,,2", "1;2", "1..", "nan"]
)
def test_a_wrong_range_is_refused_in_a_sentence_that_says_what_is_right(text):
    with pytest.raises(NlightsError, match=r"^--errors: .*0\.1\.\.100") as fault:
        parse_errors(text)
    assert "\n" not in str(fault.value)


def test_the_distance_from_the_fitted_plane_ignores_a_tilt_and_measures_at_right_angles():
    # A tilted plane with steps of +-0.05 mm along its own normal, seen without perspective.
    grid = PixelGrid(60, 80, 6.25)
    slope = 0.5
    step = np.where(np.indices(grid.shape).sum(axis=0) % 2, 0.05, -0.05)
    height = slope * grid.x()[None, :] + step * np.hypot(1, slope)
    np.testing.assert_allclose(plane_distances(height, grid), step, atol=3e-4)


def test_perspective_leaves_a_tilted_plane_a_plane():
    # z = a x on the surface, and x = x0 (1 - z / Cz): solved for z.
    x0 = GRID.x()[None, :] + np.zeros(GRID.shape)
    height = 0.3 * x0 / (1 + 0.3 * x0 / 1542.0)
    assert np.abs(plane_distances(height, GRID)).max() < 1e-3


def test_unknown_heights_stay_unknown_and_do_not_spread():
    height = np.zeros(GRID.shape)
    height[3, 4] = np.nan
    found = plane_distances(height, GRID)
    assert np.isnan(found[3, 4])
    assert np.count_nonzero(np.isnan(found)) == 1


def test_a_spread_is_of_magnitudes_but_deviates_from_the_signed_mean():
    assert spread(np.array([-3.0, 3.0, np.nan])) == Spread(3.0, 3.0, 3.0)
    assert all(np.isnan([spread(np.array([np.nan])).mean, spread(np.array([np.nan])).greatest]))


def test_the_tolerated_error_of_a_power_law_is_exact():
    errors = np.geomspace(0.1, 100, 7)
    assert largest_within(errors, 0.02 * errors**1.5, 0.5) == pytest.approx(25 ** (1 / 1.5))


def test_the_tolerated_error_is_none_or_infinite_where_it_is_not_bracketed():
    assert largest_within([1, 10], [2.0, 3.0], 1.0) is None
    assert largest_within([1, 10], [0.2, 0.3], 1.0) == np.inf
    assert largest_within([1, 10], [0.2, np.nan], 1.0) == 1
    assert largest_within([1, 10], [np.nan, np.nan], 1.0) is None
    assert 1 < largest_within([1, 10], [0.0, 2.0], 1.0) < 10


# The errors.


@pytest.mark.parametrize(
    ("name", "axis", "expected"),
    [("horizontal", "z", (0, 0, 5)), ("vertical-open", "z", (0, -5, 0)), ("vertical-open", "-y", (0, 0, -5))],
)
def test_a_displacement_is_in_the_plane_frame_whatever_axes_the_stand_was_measured_in(
    tile, tmp_path, name, axis, expected
):
    stand = load_stand(name)
    sweep = along_axis((5.0,), axis)
    moved = sweep.disturb(tile.model_copy(update={"stand": stand}), 5.0, 0, tmp_path).stand
    for lamp, position in moved.lamps.items():
        np.testing.assert_allclose(np.subtract(position, stand.lamps[lamp]), expected, atol=1e-9)
    assert moved.camera == stand.camera


def test_random_displacements_have_the_stated_size_and_scale_with_it(tile, tmp_path):
    sweep = at_random((1.0, 5.0), 200, seed=3)

    def shift(error, draw):
        return sweep.disturb(tile, error, draw, tmp_path).stand.lamp_positions() - tile.stand.lamp_positions()

    assert np.std([shift(5.0, draw) for draw in range(200)]) == pytest.approx(5.0, rel=0.05)
    np.testing.assert_allclose(shift(5.0, 7), 5 * shift(1.0, 7), atol=1e-9)
    assert not np.allclose(shift(5.0, 0), shift(5.0, 1))


def test_table_20_is_the_shift_between_the_two_vertical_stands(tile, tmp_path):
    dark, light = load_stand("vertical-dark"), load_stand("vertical-open")
    sweep = towards(dark, light)
    # The mean of the Euclidean distances that the paper's Table 20 prints.
    printed = [18.9125, 4.6557, 15.8023, 16.4304, 7.4301, 0.9940, 7.5629, 5.5555]
    assert sweep.errors[-1] == pytest.approx(np.mean(printed), abs=1e-3)
    there = sweep.disturb(tile.model_copy(update={"stand": dark}), sweep.errors[-1], 0, tmp_path).stand
    np.testing.assert_allclose(there.lamp_positions(), light.lamp_positions(tuple(there.lamps)), atol=1e-9)
    np.testing.assert_allclose(there.camera_position, light.camera_position, atol=1e-9)


def test_changed_strengths_change_the_photographs_but_not_the_flats(tile, tmp_path):
    sweep = of_strength((0.05,), 1, seed=0)
    assert sweep.errors == (5.0,)
    changed = sweep.disturb(tile, 5.0, 0, tmp_path)
    assert changed.flats == tile.flats
    factors = []
    for lamp, path in tile.frames.items():
        before, after = (tifffile.imread(p).astype(float) - BLACK_LEVEL for p in (path, changed.frames[lamp]))
        factor = np.sum(after * before) / np.sum(before**2)
        assert np.abs(after - factor * before).max() <= 0.51
        factors.append(factor)
    assert 0.01 < np.std(factors) < 0.1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"axis": "w"}, "--axis: 'w' is no axis"),
        ({"axis": "x", "random": True}, "--axis and --random"),
        ({"strength": "2"}, "--strength: 2 is too much"),
        ({"strength": "a"}, "--strength: 'a'"),
        ({"strength": "0.01", "errors": "1"}, "--errors: --strength says itself"),
        ({"against": "horizontal"}, "are where those of"),
        ({"against": "vertical-open"}, "mm from those of 'horizontal'"),
        ({"stand": "diagonal"}, "diagonal"),
    ],
)
def test_options_that_make_no_sense_are_refused_in_a_sentence(options, words):
    given = {"stand": "horizontal", "axis": None, "errors": None, "random": False}
    given |= {"strength": None, "against": None, "draws": 1, "seed": 0}
    with pytest.raises(NlightsError, match=words):
        choose_sweep(**given | options)


def test_stands_with_other_lamps_cannot_be_compared():
    stand = load_stand("horizontal")
    other = stand.model_copy(update={"lamps": dict(list(stand.lamps.items())[1:])})
    with pytest.raises(NlightsError, match="other lamps"):
        towards(stand, other)


# The study.


def test_both_recipes_differ_in_the_flat_field_only():
    recipes = compared_recipes(load_recipe("default"))
    records = {name: recipe.record() for name, recipe in recipes.items()}
    assert records[WITH]["detrend"]["images"]["use"] == "flat-field"
    assert records[WITHOUT]["detrend"]["images"]["use"] == "inverse-square"
    assert records[WITHOUT]["light_model"]["emission"] is True
    for slot in ("normals", "integrator", "passes"):
        assert records[WITH][slot] == records[WITHOUT][slot]


def test_what_an_error_adds_grows_in_proportion_to_it(along_z):
    for recipe in (WITHOUT, WITH):
        found = summary(along_z, recipe)
        # Where nothing but the error's own noise is left, robust weights make it a little less straight.
        assert found[10].added_angle.mean == pytest.approx(10 * found[1].added_angle.mean, rel=0.3)
        assert found[10].added_distance.mean == pytest.approx(10 * found[1].added_distance.mean, rel=0.3)


def test_the_flat_field_keeps_a_plane_a_plane_however_wrong_the_lamps_are(along_z):
    # I / F is the same for all lamps on a plane, so that any positions give the upright normal.
    found = summary(along_z, WITH)
    assert found[100].added_angle.mean < 0.1
    # Of lamps that are so far off a calibration believes that some have drifted, which bends the height a little.
    assert found[100].distance.mean < 0.05
    assert summary(along_z, WITHOUT)[100].added_angle.mean > 1


def test_the_right_lamps_add_nothing(along_z):
    for recipe in (WITHOUT, WITH):
        right = summary(along_z, recipe)[0]
        assert right.added_angle == right.added_distance == Spread(0.0, 0.0, 0.0)


def test_lamps_within_5_mm_keep_the_promise_with_the_flat_field_on_a_relief():
    found = study("horizontal", at_random((5.0,), 2, 1), load_recipe("default"), scene="relief", width=96)
    after = summary(found, WITH)[5]
    assert after.angle.mean < 0.5
    assert after.distance.greatest < 1
    # Here, other than on a plane, positions do matter.
    assert after.added_angle.mean > 0.02


def test_an_error_that_sinks_a_lamp_is_passed_over_with_a_note():
    found = study("horizontal", along_axis((1.0, 200.0), "-z"), load_recipe("default"), width=40)
    assert sorted({one.error for one in found.measurements}) == [0.0, 1.0]
    (note,) = found.notes
    assert note.startswith("200 mm: passed over, because it puts Relio_3 at z = -36.7 mm")


def test_a_study_of_nothing_but_sunken_lamps_is_refused():
    with pytest.raises(NlightsError, match="no size of error is possible"):
        study("horizontal", along_axis((200.0,), "-z"), load_recipe("default"), width=40)


def test_the_same_study_writes_the_same_bytes(tmp_path):
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        found = study("horizontal", at_random((5.0, 20.0), 2, 4), load_recipe("default"), width=40)
        files.append([path.read_bytes() for path in tolerance_plots.write(found, tmp_path / name)])
    assert files[0] == files[1]


# What is shown.


def test_the_table_of_numbers_holds_every_draw(along_z, tmp_path):
    rows = list(csv.DictReader(tolerance_plots.as_csv(along_z).splitlines()))
    assert len(rows) == len(along_z.measurements) == 8
    one = next(row for row in rows if row["recipe"] == WITHOUT and float(row["error_mm"]) == 10)
    assert float(one["angle_mean_deg"]) == pytest.approx(summary(along_z, WITHOUT)[10].angle.mean, rel=1e-5)


def test_the_verdict_names_the_tolerated_error_or_says_that_there_is_none(along_z):
    sentences = list(tolerance_plots.describe_tolerance(along_z))
    assert len(sentences) == 4
    assert sentences[0].startswith("without flat field, in the mean: 0.5 degrees kept not even by the right")
    assert "up to 1" in sentences[1]
    assert "0.5 degrees kept at all errors (up to 100 mm)" in sentences[2]


def test_the_worst_of_the_draws_counts():
    sweep = Sweep("chance", "mm", (1.0,), at_random((1.0,), 3, 0).disturb, 3)
    found = study("horizontal", sweep, load_recipe("default"), width=40)
    draws = [one.angle.mean for one in found.measurements if one.recipe == WITHOUT and one.error]
    assert len(draws) == 3
    assert summary(found, WITHOUT)[1].angle.mean == max(draws)


def test_the_command_writes_its_files_and_prints_the_verdict(tmp_path, capsys):
    cli.app(
        ["tolerance", "vertical-dark", "--against", "vertical-open", "--width", "40", "--out", str(tmp_path)],
        standalone_mode=False,
    )
    assert sorted(path.name for path in Path(tmp_path).iterdir()) == [
        "tolerance.csv",
        "tolerance.png",
        "tolerance.svg",
    ]
    said = capsys.readouterr().out
    assert "mean displacement of the lamps towards vertical-open" in said
    assert "with flat field, in the mean: 0.5 degrees kept" in said
    assert str(Path(tmp_path) / "tolerance.svg") in said
