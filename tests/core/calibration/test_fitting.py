"""What all pixels of a tile share, found in photographs whose truth is known."""

import numpy as np
import pytest

from nlights_core.calibration.evidence import larger_covariance
from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.linearisation import residual_spread
from nlights_core.calibration.record import MISFIT, read_calibration, write_calibration
from nlights_core.errors import TileError

TILTING = np.array([0.9924, 0.9736, 1.0081, 1.0182, 1.004, 0.997, 1.002, 0.998])
"""A drift of 1.3 % rms that lies in the two patterns which look like a tilt."""


def drifted(factors):
    return lambda light, k: light * factors[k]


def level_error(scene):
    """Error of the level, mm, and its standard uncertainty."""
    found = scene.found
    return found.shared.level - scene.height.mean(), np.sqrt(found.covariance[0, 0])


def strength_errors(scene, factors):
    """Errors of the logarithms of the lamps' strengths; a factor of all is the albedo's."""
    apart = scene.found.shared.strengths - np.log(factors)
    return apart - apart.mean()


def test_in_a_sound_capture_nothing_is_believed_but_the_level(matt):
    _, scene = matt
    shared, (error, sigma) = scene.found.shared, level_error(scene)
    assert scene.found.believed == ("level",)
    # The level, and three coordinates of eight lamps.
    assert scene.found.covariance.shape == (25, 25)
    assert not shared.vector()[1:].any()
    assert abs(error) < 2 * sigma < 0.1
    assert scene.deviations.std() < 0.012
    assert scene.errors.residual < MISFIT
    assert not scene.found.strange.any()


@pytest.mark.parametrize("scene", ["relief", "plane"])
def test_other_sound_scenes_are_believed_to_be_sound(simulated, calibrated, scene):
    found = calibrated(simulated(scene, width=200, seed=7))
    error, sigma = level_error(found)
    assert found.found.believed == ("level",)
    assert abs(error) < 2.5 * sigma < 0.15
    assert found.deviations.std() < 0.012


@pytest.mark.parametrize("level", [5.0, -3.0])
def test_a_capture_that_was_raised_by_millimetres_is_found_where_it_is(simulated, calibrated, level):
    scene = calibrated(simulated(level=level))
    error, sigma = level_error(scene)
    assert scene.found.believed == ("level",)
    # Lamps are extended and the flat is smoothed: that is 1.5 % of a level.
    assert abs(error) < 2 * np.hypot(sigma, 0.015 * level)
    assert abs(error) < 0.1
    assert scene.deviations.std() < 0.03


CHANCE = 1 + np.random.default_rng(2).normal(0, 0.01, 8)


@pytest.mark.parametrize(
    ("artwork", "stand", "factors", "bend"),
    [("painting", "vertical-dark", TILTING, 0.035), ("relief", "horizontal", CHANCE, 0.05)],
)
def test_lamps_that_drifted_neither_tilt_nor_bend_the_height(
    simulated, calibrated, artwork, stand, factors, bend
):
    scene = calibrated(simulated(artwork, stand).change(drifted(factors), ""))
    assert scene.found.believed == ("level", "lamps")
    wide = np.sqrt(np.mean(scene.errors.height.astype(float) ** 2))
    assert scene.deviations.std() < min(bend, 2 * wide)
    np.testing.assert_allclose(strength_errors(scene, factors), 0, atol=2e-3)
    error, sigma = level_error(scene)
    assert abs(error) < 2.5 * sigma < 0.15


def test_one_lamp_that_was_replaced_is_found_as_it_is(simulated, calibrated):
    factors = np.where(np.arange(8) == 5, 1.15, 1.0)
    scene = calibrated(simulated(seed=5).change(drifted(factors), ""))
    assert scene.found.believed == ("level", "lamps")
    np.testing.assert_allclose(strength_errors(scene, factors), 0, atol=4e-3)
    assert scene.deviations.std() < 0.05
    wide = np.sqrt(np.mean(scene.errors.height.astype(float) ** 2))
    assert scene.deviations.std() < 2 * wide


def test_light_that_the_dark_frame_lacks_is_found(simulated, calibrated):
    capture = simulated()
    scene = calibrated(capture)
    mean = np.exp(scene.flat_field.logarithm).mean()
    added = 0.03 * mean * 65535
    scene = calibrated(capture.change(lambda light, _: light + added, "", "flat/"))
    share = added / 65535 / np.exp(scene.flat_field.logarithm).mean()
    assert scene.found.believed == ("level", "ambient")
    assert scene.found.shared.additive + scene.found.shared.room == pytest.approx(share, rel=0.05)
    assert scene.found.shared.additive == pytest.approx(share, rel=0.1)
    error, sigma = level_error(scene)
    assert abs(error) < 2.5 * sigma < 0.15
    assert scene.deviations.std() < 0.02


def test_rough_paint_departs_as_oren_and_nayar_say(simulated, calibrated, rough):
    scene = calibrated(simulated(paint=rough(0.5)))
    assert scene.found.believed == ("level", "departure")
    # B / A of their model.
    ratio = 0.45 * 0.25 / 0.34 / (1 - 0.5 * 0.25 / 0.58)
    assert scene.found.shared.departure == pytest.approx(ratio, rel=0.05)
    error, sigma = level_error(scene)
    assert abs(error) < 2.5 * sigma < 0.15
    assert scene.deviations.std() < 0.02


def test_satin_is_taken_for_gloss_and_neither_for_height_nor_for_drift(simulated, calibrated, satin):
    scene = calibrated(simulated(paint=satin(0.04, 0.5)))
    assert scene.found.believed == ("level", "gloss")
    # Between lobes the sum is what counts: 1 is a reflectance of 0.04.
    assert scene.found.shared.gloss.sum() == pytest.approx(1, abs=0.2)
    error, sigma = level_error(scene)
    assert abs(error) < 2.5 * sigma < 0.5
    assert scene.deviations.std() < 0.03


def test_a_glossy_flat_is_told_from_a_glossy_artwork(simulated, calibrated, satin):
    scene = calibrated(simulated(flat=satin(0.04, 0.35)))
    assert scene.found.believed == ("level", "flat-gloss")
    assert scene.found.shared.flat_gloss.sum() == pytest.approx(1, abs=0.2)
    assert not scene.found.shared.gloss.any()
    error, sigma = level_error(scene)
    assert abs(error) < 2.5 * sigma < 0.5
    assert scene.deviations.std() < 0.02


def test_a_group_that_is_not_sought_is_not_found(simulated, calibrated):
    capture = simulated(stand="vertical-dark", width=200).change(drifted(TILTING), "")
    scene = calibrated(capture, ("level", "gloss", "departure", "ambient", "flat-gloss"))
    assert "lamps" not in scene.found.believed
    assert not scene.found.shared.strengths.any()


def test_without_the_level_a_raised_capture_stays_in_the_plane_of_the_flat(simulated, calibrated):
    scene = calibrated(simulated("plane", level=1.0, width=160), ())
    assert scene.found.believed == ()
    assert scene.found.shared.level == 0
    assert not scene.found.covariance[0].any()  # of the level
    assert scene.found.height.mean() == pytest.approx(0, abs=1e-4)


def test_patches_of_another_material_have_no_say(simulated, calibrated):
    """Gold mirrors some lamps and not others: it must not tell of the paint about it."""
    mirrored = [0.3, 1.5, 0.5, 1.3, 0.4, 1.6, 0.7, 1.2]
    capture = simulated()
    rows, columns = capture.height.shape
    patch = np.s_[rows // 4 : rows // 2, columns // 4 : columns // 2]

    def gild(light, k):
        light[patch] *= mirrored[k]
        return light

    scene = calibrated(capture.change(gild, ""))
    outside = np.ones(scene.found.strange.shape, bool)
    outside[patch] = False
    assert scene.found.strange[patch].mean() > 0.9
    assert scene.found.strange[outside].mean() < 0.02
    assert scene.found.believed == ("level",)
    error, sigma = level_error(scene)
    assert abs(error) < 3 * sigma < 0.2


def test_a_tile_of_one_colour_under_much_noise_has_a_right_level_or_none(simulated, calibrated, tmp_path):
    random = np.random.default_rng(5)
    capture = simulated("plane", "vertical-dark").change(
        lambda light, _: light + random.normal(0, 1500, light.shape), ""
    )
    scene = calibrated(capture)
    write_calibration(tmp_path, scene.found, scene.errors, 0.0, None, None)
    stated = read_calibration(tmp_path).level_uncertainty
    assert stated is None or abs(level_error(scene)[0]) < 2.5 * stated


def test_lamps_five_millimetres_off_hardly_move_the_level_and_are_not_taken_for_drift(matt):
    _, scene = matt
    for seed in range(2):
        moved = scene.lights.positions + np.random.default_rng(seed).normal(0, 5, (8, 3))
        lights = type(scene.lights)(scene.lights.lamps, positions=moved)
        found = calibrate(scene.room, lights, scene.flat_field, ("level", "lamps", "gloss"))
        assert found.shared.level == pytest.approx(scene.height.mean(), abs=0.3)
        np.testing.assert_allclose(found.shared.strengths, 0, atol=2e-3)


def test_a_tile_that_is_nowhere_lit_by_three_lamps_is_refused(matt):
    _, scene = matt
    saved = scene.room.saturated.copy()
    try:
        scene.room.saturated[2:] = True
        with pytest.raises(TileError, match=r"calibration: not a single block has three usable lights"):
            calibrate(scene.room, scene.lights, scene.flat_field, ("level",))
    finally:
        scene.room.saturated[:] = saved


def test_what_is_not_known_of_a_field_does_not_keep_its_level_from_being_found(matt):
    _, scene = matt
    saved = scene.room.inside.copy()
    try:
        scene.room.inside[:, :80] = False
        found = calibrate(scene.room, scene.lights, scene.flat_field, ("level", "lamps", "gloss"))
    finally:
        scene.room.inside[:] = saved
    assert found.believed == ("level",)
    right = scene.height[:, 80:].mean()
    assert found.height[:, 80:].mean() == pytest.approx(right, abs=0.15)


def test_the_same_photographs_give_the_same_bits(matt):
    _, scene = matt
    again = calibrate(
        scene.room, scene.lights, scene.flat_field,
        ("level", "lamps", "gloss", "departure", "ambient", "flat-gloss"), 0.77,
    )  # fmt: skip
    np.testing.assert_array_equal(again.shared.vector(), scene.found.shared.vector())
    np.testing.assert_array_equal(again.height, scene.found.height)


def test_a_covariance_is_no_smaller_than_either_of_two():
    random = np.random.default_rng(0)
    one, other = (a @ a.T + 0.1 * np.eye(5) for a in random.normal(size=(2, 5, 5)))
    larger = larger_covariance(one, other)
    for part in (one, other):
        assert np.linalg.eigvalsh(larger - part).min() > -1e-9
    np.testing.assert_allclose(larger_covariance(one, 0.5 * one), one)
    np.testing.assert_allclose(larger_covariance(one, 3 * one), 3 * one)


def test_the_spread_of_residuals_makes_up_for_what_normals_took():
    random = np.random.default_rng(1)
    around = np.arange(8) * np.pi / 4
    design = np.stack([np.cos(around), np.sin(around), np.ones(8)], axis=1)
    noise = random.normal(0, 2.5, (4000, 8))
    left = noise - noise @ (design @ np.linalg.pinv(design)).T
    assert residual_spread(left, np.ones((4000, 8))) == pytest.approx(2.5, rel=0.03)
    assert residual_spread(left, np.zeros((4000, 8))) == 1
