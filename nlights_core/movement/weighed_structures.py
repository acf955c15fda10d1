"""Weighed structures: fine structure of several sizes of details, each by what it knows of movements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nlights_core.frames import Array
from nlights_core.movement.details import Detail, Surroundings
from nlights_core.movement.fine_structure import FineStructure, brought_back, fine_structure, join
from nlights_core.movement.gloss import without_gloss
from nlights_core.reduced_light.explanations import Misfit

NOISY = 0.6
"""Unexplained share of details from which on they are noise and gloss, and say nothing that coarser ones do not."""

SHARED = 0.25
"""Share of its gradients that the others are taken to explain at least: a step is lengthened four times at most."""

MATT = 0.6
"""What is left unexplained without gloss, as a share of what is left with it, from which on it is taken out.
Varnished paintings reach 0.1 to 0.5; noise that is cut off on its bright side leaves 0.8."""

Known = dict[tuple[int, bytes, bool], tuple[FineStructure, dict[bool, FineStructure]]]


def weighed_structure(
    levels: Sequence[Sequence[Detail]],
    around: Surroundings,
    moves: Array,
    known: Known,
    clear: bool = False,
    robust: bool = False,
) -> FineStructure:
    """Fine structure of details of several sizes, per pixel of movement, each by what it knows of the movement.

    ``clear``: of tiles clear of steps alone.  ``robust``: highlights have little say.
    """
    parts = []
    for details in levels:
        found, chosen = _known(details, around, moves, known, robust)
        if clear not in chosen:
            chosen[clear] = _per_pixel(found.part(found.clear) if clear else found, details[0].scale)
        parts.append(chosen[clear])
    return join(parts)


def structures(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array, known: Known, clear: bool
) -> list[tuple[FineStructure, int]]:
    """Fine structure of details of several sizes as it is, highlights having little say, and their samples' edge."""
    found = [(_known(one, around, moves, known, True)[0], one[0].scale) for one in levels]
    return [(one.part(one.clear), scale) for one, scale in found] if clear else found


def _known(
    details: Sequence[Detail], around: Surroundings, moves: Array, known: Known, robust: bool
) -> tuple[FineStructure, dict[bool, FineStructure]]:
    """Fine structure of details of one size, summed once."""
    key = (details[0].scale, moves.tobytes(), robust)
    if key not in known:
        known[key] = fine_structure(details, around, moves, robust), {}
    return known[key]


def _per_pixel(one: FineStructure, scale: int) -> FineStructure:
    """Fine structure of one size, per pixel of movement and by what it knows; of no tile where all is noise."""
    left = one.left()
    if not (left > 0).any() or one.share() > NOISY:
        return one.part(np.zeros(0, np.intp))
    # Noise is in the finest details, and hardly in coarse ones: each counts by its own disagreement.
    weights = one.sizes / (left + np.median(left[left > 0]))
    count = one.lamps
    gradients = np.r_[np.ones(count), np.full(2 * count, 1 / scale)]
    products = one.products * np.outer(gradients, gradients) * weights[:, None, None]
    return replace(one, products=_without_noise(products, count))


def _without_noise(products: Array, count: int) -> Array:
    """Products without that part of the gradients that the others do not share: it would shorten every step."""
    own = np.zeros_like(products)
    lamps = np.arange(count)
    for a, b in ((1, 1), (1, 2), (2, 1), (2, 2)):
        block = products[:, a * count : (a + 1) * count, b * count : (b + 1) * count]
        own[:, a * count + lamps, b * count + lamps] = (block.sum(axis=1) + block.sum(axis=2)) / 2
    matrix, noise = products[:, count:, count:].sum(axis=0), own[:, count:, count:].sum(axis=0)
    values, axes = np.linalg.eigh(matrix)
    back = axes[:, values > 1e-9 * values[-1]] / np.sqrt(values[values > 1e-9 * values[-1]])
    most = float(np.linalg.eigvalsh(back.T @ noise @ back)[-1])
    return np.asarray(products - min(1, (1 - SHARED) / max(most, 1e-9)) * own)


def misfit_of(structure: FineStructure, moves: Array) -> Misfit:
    """Misfit by total movements, px, after ``moves`` were taken back."""
    products = structure.products.sum(axis=0)
    count = len(moves)
    ones, done = np.ones(count), moves.T.ravel()
    matrix, vector = products[count:, count:], products[count:, :count] @ ones
    level = ones @ products[:count, :count] @ ones - 2 * vector @ done + done @ matrix @ done
    return Misfit(matrix, vector - matrix @ done, float(level), count)


def clearest_structures(
    levels: Sequence[Sequence[Detail]],
    around: Surroundings,
    moves: Array,
) -> list[FineStructure]:
    """Fine structures of all sizes, brought back, without gloss where it is much of what is unexplained."""
    still = np.zeros_like(moves)
    glossy = [fine_structure(one, around, moves) for one in levels]
    cleaned = [without_gloss(brought_back(one, moves), around) for one in levels[0]]
    matt = []
    for _ in levels:
        matt.append(fine_structure(cleaned, around, still))
        cleaned = [one.halved() for one in cleaned]
    shares = [(a.share(), b.share()) for a, b in zip(glossy, matt, strict=True) if a.share() < NOISY]
    chosen = matt if shares and shares[0][1] < MATT * shares[0][0] else glossy
    return [_per_pixel(one, details[0].scale) for one, details in zip(chosen, levels, strict=True)]
