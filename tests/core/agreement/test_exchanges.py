"""Photographs that are listed under each other's lamps."""

import dataclasses
import itertools

import numpy as np
import pytest

from nlights_core.agreement.comparisons import compare_photographs
from nlights_core.agreement.exchanges import exchanges, find_exchanged
from nlights_core.reduced_light.coarse_light import reduce_to_cells


@pytest.fixture(scope="module")
def cells(sampled):
    return reduce_to_cells(*sampled, None)


@pytest.mark.parametrize("kind", ["photographs", "flats", "lamps"])
def test_any_pair_of_the_eight_lamps(sampled, cells, kind):
    for pair in itertools.combinations(range(8), 2):
        order = np.arange(8)
        order[list(pair)] = order[list(pair[::-1])]
        frames = cells.frames if kind == "flats" else cells.frames[order]
        flats = cells.flats if kind == "photographs" else cells.flats[order]
        found = find_exchanged(dataclasses.replace(cells, frames=frames, flats=flats), sampled[1])
        lamps = tuple(cells.lamps[i] for i in pair)
        assert [(warning.code, warning.lamps) for warning in found] == [("exchanged", lamps)]
        assert found[0].sentence.startswith(f"{kind}{'' if kind == 'lamps' else ' of lamps'} {lamps[0]} and")
        assert found[0].value > 1.3


@pytest.mark.parametrize(
    "order", [[1, 2, 0, 3, 4, 5, 6, 7], [0, 4, 2, 1, 3, 5, 6, 7], [1, 2, 3, 4, 5, 6, 7, 0]]
)
@pytest.mark.parametrize("kind", ["frames", "flats", "both"])
def test_longer_cycles(sampled, found, order, kind):
    samples = sampled[0]
    changed = {}
    if kind != "flats":
        changed["frames"] = samples.frames[order]
    if kind != "frames":
        changed["flats"] = samples.flats[order]
    lamps = tuple(lamp for i, lamp in enumerate(samples.lamps) if order[i] != i)
    assert found(**changed) == [("exchanged", lamps)]


def test_two_pairs_at_once(sampled, found):
    frames = sampled[0].frames[[1, 0, 2, 3, 4, 7, 6, 5]]
    assert sorted(found(frames=frames)) == [
        ("exchanged", ("Relio_1", "Relio_2")),
        ("exchanged", ("Relio_6", "Relio_8")),
    ]


def test_the_files_are_named_with_whose_light_they_show(capture, compared):
    first, second, other = (capture / name for name in ("light_2.tif", "light_6.tif", "other.tif"))
    first.rename(other)
    second.rename(first)
    other.rename(second)
    comparison = compared(capture)
    assert [warning.lamps for warning in comparison.warnings] == [("Relio_2", "Relio_6")]
    sentence = comparison.warnings[0].sentence
    assert "light_2.tif shows the light of lamp Relio_6" in sentence
    assert "light_6.tif shows the light of lamp Relio_2" in sentence
    assert "correct the names" in sentence
    assert comparison.lamps == {"Relio_2", "Relio_6"}


def test_without_a_stand_it_is_not_said_which_of_the_two(sampled):
    samples, tile = sampled
    frames = samples.frames[[0, 1, 5, 3, 4, 2, 6, 7]]
    found = compare_photographs(
        dataclasses.replace(samples, frames=frames), tile.model_copy(update={"stand": None}), None
    )
    assert [warning.lamps for warning in found.warnings] == [("Relio_3", "Relio_6")]
    assert found.warnings[0].sentence.startswith("photographs or flats of lamps Relio_3 and Relio_6")


@pytest.mark.parametrize("chosen", [[0, 2, 5, 7], [0, 1, 4, 5, 6], [1, 2, 3, 4, 6, 7]])
def test_fewer_lamps(sampled, cells, chosen):
    few = cells.of(tuple(cells.lamps[i] for i in chosen))
    assert find_exchanged(few, sampled[1]) == []
    order = [1, 0, *range(2, len(chosen))]
    found = find_exchanged(dataclasses.replace(few, frames=few.frames[order]), sampled[1])
    assert [warning.lamps for warning in found] == [(few.lamps[0], few.lamps[1])]


def test_no_cycle_is_longer_than_it_must_be():
    apart = np.full((6, 6), 10.0)
    np.fill_diagonal(apart, 1.0)
    apart[0, 1] = apart[1, 0] = 0.9
    assert [exchange.lamps for exchange in exchanges(apart)] == []
    apart[0, 0] = apart[1, 1] = 5.0
    # 2 and 3 agree about as well with each other as with themselves: that is no exchange.
    apart[2, 3] = apart[3, 2] = 0.95
    found = exchanges(apart)
    assert [exchange.lamps for exchange in found] == [(0, 1)]
    assert found[0].ratio == pytest.approx(0.18)
    apart[2, 2] = np.nan
    assert [exchange.lamps for exchange in exchanges(apart)] == [(0, 1)]
