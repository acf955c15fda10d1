"""Oddities: a photograph that does not agree with the others, for a reason that is not known."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.reduced_light.places import places, unexplained
from nlights_core.reduced_light.relative_light import FEWEST, RelativeLight

BETTER = 0.6
"""How much less the others must disagree without the photograph than without any other.  Sound captures reach
0.9, with gloss and frames too."""

SHAPE = 0.12
"""How far the photograph must be from what the others predict, in half of the places; its level is free."""


def find_odd(relative: RelativeLight) -> tuple[int, float] | None:
    """Find the one photograph without which the others agree.

    Parameters
    ----------
    relative : RelativeLight

    Returns
    -------
    (int, float) or None
        The lamp, and by which share its photograph differs in half of the places.
    """
    _, _, light, vectors, weights = places(relative)
    some = weights.sum(axis=0) > FEWEST
    light, vectors, weights = light[:, some], vectors[:, some], weights[:, some]
    if light.shape[1] < 50:
        return None
    free = unexplained(vectors, weights)
    residual = np.einsum("nij,jn->in", free, light)
    own = np.einsum("nii->in", free)
    predicted = light - residual / np.maximum(own, 0.02)
    without = np.maximum((residual**2).sum(axis=0) - residual**2 / np.maximum(own, 0.02), 0)
    level = light.sum(axis=0) / weights.sum(axis=0)
    apart = np.median(np.sqrt(without) / np.maximum(level, 1e-6), axis=1)
    lamp = int(np.argmin(apart))
    if apart[lamp] > BETTER * np.min(np.delete(apart, lamp)):
        return None
    differs = _difference(light[lamp], predicted[lamp], (weights[lamp] > 0) & (own[lamp] > 0.02))
    return (lamp, differs) if differs > SHAPE else None


def _difference(light: Array, predicted: Array, known: Array) -> float:
    """Share by which light differs from its prediction in half of the places, after the best gain."""
    known &= predicted > 0.05 * max(float(np.median(predicted)), 0.0)
    if np.count_nonzero(known) < 50:
        return 0.0
    ratio = light[known] / predicted[known]
    middle = float(np.median(ratio))
    return float(np.median(np.abs(ratio / middle - 1))) if middle > 0 else 1.0
