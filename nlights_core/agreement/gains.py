"""Gains: photographs that are brighter or darker throughout than their flats and the other lamps say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nlights_core.agreement.unknown_surfaces import gain_beside_surface
from nlights_core.frames import Array
from nlights_core.reduced_light.explanations import Misfit
from nlights_core.reduced_light.places import places, unexplained
from nlights_core.reduced_light.relative_light import RelativeLight, left_out

LEAST = 0.08
"""Deviation of a gain from 1 that is told.  Lamps drift by 1 %; of sound captures one whose gloss or height
the model does not know reads up to 0.13 and, by its height and gloss fitted beside it, 0.07."""

EXPLAINED = 0.6
"""What one photograph's gain may leave of the disagreement.  Sound captures leave 0.64 and more, those with
a gain of 0.92 or beyond 0.74; a photograph at 0.8 of its exposure leaves 0.01 to 0.6."""

ALIKE = 0.15
"""The same of a common gain of several: that all low lamps are darker is what gloss or height do, too, and
leaves 0.43 and more; another exposure from one photograph on leaves 0.003 to 0.06 on matt artworks."""

ROUNDS = 3
"""In which places are weighed anew; further ones change nothing that is told."""

SPREAD, MOST, NOISE = 0.4, 0.1, 0.01
"""By which share half of the places may differ from a gain that is the same everywhere: of its deviation from 1,
at most, and beside it.  Two lamps lit at once differ by 0.2 and more."""

SIMPLER = 0.4
"""What the gains of several must leave of what the gain of one leaves, to be said in its stead."""

CLEARER = 1.2
"""How much more the next best lamp must leave: else it is not told which it is."""


@dataclass(frozen=True)
class Gain:
    """A common gain of some photographs against their flats and the other lamps.

    Attributes
    ----------
    lamps : tuple of int
    gain : float
        1: as it should be.
    """

    lamps: tuple[int, ...]
    gain: float


def find_gains(relative: RelativeLight) -> list[Gain]:
    """Find photographs at another level than all others.

    Parameters
    ----------
    relative : RelativeLight
        With flats: without, a lamp's level is not known.

    Returns
    -------
    list of Gain
        Of different lamps; empty where no gain explains why they disagree.
    """
    found = _explain(relative)
    if not found and relative.colour is not None:
        # Gloss may hide a gain: it is grey, so the colour of paint has none of it, but more noise.
        found = _explain(replace(relative, light=relative.colour))
    return found


def _explain(relative: RelativeLight) -> list[Gain]:
    """The gains that explain best why photographs disagree, if any do."""
    _, _, light, vectors, weights = places(relative)
    if light.shape[1] < 50:
        return []
    misfit = _misfit(light, vectors, weights)
    best: list[Gain] = []
    least = misfit.level
    before: tuple[int, ...] = ()
    for size, together in misfit.kinds():
        ranked = misfit.ranked(size, together, before)
        if len(ranked) < 2:
            break
        (rest, before, changes), following = ranked[0], ranked[1][0]
        gains = 1 / (1 + changes[list(before), 0])
        if size == 1 and np.abs(gains - 1).max() >= LEAST:
            best = _of_one(relative, weights)
        if np.abs(gains - 1).min() < LEAST or (size != 1 and rest > SIMPLER * least):
            continue
        # Whatever else was said so far, this explains it much better.
        levelled = light.copy()
        levelled[list(before)] /= gains[:, None]
        clear = _same_everywhere(before, gains, levelled, vectors, weights)
        clear &= rest < (EXPLAINED if size == 1 else ALIKE) * misfit.level and following > CLEARER * rest
        lamps = [before] if together else [(lamp,) for lamp in before]
        if clear and not (size == 1 and best):
            best = [Gain(some, float(gains[k])) for k, some in enumerate(lamps)]
        least = rest if clear or size == 1 else least
    return best


def _of_one(relative: RelativeLight, weights: Array) -> list[Gain]:
    """The one photograph whose gain explains more than any other's beside the artwork's height and gloss."""
    found = gain_beside_surface(relative)
    if found is None or abs(found.gain - 1) < LEAST:
        return []
    lamp, gain, light, vectors = found
    alike = _same_everywhere((lamp,), np.array([gain]), light, vectors, weights)
    return [Gain((lamp,), gain)] if alike else []


def _same_everywhere(
    lamps: tuple[int, ...], gains: Array, levelled: Array, vectors: Array, weights: Array
) -> bool:
    """Test whether each lamp's light, its gain taken out, is as predicted in most places."""
    predicted, _, freedom = left_out(levelled, vectors, weights)
    for lamp, gain in zip(lamps, gains, strict=True):
        known = (weights[lamp] > 0) & (freedom[lamp] > 0.02) & (predicted[lamp] > 0)
        apart = np.abs(levelled[lamp, known] / predicted[lamp, known] - 1)
        if not apart.size or np.median(apart) > min(SPREAD * abs(gain - 1), MOST) + NOISE:
            return False
    return True


def _misfit(light: Array, vectors: Array, weights: Array) -> Misfit:
    """Misfit of the lamps as a function of the relative change of each.

    Places of gloss and shadow have little say.  Which these are is seen only when the gain that explains most is
    taken out: before, the places where that lamp is bright seem to be the odd ones.
    """
    level = np.where(weights > 0, light, np.float32(np.nan))
    light = (light / np.maximum(np.nanmedian(level, axis=0), 1e-6)).T
    free = unexplained(vectors, weights)
    levelled = light
    for _ in range(ROUNDS):
        squares = (np.einsum("nij,nj->ni", free, levelled) ** 2).sum(axis=1)
        trust = 1 / (1 + squares / max(float(np.median(squares)), 1e-12))
        products = np.einsum("n,nij,ni,nj->ij", trust, free, light, light).astype(float)
        misfit = Misfit(products, products.sum(axis=1), float(products.sum()), len(products))
        _, _, changes = misfit.ranked(1, False, ())[0]
        levelled = light * (1 + changes[:, 0])
    return misfit
