"""Evidence: which groups of shared unknowns the photographs need, and what they say of these."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from nlights_core.calibration.unknowns import Group
from nlights_core.frames import Array

MARGIN = 10.0
"""By how much a group must raise the logarithm of the likelihood (nats) to be believed.  In 42 captures the least of
a true group was 34, the most of a false one 0.8; 6 made the same choices."""


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


def choose(
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
        (_fit(matrix, right, precisions, centres, some, always) for some in trials),
        key=lambda found: found.evidence,
    )


def _fit(
    matrix: Array,
    right: Array,
    precisions: Array,
    centres: Array,
    some: Sequence[Group],
    always: Sequence[int],
) -> Found:
    """Fit a choice of groups; what cannot be negative and would be is taken out, the most negative first."""
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
