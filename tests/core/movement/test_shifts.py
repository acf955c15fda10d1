"""Shifts of all photographs: found against movements that were made, and claimed of no sound capture."""

import json

import numpy as np
import pytest
from scipy.ndimage import shift

from nlights_core.fields import LightField
from nlights_core.movement.shifts import Shifts, find_shifts, read_shifts, warn_of_shifts, write_shifts
from nlights_core.photographs.shifted import Shift


def found_in(capture, lamps=None):
    tile = capture.tile
    field = LightField(tile.lamps, positions=tile.stand.lamp_positions())
    return find_shifts(tile, field, capture.folder / "scratch", lamps or tile.lamps)


def move_all(capture, largest, seed):
    """Move every photograph, as if the camera had moved; right and down, px, of mean 0."""
    moves = np.random.default_rng(seed).uniform(-largest, largest, (8, 2))
    moves -= moves.mean(axis=0)
    for n, (right, down) in enumerate(moves, 1):
        capture.change_frames(
            lambda light, by=(down, right, 0): shift(light, by[: light.ndim], order=5, mode="nearest"), n
        )
    return moves


def pairs(shifts):
    return np.array([one[:2] for one in shifts.shifts.values()])


@pytest.mark.parametrize(("scene", "largest", "within"), [("painting", 0.3, 0.015), ("drawing", 1.0, 0.015)])
def test_shifts_of_all_photographs_are_found(photographs, scene, largest, within):
    capture = photographs(scene)
    moves = move_all(capture, largest, 7)
    found = found_in(capture)
    assert found.believed
    assert not found.artwork
    np.testing.assert_allclose(pairs(found), moves, atol=within)
    (warning,) = warn_of_shifts(found, capture.tile)
    assert (warning.code, warning.unit, len(warning.lamps)) == ("moved", "px", 8)
    assert warning.value == pytest.approx(np.hypot(*moves.T).max(), abs=0.02)
    assert "camera was touched" in warning.sentence


@pytest.mark.parametrize("scene", ["painting", "drawing", "relief", "plane"])
def test_nothing_is_claimed_of_a_sound_capture(photographs, scene):
    capture = photographs(scene)
    found = found_in(capture)
    assert not found.believed
    assert warn_of_shifts(found, capture.tile) == []
    assert found.found is None or found.found < 0.15


def test_one_moved_photograph_leaves_the_others_where_they_are(photographs):
    capture = photographs("painting")
    capture.change_frames(
        lambda light: shift(light, (0.8, -1.6, 0)[: light.ndim], order=5, mode="nearest"), 3
    )
    found = pairs(found_in(capture))
    assert not np.delete(found, 2, axis=0).any()
    np.testing.assert_allclose(found[2], (-1.6, 0.8), atol=0.03)


def test_a_photograph_that_cannot_be_trusted_has_no_say_and_stays(photographs):
    capture = photographs("painting")
    moves = move_all(capture, 1.0, 3)
    lamps = [lamp for lamp in capture.tile.lamps if lamp != capture.tile.lamps[4]]
    found = found_in(capture, lamps)
    assert found.left == (capture.tile.lamps[4],)
    assert not pairs(found)[4].any()
    others = np.delete(moves, 4, axis=0)
    np.testing.assert_allclose(np.delete(pairs(found), 4, axis=0), others - others.mean(axis=0), atol=0.02)


def test_too_few_lamps_say_nothing(photographs):
    capture = photographs("painting")
    found = found_in(capture, capture.tile.lamps[:4])
    assert (found.believed, found.found, found.error) == (False, None, None)


def test_shifts_are_read_as_they_were_written(tmp_path):
    shifts = Shifts(
        {"a": Shift(0.25, -1.0, ((1.0, 2.0), (3.0, 0.0))), "b": Shift(0.0, 0.0)}, 1.03, 0.01, ("b",), True
    )
    write_shifts(tmp_path, shifts)
    assert read_shifts(tmp_path) == shifts
    json.loads((tmp_path / "shifts.json").read_text())
