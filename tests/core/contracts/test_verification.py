"""What a plugin returns is verified before it spreads, and the sentence names who is at fault."""

from typing import ClassVar

import numpy as np
import pytest

from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.contracts.verification import (
    checked_array,
    checked_flat_field,
    checked_height,
    checked_solution,
)
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap
from nlights_core.frames import PixelGrid
from nlights_plugins.integrators import Simchony
from nlights_plugins.least_squares import LeastSquares

SHAPE = (4, 2, 3)


class Slip(NormalSolver):
    """A solver that is never asked."""

    name: ClassVar[str] = "slip"

    def solve(self, images, lights, weights):
        raise AssertionError


def solution(**changes) -> Solution:
    normals = np.zeros((2, 3, 3), np.float32)
    normals[..., 2] = 1
    plain = Solution(
        normals, np.ones((2, 3), np.float32), np.ones((2, 3), np.float32), np.ones(SHAPE, np.float32)
    )
    return plain._replace(**changes)


def test_what_keeps_the_contract_passes_and_unknown_counts_for_nothing():
    broken = solution(weights=np.full(SHAPE, np.nan, np.float32))
    found = checked_solution(LeastSquares(), broken, SHAPE)
    np.testing.assert_array_equal(found.weights, 0)
    normals = solution().normals.copy()
    normals[0, 0] = np.nan
    partly = checked_solution(LeastSquares(), solution(normals=normals), SHAPE)
    assert np.isnan(partly.normals[0, 0]).all()
    assert np.isnan(partly.confidence[0, 0])


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "should return a Solution; got NoneType"),
        (solution(normals=3 * solution().normals), "unit normals; got a length of 3"),
        (solution(normals=solution().normals[:1]), r"normals of shape \(2, 3, 3\); got \(1, 3, 3\)"),
        (solution(albedo=np.ones((2, 3), int)), "array of float32; got int64"),
        (solution(weights=np.ones((3, 2, 3), np.float32)), r"weights of shape \(4, 2, 3\)"),
        (solution(confidence=0.5), "confidence as an array"),
        (solution(confidence=-solution().confidence), "angle in degrees; got a negative one"),
    ],
)
def test_a_solver_that_breaks_its_contract_is_named(value, words):
    with pytest.raises(TileError, match=words) as fault:
        checked_solution(Slip(), value, SHAPE)
    assert "normals: slip (not installed)" in str(fault.value)
    assert "author" in str(fault.value)


def test_float64_is_taken_as_float32():
    found = checked_array(LeastSquares(), "x", np.ones((2, 2)), (2, 2))
    assert found.dtype == np.float32


def test_a_height_of_another_shape_or_wholly_unknown_is_refused():
    grid = PixelGrid(2, 3, 1.0)
    with pytest.raises(
        TileError, match=r"integrator: simchony \(nlights 0.1.0\) should return height of shape"
    ):
        checked_height(Simchony(), HeightMap(np.zeros((3, 3), np.float32), grid), grid.shape)
    with pytest.raises(TileError, match="no two neighbouring normals"):
        checked_height(Simchony(), HeightMap(np.full((2, 3), np.nan, np.float32), grid), grid.shape)
    with pytest.raises(TileError, match="should return a HeightMap; got ndarray"):
        checked_height(Simchony(), np.zeros((2, 3), np.float32), grid.shape)


def test_a_flat_field_has_one_channel_or_the_photographs():
    for channels in (1, 3):
        assert (
            checked_flat_field(Slip(), np.ones((*SHAPE, channels), np.float32), SHAPE, 3).shape[-1]
            == channels
        )
    with pytest.raises(TileError, match="the flat field of shape"):
        checked_flat_field(Slip(), np.ones((*SHAPE, 2), np.float32), SHAPE, 3)
