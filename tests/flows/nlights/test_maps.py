"""Maps: arrays that know their grid and unit, and nothing that is made of them does."""

import copy
import pickle

import numpy as np
import pytest

from nlights import Map, PixelGrid

GRID = PixelGrid(4, 6, 0.5)


@pytest.fixture
def height() -> Map:
    return Map(np.arange(24, dtype=np.float32).reshape(4, 6), GRID, "mm")


def test_a_map_is_an_array_with_a_place(height):
    assert height.is_whole
    assert (height.grid, height.unit) == (GRID, "mm")
    assert np.asarray(height).sum() == height.sum() == 276


def test_values_must_lie_on_the_grid():
    with pytest.raises(ValueError, match=r"shape \(3, 6\).*4 x 6 pixels"):
        Map(np.zeros((3, 6)), GRID, "mm")


@pytest.mark.parametrize(
    "made",
    [
        lambda m: m[1:],
        lambda m: m[::-1],
        lambda m: m[[3, 2, 1, 0]],
        lambda m: m[:],
        lambda m: m + 1,
        lambda m: 1000 * m,
        lambda m: np.sqrt(m),
        lambda m: m.mean(axis=0),
        lambda m: np.where(m > 3, m, np.nan),
        lambda m: np.stack([m, m]),
    ],
)
def test_a_part_or_a_result_is_a_plain_array(height, made):
    assert type(made(height)) is np.ndarray


@pytest.mark.parametrize(
    "made", [lambda m: m.T, lambda m: m.reshape(6, 4), lambda m: m.view(), lambda m: m.astype(float)]
)
def test_other_views_have_no_place_and_say_so(height, made):
    view = made(height)
    assert not isinstance(view, Map) or not view.is_whole
    with pytest.raises(AttributeError, match=r"made of a map|no attribute"):
        view.grid  # noqa: B018
    assert not hasattr(view, "unit")
    assert height.is_whole


def test_numbers_are_scalars(height):
    assert type(height[1, 2]) is type(height.mean()) is np.float32
    assert height[1, 2] == 8


@pytest.mark.parametrize("made", [Map.copy, lambda m: pickle.loads(pickle.dumps(m))])
def test_a_copy_and_a_pickle_keep_the_place(height, made):
    found = made(height)
    assert (found.grid, found.unit) == (GRID, "mm")
    assert (found == height).all()
    assert not np.shares_memory(found, height)
    found[0, 0] = 7
    assert height[0, 0] == 0


def test_a_deep_copy_never_has_a_wrong_place(height):
    found = copy.deepcopy(height)
    assert (np.asarray(found) == np.asarray(height)).all()
    assert not getattr(found, "is_whole", False) or found.grid == GRID


def test_results_go_where_they_are_told(height):
    out = np.empty((4, 6), np.float32)
    assert np.multiply(height, 2, out=out) is out
    height += 1
    assert height[0, 0] == 1
    assert height.max() == 24
