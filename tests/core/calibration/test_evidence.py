"""Groups are believed where the likelihood says so, on equations whose truth is known."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from nlights_core.calibration.evidence import MARGIN, choose_groups
from nlights_core.calibration.unknowns import Group

KINDS = [Group("one", (1, 2), False), Group("two", (3,), True), Group("three", (4, 5), False)]
PRECISIONS, NONE = np.array([0.04, 4.0, 4.0, 1.0, 9.0, 9.0]), np.zeros(6)


def equations(truth, seed=0, samples=200):
    """Design, observations of unit noise, and their normal equations."""
    random = np.random.default_rng(seed)
    design = random.normal(size=(samples, len(truth)))
    observed = design @ truth + random.normal(size=samples)
    return design, observed, design.T @ design, design.T @ observed


@pytest.mark.parametrize(
    ("truth", "believed"),
    [
        ([2.0, 0, 0, 0, 0, 0], ()),
        ([2.0, 0.7, 0, 0, 0, 0], ("one",)),
        ([-3.0, 0, 0, 0.8, 0, 0.9], ("two", "three")),
        ([0.0, 0.8, -0.8, 0.9, 0.8, 0], ("one", "two", "three")),
    ],
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_groups_that_are_there_are_believed_and_no_other(truth, believed, seed):
    _, _, matrix, right = equations(np.array(truth), seed)
    found = choose_groups(matrix, right, PRECISIONS, NONE, KINDS)
    assert found.believed == believed
    np.testing.assert_allclose(found.values, truth, atol=0.3)
    free = {0, *(place for kind in KINDS if kind.name in believed for place in kind.places)}
    assert set(found.free) == free
    assert not np.delete(found.values, sorted(free)).any()


def test_evidence_is_the_likelihood_of_what_was_observed_less_a_margin_for_each_group():
    design, observed, matrix, right = equations(np.array([1.0, 0.9, -0.8, 0, 0, 0]))
    found = choose_groups(matrix, right, PRECISIONS, NONE, KINDS[:1])
    assert found.believed == ("one",)

    def likelihood(places):
        wide = design[:, places] @ np.diag(1 / PRECISIONS[places]) @ design[:, places].T
        return multivariate_normal(cov=wide + np.eye(len(observed))).logpdf(observed)

    nothing = multivariate_normal(cov=np.eye(len(observed))).logpdf(observed)
    assert found.evidence == pytest.approx(likelihood([0, 1, 2]) - nothing - MARGIN)
    assert choose_groups(matrix, right, PRECISIONS, NONE, []).evidence == pytest.approx(
        likelihood([0]) - nothing
    )


def test_a_group_of_less_evidence_than_the_margin_is_not_believed():
    # 0.3 of an unknown of 200 samples is 4 standard deviations: 9 nats, less what the freedom costs.
    _, _, matrix, right = equations(np.array([0.0, 0, 0, 0, 0, 0]))
    right = matrix @ np.array([0.0, 0, 0, 0.3, 0, 0])
    found = choose_groups(matrix, right, PRECISIONS, NONE, KINDS)
    assert found.believed == ()
    assert choose_groups(matrix, right, PRECISIONS, NONE, KINDS, every=True).values[3] == pytest.approx(
        0.3, abs=0.01
    )


def test_what_cannot_be_negative_is_taken_out_where_it_would_be():
    _, _, matrix, right = equations(np.array([1.0, 0, 0, -0.9, 0, 0]))
    found = choose_groups(matrix, right, PRECISIONS, NONE, KINDS)
    assert found.values[3] == 0
    every = choose_groups(matrix, right, PRECISIONS, NONE, KINDS, every=True)
    assert every.believed == ("one", "two", "three")
    assert every.values[3] == 0
    assert 3 not in every.free
    # Without it the others are what the smaller system says.
    rest = [0, 1, 2, 4, 5]
    alone = np.linalg.solve(matrix[np.ix_(rest, rest)] + np.diag(PRECISIONS[rest]), right[rest])
    np.testing.assert_allclose(every.values[rest], alone)


def test_values_are_held_at_the_centre_of_the_prior():
    centres = np.array([0.0, 0.5, 0.5, 0, 0, 0])
    weak = 1e-9 * np.eye(6)
    found = choose_groups(weak, weak @ np.ones(6), PRECISIONS, centres, KINDS, every=True)
    np.testing.assert_allclose(found.values, centres, atol=1e-6)
    _, _, matrix, right = equations(np.array([1.0, 0.9, -0.4, 0, 0, 0]))
    found = choose_groups(matrix, right, PRECISIONS, centres, KINDS, every=True)
    assert 3 not in found.free or found.values[3] >= 0
    free = list(found.free)
    balance = right[free] - matrix[np.ix_(free, free)] @ found.values[free]
    np.testing.assert_allclose(balance, PRECISIONS[free] * (found.values - centres)[free], atol=1e-9)


def test_of_alternatives_of_one_name_the_better_one_is_believed_alone():
    kinds = [Group("one", (1,), False), Group("one", (2, 4), False), Group("one", (1, 2, 4), False)]
    _, _, matrix, right = equations(np.array([1.0, 0.9, 0, 0, 0, 0]))
    found = choose_groups(matrix, right, PRECISIONS, NONE, kinds)
    assert (found.believed, found.free) == (("one",), (0, 1))
    _, _, matrix, right = equations(np.array([1.0, 0, 0.7, 0, -0.8, 0]))
    found = choose_groups(matrix, right, PRECISIONS, NONE, kinds)
    assert (found.believed, found.free) == (("one",), (0, 2, 4))
    every = choose_groups(matrix, right, PRECISIONS, NONE, kinds, every=True)
    assert (every.believed, every.free) == (("one",), (0, 1, 2, 4))


def test_a_level_that_is_not_sought_is_not_fitted():
    _, _, matrix, right = equations(np.array([3.0, 0.9, -0.8, 0, 0, 0]))
    found = choose_groups(matrix, right, PRECISIONS, NONE, KINDS[:1], always=())
    assert found.values[0] == 0
    assert found.free == (1, 2)
    nothing = choose_groups(matrix, right, PRECISIONS, NONE, [], always=())
    assert (nothing.free, nothing.believed, nothing.evidence) == ((), (), 0)
    assert not nothing.values.any()
