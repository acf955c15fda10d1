"""The order of the shared unknowns, and what is believed of them beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.reflectance import FLAT_LOBES, KINDS, ROUGHNESSES
from nlights_core.calibration.unknowns import (
    AMBIENT_PRIOR,
    FREEDOM,
    LARGEST_LEVEL,
    LARGEST_STRENGTH,
    LEVEL_PRIOR,
    STRENGTH_PRIOR,
    from_vector,
    groups,
    narrowed,
    nothing,
    prior,
)


@pytest.mark.parametrize("lamps", [3, 8, 32])
def test_what_all_share_is_read_back_from_its_vector(lamps):
    size = len(nothing(lamps).vector())
    vector = np.random.default_rng(0).normal(size=size)
    shared = from_vector(vector, lamps)
    np.testing.assert_array_equal(shared.vector(), vector)
    assert len(shared.strengths) == lamps
    assert len(shared.gloss) == len(shared.roughnesses) == len(KINDS)
    assert len(shared.flat_gloss) == len(FLAT_LOBES)
    assert not nothing(lamps).vector().any()


@pytest.mark.parametrize("lamps", [3, 8])
def test_every_unknown_but_the_level_belongs_to_groups_of_one_name(lamps):
    by_name: dict[str, set[int]] = {}
    for group in groups(lamps):
        by_name.setdefault(group.name, set()).update(group.places)
    places = [place for some in by_name.values() for place in some]
    assert sorted(places) == list(range(1, len(nothing(lamps).vector())))


def test_of_alternatives_the_last_has_all_that_the_others_have():
    """The rounds without a choice fit the last of each name."""
    last = {group.name: group for group in groups(8)}
    for group in groups(8):
        assert set(group.places) <= set(last[group.name].places)
    kinds = [{KINDS[place - 9] for place in group.places} for group in groups(8) if group.name == "gloss"]
    assert {"ggx"} in kinds
    assert kinds[-1] == {"ggx", "beckmann", "blinn"}


def test_a_group_moves_what_its_name_says():
    moved = {}
    for group in groups(4):  # of alternatives, the last
        vector = nothing(4).vector()
        vector[list(group.places)] = 1
        shared = from_vector(vector, 4)
        moved[group.name] = {
            "lamps": shared.strengths.all(),
            "gloss": shared.gloss.all(),
            "departure": shared.departure == 1,
            "ambient": (shared.additive, shared.room) == (1, 1),
            "flat-gloss": shared.flat_gloss.all(),
        }
        assert shared.level == 0
    for name, what in moved.items():
        assert [other for other, changed in what.items() if changed] == [name]


def test_a_step_that_is_too_long_is_cut():
    far = nothing(3).vector()
    far[0], far[1:4], far[4] = 20.0, [0.5, -0.5, 0.1], 7.0
    there = nothing(3).moved(far)
    assert there.level == LARGEST_LEVEL
    np.testing.assert_allclose(there.strengths, [LARGEST_STRENGTH, -LARGEST_STRENGTH, 0.1])
    assert there.gloss[0] == 7.0
    again = there.moved(far).moved(far)
    assert again.level == 20.0


def one_kind(kind, strengths):
    """Strengths of the lobes of one kind, by their place in it."""
    out = np.zeros(len(KINDS))
    out[np.flatnonzero(np.array(KINDS) == kind)] = strengths
    return out


def test_lobes_are_moved_close_to_a_gloss_and_keep_its_strength():
    first = nothing(3)
    # Between alpha 0.14 and 0.2, nearer to 0.14.
    gloss = one_kind("blinn", [0, 0.6, 0.2, 0, 0, 0])
    shared = narrowed(replace(first, gloss=gloss), {"blinn": gloss}, 0.3)
    mine = np.array(KINDS) == "blinn"
    middle = np.exp(0.75 * np.log(0.14) + 0.25 * np.log(0.2))
    np.testing.assert_allclose(np.exp(np.log(shared.roughnesses[mine]).mean()), middle)
    assert np.ptp(np.log(shared.roughnesses[mine])) == pytest.approx(0.6)
    np.testing.assert_array_equal(shared.roughnesses[~mine], np.array(ROUGHNESSES)[~mine])
    assert shared.gloss[mine].sum() == pytest.approx(0.8)
    assert np.average(np.log(shared.roughnesses[mine]), weights=shared.gloss[mine]) == pytest.approx(
        np.log(middle), abs=0.02
    )


def test_lobes_of_two_glosses_on_each_other_stay_apart():
    gloss = one_kind("ggx", [0, 0.5, 0, 0, 0, 0.5])
    shared = narrowed(replace(nothing(3), gloss=gloss), {"ggx": gloss}, 0.3)
    mine = shared.roughnesses[np.array(KINDS) == "ggx"]
    assert mine[0] < 0.09
    assert mine[-1] > 0.6


def test_a_kind_without_gloss_keeps_its_lobes():
    shared = narrowed(nothing(3), {"ggx": np.zeros(len(KINDS))}, 0.3)
    np.testing.assert_array_equal(shared.roughnesses, ROUGHNESSES)


def test_the_prior_of_lamps_pulls_as_students_distribution_does():
    from scipy.stats import t

    strengths = np.array([-0.15, -0.02, 0.0, 0.001, 0.03, 0.2, 0.001])
    shared = from_vector(np.concatenate([[0.0], strengths, np.zeros(3 + len(KINDS) + len(FLAT_LOBES))]), 7)
    precisions, centres = prior(shared)
    middle = np.median(strengths)
    np.testing.assert_allclose(centres[1:8], middle)
    pull = precisions[1:8] * (strengths - middle)
    step = 1e-6
    logs = [t.logpdf(strengths + way * step, FREEDOM, middle, STRENGTH_PRIOR) for way in (1, -1)]
    np.testing.assert_allclose(pull, -(logs[0] - logs[1]) / (2 * step), rtol=1e-4, atol=1e-5)


def test_the_other_priors_are_gaussians_about_nothing():
    shared = from_vector(np.random.default_rng(1).normal(size=len(nothing(5).vector())), 5)
    precisions, centres = prior(shared)
    assert not np.delete(centres, range(1, 6)).any()
    assert precisions[0] == LEVEL_PRIOR**-2
    ambient = next(group for group in groups(5) if group.name == "ambient")
    np.testing.assert_allclose(precisions[list(ambient.places)], AMBIENT_PRIOR**-2)
    assert (precisions > 0).all()
