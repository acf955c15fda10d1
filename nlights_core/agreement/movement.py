"""Movement: photographs that do not lie on each other, because camera or artwork moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlights_core.agreement.details import Detail, Surroundings
from nlights_core.agreement.explanations import Misfit
from nlights_core.agreement.fine_structure import FineStructure, fine_structure
from nlights_core.frames import Array

LEAST = 0.35
"""Movement that is told, px.  Sound captures reach 0.02, behind a frame 20 mm deep 0.3."""

CERTAIN = 6.0
"""How many standard errors, found from tile to tile, a movement must have.  Sound captures reach 8, where
the quarters do not agree; a movement of 2 px has 40 to 7000 where the artwork has texture."""

QUARTERS = 0.35
"""How far the movements that the quarters of a photograph show may lie from the whole's, as a share of it.
Moved photographs reach 0.1, and 0.25 where there is hardly any texture; sound ones mostly 0.4 to 4."""

FOLLOWED = 0.2
"""Movement in samples of a coarse detail from which on it is followed to finer ones."""

EXPLAINED = 0.85
"""Share of what free movements of all photographs would explain that a smaller set of them must."""

TILES = 12
"""Tiles that must show something: fewer do not say whether a photograph moved or a highlight did."""

FEW_TILES = 6
"""The same of coarse details, which have fewer, and which finer ones confirm."""

ROUNDS = 8
"""Rounds at most at each size of details; one is enough where nothing moved."""

BETTER = 0.98
"""What bringing the photographs back must leave of the disagreement, at most.  It is mostly noise where the
artwork has hardly any texture."""

SETTLED = 0.05
"""Change of a movement in samples below which a round was the last."""


@dataclass(frozen=True)
class Moves:
    """Movements of photographs against most of the others.

    Attributes
    ----------
    pixels : (L, 2) float array
        Right and down, px; 0 where none is certain.
    together : bool
        Whether those that moved moved alike.
    """

    pixels: Array
    together: bool


def _misfit(products: Array, moves: Array) -> Misfit:
    """Misfit by total movements, of products (3L, 3L) after ``moves`` (samples) were taken back."""
    count = len(moves)
    ones, done = np.ones(count), moves.T.ravel()
    matrix, vector = products[count:, count:], products[count:, :count] @ ones
    level = ones @ products[:count, :count] @ ones - 2 * vector @ done + done @ matrix @ done
    return Misfit(matrix, vector - matrix @ done, float(level), count)


def find_moves(levels: Sequence[Sequence[Detail]], around: Surroundings) -> tuple[Moves, FineStructure]:
    """Follow the photographs from coarse details to fine ones.

    Parameters
    ----------
    levels : sequence of sequences of Detail
        From the finest to the coarsest.
    around : Surroundings

    Returns
    -------
    Moves
    FineStructure
        The finest, brought back.
    """
    moves = Moves(np.zeros((len(around.relative.lamps), 2)), False)
    for level, details in reversed(list(enumerate(levels))):
        scale = details[0].scale
        least = FOLLOWED * scale if level else LEAST
        step = np.zeros_like(moves.pixels)
        for _ in range(ROUNDS):
            structure = fine_structure(details, around, moves.pixels)
            before = moves.pixels
            if np.count_nonzero(structure.left() > 0) < (FEW_TILES if level else TILES):
                moves = Moves(np.zeros_like(before), False)
                break
            moves = _follow(structure, before, scale, least, level == 0)
            step, last = moves.pixels - before, step
            if np.abs(step).max() < SETTLED * scale:
                break
            # Noise in the gradients makes every step too short by the same share: go where they lead.
            share = float(np.sum(step * last)) / max(float(np.sum(last * last)), 1e-9)
            if 0 < share < 0.9:
                moves = Moves(moves.pixels + step * share / (1 - share), moves.together)
    if moves.pixels.any():
        still = np.zeros_like(moves.pixels)
        pairs = (
            [fine_structure(one, around, way).share() for way in (moves.pixels, still)] for one in levels[:3]
        )
        if all(brought > BETTER * left for brought, left in pairs):
            return Moves(still, False), fine_structure(levels[0], around, still)
    return moves, structure


def _follow(structure: FineStructure, moves: Array, scale: int, least: float, last: bool) -> Moves:
    """Better movements, as far as they are certain and not below ``least`` px."""
    nothing = Moves(np.zeros_like(moves), False)
    left = structure.left()
    weights = 1 / (left + np.median(left[left > 0]))
    misfit = _misfit((structure.products * weights[:, None, None]).sum(axis=0), moves / scale)
    count = len(moves)
    most = misfit.level - misfit.least(range(count))[0]
    best, enough = nothing, False
    before: tuple[int, ...] = ()
    for size, together in misfit.kinds():
        ranked = misfit.ranked(size, together, before)
        if not ranked:
            break
        rest, lamps, pixels = ranked[0]
        sizes = np.hypot(*pixels[list(lamps)].T) * scale
        sure = sizes.min() > least and _certain(
            structure, weights, misfit, moves / scale, lamps, together, pixels, 3 if last else 2
        )
        if enough and not sure:
            break
        if sure and not (enough and together):
            best, before = Moves(pixels * scale, together), lamps
        enough = enough or misfit.level - rest > EXPLAINED * most
    return best


def _certain(
    structure: FineStructure,
    weights: Array,
    misfit: Misfit,
    done: Array,
    lamps: Sequence[int],
    together: bool,
    found: Array,
    quarters: int,
) -> bool:
    """Test whether each movement is much larger than its error, and the same in the quarters of the photographs."""
    count = len(found)
    step = (found - done).T.ravel()
    combination = np.r_[np.ones(count), step]
    chosen = np.r_[list(lamps), [count + i for i in lamps]]
    scores = (structure.products @ combination)[:, count:] * weights[:, None]
    matrix = misfit.matrix[np.ix_(chosen, chosen)]
    spread = np.repeat(np.eye(2), len(lamps), axis=0) if together else np.eye(len(chosen))
    inverse = spread @ np.linalg.pinv(spread.T @ matrix @ spread) @ spread.T
    errors = scores[:, chosen] @ inverse
    for k, lamp in enumerate(lamps):
        size = float(np.hypot(*found[lamp]))
        along = errors[:, [k, len(lamps) + k]] @ found[lamp] / max(size, 1e-9)
        if size < CERTAIN * np.sqrt(along @ along):
            return False
        apart = []
        for quarter in range(4):
            inside = structure.quarters == quarter
            own = (structure.products[inside] * weights[inside, None, None]).sum(axis=0)
            pair = [count + lamp, 2 * count + lamp]
            # With all else as found, what movement this quarter alone would want beside.
            wanted = np.linalg.lstsq(own[np.ix_(pair, pair)], own[pair] @ combination, rcond=1e-3)[0]
            if own[pair, pair].any():
                apart.append(float(np.hypot(*wanted)))
        if len(apart) < quarters or np.median(apart) > QUARTERS * size:
            return False
    return True
