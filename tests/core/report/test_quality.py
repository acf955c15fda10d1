"""Numbers of surfaces whose truth is analytic."""

import tracemalloc

import numpy as np
import pytest

from nlights_core.files import reduction
from nlights_core.frames import PixelGrid
from nlights_core.report import map_statistics
from nlights_core.report.agreement_quality import of_agreement
from nlights_core.report.figures import Number, figure_of
from nlights_core.report.map_statistics import (
    bias_angle,
    extremes,
    inclination,
    misclosure,
    relief,
    unevenness,
)
from nlights_core.report.quality import measure
from nlights_core.solving.agreement import Agreement

GRID = PixelGrid(60, 80, 0.5)


def normals_of(p, q):
    """Unit normals of slopes dz/dx and dz/dy (y up)."""
    n = np.stack([-p, -q, np.ones_like(p)], axis=-1)
    return (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


def plane(a=0.02, b=-0.01):
    x, y = np.meshgrid(GRID.x(), GRID.y())
    height = (a * x + b * y + 5).astype(np.float32)
    return height, normals_of(np.full(GRID.shape, a), np.full(GRID.shape, b))


def value(numbers, name):
    found = [number for number in numbers if number.name == name]
    assert len(found) == 1
    return found[0].value


def test_a_tilted_plane_has_the_tilt_slope_and_range_that_it_was_given():
    height, normals = plane()
    numbers = measure({"height": height, "normals": normals}, GRID)
    angle = np.degrees(np.arctan(np.hypot(0.02, 0.01)))
    assert value(numbers, "Tilt of the best plane") == pytest.approx(angle, rel=1e-4)
    assert value(numbers, "Mean slope") == pytest.approx(angle, rel=1e-4)
    low, high = np.percentile(height, [0.1, 99.9])
    assert value(numbers, "Height range") == pytest.approx(high - low, rel=1e-5)
    assert value(numbers, "Height, rms") == pytest.approx(height.astype(float).std(), rel=1e-4)
    assert value(numbers, "Misclosure of the slopes, rms") == pytest.approx(0, abs=1e-4)


def test_the_best_plane_ignores_what_is_not_known():
    height, _ = plane()
    height[10:30, 5:40] = np.nan
    height[:, -1] = np.nan
    found = relief(height, GRID, level=4.5)
    assert found.plane == pytest.approx((0.02, -0.01, 5), rel=1e-4)
    assert found.rms == pytest.approx(np.nanstd(height.astype(float)), rel=1e-6)


def test_three_points_on_a_line_have_no_plane():
    height = np.full(GRID.shape, np.nan, np.float32)
    height[7, [3, 8, 20]] = 1
    assert relief(height, GRID).plane is None


def test_the_slopes_of_a_bowl_close_and_a_whirl_does_not():
    x, y = np.meshgrid(GRID.x(), GRID.y())
    bowl = misclosure(normals_of(0.004 * x, 0.006 * y), GRID)
    assert bowl == pytest.approx(0, abs=1e-8)
    # p = -w y, q = w x has the curl 2 w everywhere: 2 w s^2 round a pixel of side s.
    whirl = misclosure(normals_of(-0.004 * y, 0.004 * x), GRID)
    assert whirl == pytest.approx(2 * 0.004 * 0.5**2, rel=1e-4)


def test_misclosure_is_shown_in_micrometres_or_pixels():
    x, y = np.meshgrid(GRID.x(), GRID.y())
    whirl = {"normals": normals_of(-0.004 * y, 0.004 * x)}
    in_mm = next(n for n in measure(whirl, GRID) if n.name.startswith("Misclosure"))
    assert (in_mm.value, in_mm.unit) == (pytest.approx(2.0, rel=1e-4), "µm")
    unscaled = PixelGrid(60, 80, 1, unit="px")
    in_px = next(n for n in measure(whirl, unscaled) if n.name.startswith("Misclosure"))
    assert (in_px.value, in_px.unit) == (pytest.approx(0.004, rel=1e-4), "px")


@pytest.mark.parametrize("spread", [0.001, 0.3, 3.0])
def test_the_mean_slope_is_that_of_the_angles_themselves(spread):
    rng = np.random.default_rng(1)
    n = rng.normal([0, 0, 1], spread, (40, 50, 3))
    n[rng.random((40, 50)) < 0.2] = np.nan
    angles = np.degrees(np.arctan2(np.hypot(n[..., 0], n[..., 1]), n[..., 2]))
    share, mean = inclination(n.astype(np.float32))
    assert share == np.isfinite(angles).mean()
    assert mean == pytest.approx(np.nanmean(angles), rel=1e-6)


def test_shares_count_pixels():
    normals = plane()[1]
    normals[:15] = np.nan
    used = np.full(GRID.shape, 8, np.uint8)
    used[:30] = 5
    saturated = np.zeros(GRID.shape, np.uint8)
    saturated[:6] = 3
    flat_field = np.ones((8, 3, 4, 1), np.float32)
    numbers = measure(
        {"normals": normals, "used": used, "saturated": saturated, "flat_field": flat_field}, GRID
    )
    assert value(numbers, "Known share") == pytest.approx(75)
    assert value(numbers, "Lights used, mean") == pytest.approx(6.5)
    assert value(numbers, "Pixels with all 8 lights") == pytest.approx(50)
    assert value(numbers, "Saturated") == pytest.approx(10)


def test_shares_under_a_mask_count_what_is_inside():
    normals = np.full((*GRID.shape, 3), np.nan, np.float32)
    used, saturated, shadow = np.zeros((3, *GRID.shape), np.uint8)
    inside = (slice(10, 30), slice(20, 60))  # 800 pixels, of which 40 are not known
    normals[inside] = (0, 0, 1)
    normals[10, 20:60] = np.nan
    used[inside] = 8
    used[10, 20:60] = 2
    saturated[11:13, 20:60] = 1
    shadow[13, 20:60] = 2
    maps = {"normals": normals, "used": used, "saturated": saturated, "shadow": shadow}
    numbers = measure(maps | {"flat_field": np.ones((8, 3, 4, 1), np.float32)}, GRID, inside=800)
    assert value(numbers, "Known share") == pytest.approx(95)
    assert value(numbers, "Lights used, mean") == pytest.approx(8 * 0.95 + 2 * 0.05)
    assert value(numbers, "Pixels with all 8 lights") == pytest.approx(95)
    assert value(numbers, "Saturated") == pytest.approx(10)
    assert value(numbers, "In shadow") == pytest.approx(5)


def test_residual_and_albedo_average_what_is_known():
    residual = np.full(GRID.shape, 0.01, np.float32)
    residual[0] = np.nan
    residual[1] = 0.6
    albedo = np.full((*GRID.shape, 3), 0.25, np.float32)
    albedo[..., 1] = 0.55
    albedo[5] = np.nan
    numbers = measure({"residual": residual, "albedo": albedo}, GRID)
    assert value(numbers, "Residual, median") == pytest.approx(1, rel=1e-5)
    assert value(numbers, "Residual, mean") == pytest.approx((58 * 1 + 60) / 59, rel=1e-5)
    assert value(numbers, "Albedo, mean") == pytest.approx(0.35, rel=1e-5)


def test_what_was_removed_is_stated_with_its_amplitude():
    flat_field = np.ones((2, 3, 4, 1), np.float32)
    flat_field[0, 0, 0], flat_field[1, 1, 1], flat_field[1, 2, 2] = 3, 0.5, np.nan
    trend = np.zeros(GRID.shape, np.float32)
    trend[3, 4], trend[50, 2] = -0.25, 0.5
    bias = np.zeros((*GRID.shape, 3), np.float32)
    bias[9, 9] = [np.sin(np.radians(2)), 0, np.cos(np.radians(2)) - 1]
    numbers = measure({"flat_field": flat_field, "trend": trend, "bias": bias}, GRID)
    assert value(numbers, "Uneven light, lamp 1 of 2") == pytest.approx(3)
    assert value(numbers, "Uneven light, lamp 2 of 2") == pytest.approx(2)
    named = measure({"flat_field": flat_field}, GRID, ("Relio_1", "Relio_2"))
    assert value(named, "Uneven light, Relio_2") == pytest.approx(2)
    assert value(numbers, "Trend of the height, peak to valley") == pytest.approx(0.75)
    assert value(numbers, "Bias of the normals, largest") == pytest.approx(2, rel=1e-3)


def test_what_was_not_measured_has_no_value_rather_than_a_good_one():
    for number in measure({}, GRID):
        assert number.value is None, number.name
        assert all((number.unit, number.meaning, number.group))


def test_a_step_that_the_recipe_lacks_is_told_from_one_that_found_nothing():
    nothing = {
        "flat_field": np.full((1, 3, 4, 1), np.nan, np.float32),
        "trend": np.full(GRID.shape, np.nan, np.float32),
        "bias": np.full((*GRID.shape, 3), np.nan, np.float32),
    }
    for maps, said in (({}, "not in this recipe"), (nothing, "not measured")):
        removed = [n for n in measure(maps, GRID) if n.group == "Removed"]
        assert [(n.value, n.missing) for n in removed] == [(None, said)] * 3
    assert Number("Light", "Glow", None, "%", "Nothing.").missing == "not measured"


@pytest.mark.parametrize(
    ("number", "unit", "text"),
    [
        (0.000420, "°", "< 0.01"),
        (-0.000420, "mm", "> \N{MINUS SIGN}0.001"),
        (0.000800, "%", "< 0.01"),
        (0.0294, "mm", "0.029"),
        (99.9999, "% of pixels", "> 99.9"),
        (99.94, "% of pixels", "99.9"),
        (1.7679, "°", "1.77"),
        (0.000420, "", "0.000420"),
    ],
)
def test_no_digit_is_shown_that_means_nothing(number, unit, text):
    assert figure_of(number, unit) == text


def test_a_flat_field_is_as_uneven_as_the_mean_of_its_colours():
    reading = np.array([[[1.0, 3.0], [4.0, 8.0], [np.nan, 100.0], [0.0, 0.0]]])
    assert unevenness(reading) == pytest.approx(3)
    assert unevenness(np.zeros((2, 2, 3))) is None


def test_maps_without_a_known_pixel_give_no_numbers():
    nothing = np.full(GRID.shape, np.nan, np.float32)
    maps = {
        "height": nothing,
        "normals": np.full((*GRID.shape, 3), np.nan, np.float32),
        "residual": nothing,
        "albedo": nothing[..., None],
    }
    numbers = measure(maps, GRID)
    assert value(numbers, "Known share") == 0
    assert {n.value for n in numbers if n.name != "Known share"} == {None}


def test_a_bias_of_opposite_normals_is_half_a_turn():
    assert bias_angle(np.array([[0.0, 0.0, -2.0]])) == pytest.approx(180)


def test_extremes_pass_over_what_is_not_known():
    assert extremes(np.array([[np.nan, 2.0], [-3.0, np.nan]])) == (-3.0, 2.0)
    assert extremes(np.array([[np.nan]])) is None


def test_numbers_do_not_depend_on_how_the_bands_fall(monkeypatch):
    rng = np.random.default_rng(0)
    height = rng.normal(size=GRID.shape).astype(np.float32)
    height[20:25, 30:] = np.nan
    normals = normals_of(rng.normal(0, 0.1, GRID.shape), rng.normal(0, 0.1, GRID.shape))
    maps = {"height": height, "normals": normals, "used": np.full(GRID.shape, 4, np.uint8)}
    whole = [n.value for n in measure(maps, GRID)]
    monkeypatch.setattr(reduction, "BAND_BYTES", 1)
    by_rows = [n.value for n in measure(maps, GRID)]
    for one, other in zip(whole, by_rows, strict=True):
        assert other == (None if one is None else pytest.approx(one, rel=1e-6))


def test_memory_follows_the_band_not_the_image(tmp_path, monkeypatch):
    monkeypatch.setattr(reduction, "BAND_BYTES", 1 << 20)
    monkeypatch.setattr(map_statistics, "SAMPLE", 100_000)
    grid = PixelGrid(2000, 1500, 0.1)
    normals = np.memmap(tmp_path / "n", np.float32, "w+", shape=(*grid.shape, 3))  # 36 MB
    normals[..., 2] = 1
    height = np.memmap(tmp_path / "z", np.float32, "w+", shape=grid.shape)
    tracemalloc.start()
    measure({"normals": normals, "height": height, "albedo": normals, "bias": normals}, grid)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 << 20


@pytest.mark.parametrize(
    ("surprise", "typical", "refined", "words"),
    [
        (1.0, (0.01, 0.02, 0.01), False, []),
        (2.9, (0.1, 0.19, 0.1), False, []),
        (10.5, (0.1, 0.1, 0.1), False, ["10.5 times the photographs' noise", "Try refine: true"]),
        (10.5, (0.1, 0.1, 0.1), True, ["10.5 times", "Try another light_model"]),
        (2.0, (0.1, 0.41, None), True, ["photographed under b:", "41 % of the albedo"]),
        (None, (None, None, None), False, []),
    ],
)
def test_photographs_that_do_not_fit_the_lamps_are_told_with_what_to_try(surprise, typical, refined, words):
    # The rms of a glossy surface is large where nothing is wrong: it decides nothing.
    agreement = Agreement(surprise, (0.9, 0.9, 0.9), typical)
    numbers = of_agreement(agreement, ("a", "b", "c"), refined)
    said = "".join(number.warning for number in numbers)
    assert bool(said) == bool(words)
    for word in words:
        assert word in said
    assert ("refine: true" in said) == (bool(words) and not refined)
