"""Sharpness: photographs whose fine detail has less contrast than the others predict."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.movement.fine_structure import FineStructure

SOFT = 0.6
"""Contrast of fine detail against that of detail four times coarser, relative to the other photographs, below
which a photograph is blurred.  Sound captures reach 0.8; a blur of 2 px (standard deviation) reads 0.34 to 0.5
where the detail is some 10 px wide, one of 1 px 0.7 to 0.84."""

SEEN = 1.8
"""How many times the detail that can be predicted must be what cannot: below, it is noise or gloss."""

ALONE = 1.25
"""How much sharper the next softest photograph must be."""

QUARTERLY = 0.75
"""Contrast of its fine detail, relative to the other photographs, that no quarter of a blurred one may reach."""

EXPLAINED = 0.4
"""Unexplained share of the fine structure of a tile from which on it is not looked at: noise, gloss, a frame."""

TILES = 12
"""Tiles that must be left."""

PREDICTED = 0.05
"""Share of a photograph that its own deviation must keep against the others, to be predicted by them."""


def find_blurred(fine: FineStructure, coarse: FineStructure) -> list[tuple[int, float]]:
    """Find the photograph that is blurred.

    Parameters
    ----------
    fine, coarse : FineStructure
        Of the same photographs: detail of the smallest size, and of four times that.

    Returns
    -------
    list of (int, float)
        The lamp, and what is left of the contrast of its fine detail; empty where none is blurred.
    """
    fine, coarse = (one.part((one.left() > 0) & (one.shares() < EXPLAINED)) for one in (fine, coarse))
    if len(fine.products) < TILES or not len(coarse.products):
        return []
    (contrast, seen), (whole, _) = _contrast(fine), _contrast(coarse)
    known = (seen > SEEN) & (contrast > 0) & (whole > 0)
    if np.count_nonzero(known) < max(4, len(known) // 2):
        return []
    ratio = np.where(known, contrast / np.where(known, whole, 1), np.inf)
    ratio /= np.median(ratio[known])
    order = np.argsort(ratio)
    softest, following = ratio[order[0]], ratio[order[1]]
    alone = following > max(ALONE * softest, SOFT)
    if softest < SOFT and alone and _everywhere(fine, int(order[0]), known):
        return [(int(order[0]), float(softest))]
    return []


def _everywhere(fine: FineStructure, lamp: int, known: Array) -> bool:
    """Test whether a photograph is softer than the others in each quarter: noise and gloss are not."""
    ratios = []
    for quarter in range(4):
        contrast, _ = _contrast(fine.part(fine.quarters == quarter))
        middle = float(np.median(contrast[known]))
        if middle > 0:
            ratios.append(contrast[lamp] / middle)
    return len(ratios) >= 3 and max(ratios) < QUARTERLY


def _contrast(structure: FineStructure) -> tuple[Array, Array]:
    """Slope of each photograph's fine structure on its prediction, and the prediction's power over noise; (L,)."""
    left = structure.left()
    count = structure.lamps
    if not len(left):
        return np.zeros(count), np.zeros(count)
    powers, freedom = structure.grams[:, :count, :count], structure.freedom
    weights = 1 / (left + np.median(left))
    noise = left / np.trace(freedom, axis1=1, axis2=2)
    slope, seen = np.zeros(count), np.zeros(count)
    for lamp in range(count):
        own = freedom[:, lamp, lamp]
        some = own > PREDICTED
        if not some.any():
            continue
        mixture = -freedom[some, lamp] / own[some, None]
        mixture[:, lamp] = 0
        common = np.einsum("tk,tk->t", mixture, powers[some][:, lamp])
        power = np.einsum("tk,tkl,tl->t", mixture, powers[some], mixture)
        unseen = noise[some] * (mixture**2).sum(axis=1)
        # The noise of a prediction would make every slope flatter.
        signal = float(weights[some] @ (power - unseen))
        slope[lamp] = float(weights[some] @ common) / signal if signal > 0 else 0.0
        seen[lamp] = signal / max(float(weights[some] @ unseen), 1e-30)
    return slope, seen
