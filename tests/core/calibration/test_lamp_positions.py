"""Lamps that stand elsewhere than the stand's file says are neither taken for drift nor forgotten."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.lamp_positions import fit_with_positions
from nlights_core.calibration.linearisation import CELL, coarse_grid
from nlights_core.calibration.uncertainty import SHARE, block_means, smooth_errors
from nlights_core.calibration.unknowns import nothing
from nlights_core.simulation import captures

DRIFT = np.array([1.02, 0.975, 0.99, 1.025, 1.01, 0.99, 1.0, 0.985])


@pytest.fixture(scope="module")
def drifted(simulated, calibrated):
    """A painting whose lamps have changed by 2 %, and stand 2 mm from where they are said to stand."""
    capture = simulated(width=300, seed=21).change(lambda light, k: light * DRIFT[k], "")
    scene = calibrated(capture)
    shift = np.random.default_rng(8).normal(0, 2, scene.lights.positions.shape)
    return replace(scene, lights=replace(scene.lights, positions=scene.lights.positions + shift))


def bend(scene, positions):
    """Error of the coarse height, mm, and what is stated of it, each on blocks."""
    found = calibrate(scene.room, scene.lights, scene.flat_field, ("level", "lamps"), positions)
    apart = block_means(found.height - scene.height, CELL, coarse_grid(scene.room.grid))
    assert "lamps" in found.believed
    return apart - apart.mean(), smooth_errors(found, scene.lights, scene.room.grid).height


def test_wrong_positions_are_not_taken_for_drift_where_they_are_known_to_be_uncertain(drifted):
    blind, _ = bend(drifted, None)
    told, stated = bend(drifted, 2.0)
    assert np.std(blind) > 0.06
    assert np.std(told) < 0.4 * np.std(blind)
    assert np.std(told) < 2 * np.sqrt(np.mean(stated**2))


def test_wrong_positions_bend_the_height_as_their_bends_say(matt):
    scene = matt[1]
    shift = np.random.default_rng(3).normal(0, 1.5, scene.lights.positions.shape)
    lights = replace(scene.lights, positions=scene.lights.positions + shift)
    # Nothing is fitted, so that the positions' own part is all there is.
    there = calibrate(scene.room, lights, scene.flat_field, (), 1.0)
    here = calibrate(scene.room, scene.lights, scene.flat_field, (), 1.0)
    # To solve with shifted positions is what happens where the true ones are shifted the other way.
    expected = np.tensordot(shift.ravel(), here.equations.bends[-shift.size :], 1)
    expected -= expected.mean()
    apart = block_means(there.height - here.height, CELL, coarse_grid(scene.room.grid))
    apart -= apart.mean()
    assert np.std(expected) > 0.002
    assert np.std(apart - expected) < 0.3 * np.std(expected)


def test_an_unknown_position_makes_the_height_less_certain(matt):
    scene = matt[1]
    plain, wide, wider = (
        smooth_errors(
            calibrate(scene.room, scene.lights, scene.flat_field, ("level",), positions),
            scene.lights,
            scene.room.grid,
        )
        for positions in (None, 1.0, 4.0)
    )
    assert (wide.height > plain.height).all()
    assert np.median(wider.height / wide.height) > 2
    assert (wide.slope > plain.slope).all()


def test_light_that_wanders_about_a_lamp_makes_the_height_less_certain(matt):
    scene = matt[1]
    found = calibrate(scene.room, scene.lights, scene.flat_field, ("level",), 1.0)
    plain, wandering = (smooth_errors(found, scene.lights, scene.room.grid, w) for w in (0.0, 3.0))
    bends = found.equations.bends[-3 * len(scene.lights.lamps) :]
    # Each coordinate wanders by itself.
    more = (SHARE * 3) ** 2 * np.sum(bends**2, axis=0)
    assert wandering.height**2 - plain.height**2 == pytest.approx(more, rel=1e-3)
    assert (wandering.slope > plain.slope).all()


def test_a_highlight_that_moves_with_its_lamp_is_not_taken_for_drift(simulated, calibrated, monkeypatch):
    # The group's light is half a millimetre from its middle; without noise that tells in a sharp highlight.
    monkeypatch.setattr(captures, "FULL_WELL", 2e6)
    scene = calibrated(simulated(stand="vertical-dark", varnish=True, width=300, seed=33))
    strengths = scene.found.shared.strengths
    assert np.ptp(strengths) < 0.001
    assert np.std(scene.deviations) < 0.08
    assert np.std(scene.deviations) < 1.5 * np.sqrt(np.mean(scene.errors.height**2))


def test_lamps_far_from_the_stands_file_are_found_and_their_distance_counts(matt):
    scene = matt[1]
    shift = np.random.default_rng(5).normal(0, 5, scene.lights.positions.shape)
    off = replace(scene.lights, positions=scene.lights.positions + shift)
    there, here = (
        calibrate(scene.room, lights, scene.flat_field, ("level", "lamps"), 0.77)
        for lights in (off, scene.lights)
    )
    assert here.positions is None
    # Of the lamps' distances a part is told by texture, and the rest is taken to be like it.
    assert 0.5 * np.std(shift) < there.positions < 1.5 * np.std(shift)
    wide, narrow = (smooth_errors(found, scene.lights, scene.room.grid).height for found in (there, here))
    assert np.median(wide) > 1.3 * np.median(narrow)
    apart = block_means(there.height - scene.height, CELL, coarse_grid(scene.room.grid))
    # One draw of 24 coordinates, of which a few patterns bend the height.
    assert np.std(apart) < 3 * np.sqrt(np.mean(wide**2))


@pytest.mark.parametrize(
    ("scatter", "contrast", "told"),
    [(1.0, 1.0, False), (6.0, 1.0, True), (3.0, 0.05, False)],  # the last has 28 nats, and 2 as `INDEPENDENT`
)
def test_the_width_of_positions_is_told_by_linear_equations_of_it(scatter, contrast, told):
    """Equations of a level and 24 coordinates, of which the truth is known."""
    rng = np.random.default_rng(11)
    design = rng.normal(size=(400, 25)) * np.array([1.0, *[contrast] * 24])
    truth = np.concatenate([[0.3], rng.normal(0, scatter, 24)])
    equations = SimpleNamespace(
        matrix=design.T @ design, right=design.T @ (design @ truth + rng.normal(size=400)), scatter=np.eye(25)
    )
    found = fit_with_positions(equations, nothing(8), np.array([0]), (0,), 1.0)
    assert found.values[0] == pytest.approx(0.3, abs=0.2)
    assert found.uncertainty == (pytest.approx(np.sqrt(np.mean(truth[1:] ** 2)), rel=0.05) if told else 1.0)
    assert np.diag(found.covariance)[1:] == pytest.approx(found.uncertainty**2)
