"""The statistics of a comparison, against draws whose truth is known."""

import numpy as np
import pytest

from nlights_flows.comparison.statistics import Sample, analyse, holm, neighbour_correlation

TRUE = 0.1


def sample(values: np.ndarray, kind="blocks", root=False) -> Sample:
    return Sample(values, np.ones(values.shape[:-1]), root, kind)


def alike(random: np.random.Generator, correlation: float, size: int = 8) -> np.ndarray:
    """A stationary field of variance 1 whose neighbours have a given correlation along both axes."""
    field = random.normal(size=(size, size))
    spread = np.sqrt(1 - correlation**2)
    for axis in (0, 1):
        field = np.moveaxis(field, axis, 0)
        for i in range(1, size):
            field[i] = correlation * field[i - 1] + spread * field[i]
        field = np.moveaxis(field, 0, axis)
    return field


def coverage(correlation: float, draws: int = 300) -> tuple[float, float]:
    """How often the interval holds the true difference, and how often there is one."""
    held = given = 0
    for seed in range(draws):
        random = np.random.default_rng(seed)
        hard = 1 + 2 * np.abs(
            random.normal(size=(8, 8))
        )  # what both variants find hard is in neither's difference
        errors = [hard + shift + 0.2 * alike(random, correlation) for shift in (TRUE, 0)]
        found = analyse(sample(np.stack(errors, axis=-1)[None]), draws=500, seed=seed)
        interval = found.differences[0][1].interval
        if interval is not None:
            given += 1
            held += interval[0] <= TRUE <= interval[1]
    return held / given, given / draws


def test_the_95_percent_interval_of_independent_blocks_holds_the_truth_95_times_in_100():
    held, given = coverage(0.0)
    assert held == pytest.approx(0.95, abs=0.03)
    assert given == 1


def test_blocks_that_resemble_their_neighbours_widen_the_interval_until_it_is_right():
    held, given = coverage(0.4)
    assert held == pytest.approx(0.95, abs=0.05)  # without it 0.6
    assert given > 0.9


def test_few_tiles_widen_the_interval():
    held = 0
    for seed in range(300):
        random = np.random.default_rng(seed)
        hard = 1 + 2 * np.abs(random.normal(size=6))
        errors = np.stack([hard + TRUE, hard], axis=-1) + 0.1 * random.normal(size=(6, 2))
        found = analyse(sample(errors[:, None, None], "tiles"), draws=500, seed=seed)
        low, high = found.differences[0][1].interval
        held += low <= TRUE <= high
    assert held / 300 == pytest.approx(0.95, abs=0.04)  # plain percentiles hold it 85 times in 100


def test_four_equal_variants_are_ranked_apart_by_chance_in_at_most_5_percent():
    apart = 0
    for seed in range(300):
        errors = np.abs(np.random.default_rng(seed).normal(size=(1, 8, 8, 4)))
        apart += set(analyse(sample(errors), draws=1000, seed=seed).ranks) != {1}
    assert apart / 300 <= 0.05 + 0.025


def test_a_clear_order_is_found_and_ties_share_a_rank():
    random = np.random.default_rng(0)
    hard = 1 + 2 * np.abs(random.normal(size=(1, 8, 8)))
    shifts = (1.0, 0.0, 0.0, 0.5)
    errors = np.stack([hard + shift + 0.2 * random.normal(size=hard.shape) for shift in shifts], axis=-1)
    found = analyse(sample(errors))
    assert found.ranks == (4, 1, 1, 3)
    assert found.winners == (1, 2)
    assert found.differences[0][found.best].value == pytest.approx(1.0, abs=0.1)


def test_variants_that_made_the_same_are_one_and_make_no_comparison_more():
    random = np.random.default_rng(1)
    better = 1 + np.abs(random.normal(size=(1, 8, 8)))
    worse = better + 0.045 + 0.15 * random.normal(size=(1, 8, 8))
    two = analyse(sample(np.stack([better, worse], axis=-1)))
    assert two.ranks == (1, 2)
    p = two.differences[1][0].p
    assert 0.05 / 6 < p < 0.05  # six comparisons would have hidden it
    four = analyse(sample(np.stack([better, worse, better, worse], axis=-1)))
    assert four.ranks == (1, 3, 1, 3)


def test_fewer_than_five_places_give_no_interval_and_no_rank():
    found = analyse(sample(np.arange(8.0).reshape(4, 1, 1, 2) ** 2, "tiles"))
    assert found.differences[0][1].interval is None
    assert found.ranks is None
    assert found.winners == ()


def test_a_variant_that_is_far_worse_everywhere_is_told_apart_however_unevenly_worse():
    random = np.random.default_rng(3)
    near = np.exp(-np.arange(8.0)) + np.exp(np.arange(8.0) - 7)  # of an edge: dim corners
    corner = 1 + 30 * np.multiply.outer(near, near)[None]
    corner *= 1 + random.random(corner.shape)
    found = analyse(sample(np.stack([np.full(corner.shape, 0.1), corner], axis=-1)))
    assert found.differences[1][0].places < 16  # of 64: it is smooth
    assert found.ranks == (1, 2)


def test_nothing_wrong_at_all_is_better_than_something_wrong():
    random = np.random.default_rng(2)
    errors = np.stack([np.zeros((1, 8, 8)), 1 + np.abs(random.normal(size=(1, 8, 8)))], axis=-1)
    found = analyse(sample(errors))
    assert found.ranks == (1, 2)
    assert np.isfinite(found.differences[1][0].interval).all()


def test_a_slow_difference_over_one_tile_counts_as_few_places():
    bow = np.linspace(-1, 1, 8)[None, :, None] * np.ones((1, 8, 8))
    found = analyse(sample(np.stack([bow + 5, np.full(bow.shape, 4.8)], axis=-1)))
    away = found.differences[0][1]
    assert away.places < 3
    # Over 64 independent blocks 0.2 with a spread of 0.65 would be told apart.
    assert away.value == pytest.approx(0.2)
    assert found.winners == ()


def test_an_rms_is_the_root_of_the_weighted_mean_square():
    squares = np.array([[1.0], [9.0], [4.0], [4.0], [16.0], [1.0]])[:, None, None]
    weights = np.array([1.0, 2, 1, 1, 3, 2])[:, None, None]
    found = analyse(Sample(squares, weights, True, "tiles"))
    assert found.values[0] == pytest.approx(np.sqrt((1 + 18 + 4 + 4 + 48 + 2) / 10))


def test_a_place_that_one_variant_does_not_know_counts_for_none():
    errors = np.ones((1, 4, 4, 2))
    errors[0, 0, 0] = [np.nan, 100.0]
    found = analyse(sample(errors))
    assert found.places == 15
    assert found.values == (1.0, 1.0)


def test_holm_corrects_the_smallest_probability_most():
    assert holm([0.04, 0.001, 0.03]) == pytest.approx([0.06, 0.003, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_the_correlation_of_neighbours_is_found():
    fields = np.stack([alike(np.random.default_rng(seed), 0.6, 40) for seed in range(4)])
    assert neighbour_correlation(fields) == pytest.approx(0.6, abs=0.05)
    assert neighbour_correlation(np.zeros((1, 8, 8))) == 0
