"""Lamps that stand elsewhere than the stand's file says are neither taken for drift nor forgotten."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.linearisation import CELL, coarse_grid
from nlights_core.calibration.uncertainty import block_means, smooth_errors

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
