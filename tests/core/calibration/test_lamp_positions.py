"""Lamps that stand elsewhere than the stand's file says bend the height as is stated."""

from dataclasses import replace

import numpy as np

from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.linearisation import CELL, coarse_grid
from nlights_core.calibration.uncertainty import block_means, smooth_errors


def test_wrong_positions_bend_the_height_as_their_bends_say(matt):
    scene = matt[1]
    shift = np.random.default_rng(3).normal(0, 1.5, scene.lights.positions.shape)
    lights = replace(scene.lights, positions=scene.lights.positions + shift)
    there = calibrate(scene.room, lights, scene.flat_field, ("level",))
    here = calibrate(scene.room, scene.lights, scene.flat_field, ("level",))
    grid = scene.room.grid
    # To solve with shifted positions is what happens where the true ones are shifted the other way.
    expected = -np.tensordot(shift.ravel(), here.by_positions, 1)
    expected -= expected.mean()
    apart = block_means(there.height - here.height, CELL, coarse_grid(grid))
    apart -= apart.mean()
    assert np.std(expected) > 0.002
    assert np.std(apart - expected) < 0.3 * np.std(expected)


def test_an_unknown_position_makes_the_height_less_certain(matt):
    scene = matt[1]
    plain, wide, wider = (
        smooth_errors(scene.found, scene.lights, scene.room.grid, positions) for positions in (None, 1.0, 2.0)
    )
    added, doubled = (one.height**2 - plain.height**2 for one in (wide, wider))
    np.testing.assert_allclose(doubled, 4 * added, rtol=0.01, atol=1e-9)
    np.testing.assert_allclose(added, np.sum(scene.found.by_positions**2, axis=0), rtol=0.01, atol=1e-9)
    assert (wide.slope > plain.slope).all()
