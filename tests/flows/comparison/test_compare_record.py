"""What a comparison records of its tiles: which places count, and who takes part."""

import numpy as np
import pytest

from nlights_flows.comparison.comparing import analyse_metric
from nlights_flows.comparison.metrics import METRICS, TileMeasures, block_edges
from nlights_flows.comparison.page import describe_metric, overall

ANGLE, HEIGHT, HELD_OUT, _ = METRICS


def tile(random: np.random.Generator, means: list[float], key: str = "angle_error") -> TileMeasures:
    """A tile of 4 x 4 blocks on which variants have about the given errors."""
    values = np.array(means) * (1 + 0.1 * random.random((4, 4, 1)) + 0.01 * random.random((4, 4, len(means))))
    return TileMeasures(places={key: values}, weights={key: np.full((4, 4), 25.0)}, pixels=400)


def tiles(count: int, means: list[float], key: str = "angle_error") -> dict[str, TileMeasures]:
    random = np.random.default_rng(0)
    return {f"a/{i}": tile(random, means, key) for i in range(count)}


def test_five_tiles_are_the_places_and_fewer_are_cut_into_blocks():
    found = analyse_metric(ANGLE, ["x", "y"], tiles(5, [1.0, 2.0]), ["mm"] * 5)
    assert found["over"] == {"kind": "tiles", "places": 5, "tiles": 5}
    assert found["winners"] == ["x"]
    found = analyse_metric(ANGLE, ["x", "y"], tiles(4, [1.0, 2.0]), ["mm"] * 4)
    assert found["over"] == {"kind": "blocks", "places": 64, "tiles": 4}
    assert found["winners"] == ["x"]


def test_an_rms_is_the_same_over_tiles_as_over_all_their_blocks():
    measured = tiles(5, [4.0, 9.0], "height_error")
    squares = np.mean([one.places["height_error"] for one in measured.values()], axis=(0, 1, 2))
    found = analyse_metric(HEIGHT, ["x", "y"], measured, ["mm"] * 5)
    assert [row["value"] for row in found["variants"]] == pytest.approx(np.sqrt(squares))


def test_what_was_not_measured_is_never_best_and_never_ranked():
    measured = tiles(5, [1.0, 2.0, 3.0])
    for one in measured.values():
        one.places["angle_error"][..., 0] = np.nan
    found = analyse_metric(ANGLE, ["x", "y", "z"], measured, ["mm"] * 5)
    assert [row["rank"] for row in found["variants"]] == [None, 1, 2]
    assert found["variants"][0]["value"] is None
    assert found["variants"][1]["to_first"] is None
    assert found["winners"] == ["y"]
    assert "best is y" in describe_metric(found)


def test_a_tile_on_which_a_variant_has_no_number_takes_the_variant_out():
    measured = tiles(5, [1.0, 2.0, 3.0])
    measured["a/2"].places["angle_error"][..., 1] = np.nan
    found = analyse_metric(ANGLE, ["x", "y", "z"], measured, ["mm"] * 5)
    assert [row["rank"] for row in found["variants"]] == [1, None, 2]


def test_lengths_with_and_without_a_scale_are_not_mixed():
    found = analyse_metric(HEIGHT, ["x", "y"], tiles(5, [1.0, 2.0], "height_error"), ["mm"] * 4 + ["px"])
    assert found["over"] is None
    assert found["winners"] == []


def test_lamps_are_the_places_of_a_single_tile_and_four_are_too_few():
    for lamps, ranked in ((8, True), (4, False)):
        values = np.stack([np.arange(1.0, lamps + 1), np.arange(1.0, lamps + 1) * 2], axis=-1)[:, None]
        one = TileMeasures(places={"held_out": values}, weights={"held_out": np.ones((lamps, 1))}, pixels=9)
        found = analyse_metric(HELD_OUT, ["x", "y"], {"a/b": one}, ["mm"])
        assert found["over"] == {"kind": "lamps", "places": lamps, "tiles": 1}
        assert (found["winners"] == ["x"]) == ranked
        if not ranked:
            assert "too few" in describe_metric(found)


def test_the_answer_names_the_winner_only_where_the_truths_agree():
    one = analyse_metric(ANGLE, ["x", "y"], tiles(5, [1.0, 2.0]), ["mm"] * 5)
    other = analyse_metric(HEIGHT, ["x", "y"], tiles(5, [2.0, 1.0], "height_error"), ["mm"] * 5)
    tied = analyse_metric(HEIGHT, ["x", "y"], tiles(5, [1.0, 1.0], "height_error"), ["mm"] * 5)
    assert "the winner is x" in overall([one])
    assert "the winner is x" in overall([one, tied])
    assert "it depends on what is asked" in overall([one, other])
    assert "no variant is told apart" in overall([tied])
    assert "There is no truth" in overall([])


def test_blocks_cover_a_side_however_short():
    for length in (1, 3, 8, 9, 1001):
        edges = block_edges(length)
        assert edges[0] == 0
        assert edges[-1] == length
        assert (np.diff(edges) > 0).all()
