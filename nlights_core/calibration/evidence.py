"""Evidence: which groups of shared unknowns the photographs need, and what they say of these."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from nlights_core.calibration.linearisation import Equations
from nlights_core.calibration.unknowns import Group, Shared, prior
from nlights_core.frames import Array

MARGIN = 10.0
"""By how much a group must raise the logarithm of the likelihood (nats) to be believed.  In 42 captures the least of
a true group was 34, the most of a false one 0.8; 6 made the same choices."""


STILL = 0.05
"""Share of its uncertainty by which a round must move a value, or else it is the last: another would move it by a
fifth of that."""


class Found(NamedTuple):
    """Values of the shared unknowns that a choice of groups leads to.

    Attributes
    ----------
    values : (M,) float64 array
        0 (strengths: their common centre) where not believed.
    free : tuple of int
        Places of the unknowns that were fitted.
    believed : tuple of str
        Names of the groups.
    evidence : float
        Logarithm of the likelihood, less `MARGIN` for each group.
    """

    values: Array
    free: tuple[int, ...]
    believed: tuple[str, ...]
    evidence: float


def choose_groups(
    matrix: Array,
    right: Array,
    precisions: Array,
    centres: Array,
    groups: Sequence[Group],
    every: bool = False,
    always: Sequence[int] = (0,),
) -> Found:
    """Choose the groups with the largest evidence, and solve for them.

    Parameters
    ----------
    matrix, right : (M, M) and (M,) float64 arrays
        Normal equations for the values themselves (not for a step).
    precisions, centres : (M,) float64 arrays
        What is believed beforehand.
    groups : sequence of Group
        To choose among; of those with the same name one at most is believed.
    every : bool
        Take all groups without looking at the evidence.
    always : sequence of int
        Places of the unknowns that are fitted whatever the evidence: the level.

    Returns
    -------
    Found
    """
    alternatives: dict[str, list[Group | None]] = {}
    for group in groups:
        alternatives.setdefault(group.name, [] if every else [None]).append(group)
    if every:
        # Of alternatives the last has them all.
        alternatives = {name: some[-1:] for name, some in alternatives.items()}
    trials = [[group for group in some if group] for some in product(*alternatives.values())]
    return max(
        (fit_groups(matrix, right, precisions, centres, some, always) for some in trials),
        key=lambda found: found.evidence,
    )


def fit_groups(
    matrix: Array,
    right: Array,
    precisions: Array,
    centres: Array,
    some: Sequence[Group],
    always: Sequence[int],
) -> Found:
    """Fit a choice of groups; what cannot be negative and would be is taken out, the most negative first.

    Parameters are those of `choose_groups`.
    """
    free = [*always, *(place for group in some for place in group.places)]
    positive = {place for group in some if group.positive for place in group.places}
    while True:
        places = np.array(free, np.intp)
        inner = matrix[np.ix_(places, places)] + np.diag(precisions[places])
        shifted = right[places] - matrix[np.ix_(places, places)] @ centres[places]
        values = np.linalg.solve(inner, shifted)
        worst = min(
            (k for k, place in enumerate(free) if place in positive), key=lambda k: values[k], default=None
        )
        if worst is None or values[worst] >= 0:
            break
        free.pop(worst)
    known = float(shifted @ values) - float(np.linalg.slogdet(inner)[1] - np.log(precisions[places]).sum())
    out = np.zeros(len(right))
    out[places] = centres[places] + values
    return Found(out, tuple(free), tuple(group.name for group in some), known / 2 - MARGIN * len(some))


def choose(
    equations: Equations, shared: Shared, kinds: list[Group], every: bool, always: tuple[int, ...]
) -> Found:
    """Choose by the equations of a round, about the values that they were made with."""
    precisions, centres = prior(shared)
    right = equations.right + equations.matrix @ shared.vector()
    return choose_groups(equations.matrix, right, precisions, centres, kinds, every, always)


def choose_clear(
    equations: Equations, shared: Shared, kinds: list[Group], every: bool, always: tuple[int, ...]
) -> Found:
    """Choose groups of which there is evidence, and which stand out of what parts of the field say differently."""
    while True:
        found = choose(equations, shared, kinds, every, always)
        if every or not found.believed:
            return found
        scatter = covariance(equations, shared, found)
        _, centres = prior(shared)
        clear = {}
        for name in found.believed:
            places = [
                p for p in found.free if any(p in group.places for group in kinds if group.name == name)
            ]
            apart = found.values[places] - centres[places]
            likelihood = float(apart @ np.linalg.solve(scatter[np.ix_(places, places)], apart)) / 2
            clear[name] = likelihood - len(places) / 2 - MARGIN
        weakest = min(clear, key=lambda name: clear[name])
        if clear[weakest] >= 0:
            return found
        kinds = [group for group in kinds if group.name != weakest]


def stands(equations: Equations, shared: Shared, found: Found) -> bool:
    """Test whether a round moves nothing by more than `STILL` of its uncertainty."""
    places = np.array(found.free, np.intp)
    moved = (found.values - shared.vector())[places]
    precisions, _ = prior(shared)
    inverse = np.linalg.inv(equations.matrix[np.ix_(places, places)] + np.diag(precisions[places]))
    return bool(np.all(np.abs(moved) < STILL * np.sqrt(np.diag(inverse))))


def covariance(equations: Equations, shared: Shared, found: Found) -> Array:
    """Covariance of the unknowns that were fitted, (M, M); see `covariance_of`."""
    precisions, _ = prior(shared)
    return covariance_of(equations, precisions, found.free)


def covariance_of(
    equations: Equations, precisions: Array, free: Sequence[int], less: Array | None = None
) -> Array:
    """Covariance of the unknowns at some places, (M, M): the larger of two ways to find it.

    The scatter of the equations between parts of the field knows what neighbours share; the posterior, that what is
    wrong everywhere does not scatter.  ``less`` (M,): by which factor the equations know less of each unknown than
    they say; the scatter is what it is.
    """
    places = np.array(free, np.intp)
    block = np.ix_(places, places)
    own = np.diag(precisions[places])
    inverse = np.linalg.inv(equations.matrix[block] + own)
    scattered = inverse @ (equations.scatter[block] + own) @ inverse
    posterior = inverse
    if less is not None:
        posterior = np.linalg.inv(equations.matrix[block] * np.outer(less[places], less[places]) + own)
    out = np.zeros_like(equations.matrix)
    out[block] = larger_covariance(posterior, scattered)
    return out


def larger_covariance(one: Array, other: Array) -> Array:
    """The least covariance that is no smaller than one, and in no direction of that smaller than another."""
    root = np.linalg.cholesky(one)
    back = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(back @ other @ back.T)
    wide = root @ vectors
    return np.asarray((wide * np.maximum(values, 1)) @ wide.T)
