"""Movement: photographs that do not lie on each other, because camera or artwork moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlights_core.frames import Array
from nlights_core.movement.details import Detail, Surroundings
from nlights_core.movement.fine_structure import FineStructure, fine_structure, join
from nlights_core.movement.mixtures import Departure, departures, disorder
from nlights_core.movement.weighed_structures import (
    Known,
    clearest_structures,
    misfit_of,
    structures,
    weighed_structure,
)
from nlights_core.reduced_light.explanations import Misfit

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

MOSTLY = 0.4
"""The same of a single photograph that is told: less may be the movement of another."""

MIXED = 3
"""Sizes of details, from the finest, in which photographs are compared with mixtures of the others: of coarser ones
there are too few samples to know the mixtures."""

BEGUN = 3.2
"""Standard errors from which on a photograph is followed by what departs from the mixture of the others.  Moved ones
mostly begin with that where they drown in noise; of 85 sound captures 4 begin, and end elsewhere: none is told."""

ALONE = 0.4
"""How far all others may still seem to lie apart when one is brought back, as a share of its movement: it reaches
0.3 where a photograph drowns in noise, and 0.6 and more where none moved, or several did."""

CLEARLY = 2.0
"""How many times as much as the other's must be what the movement of one of two photographs takes off the disorder,
where either could be the only one that moved: it was 1.1 where the wrong one seemed better, else 6 and 17."""

FARTHEST = 5.0
"""How far that is believed, px: what lies farther apart is not seen in fine details."""

STRIDE = 2.5
"""Longest step of that, px."""

TILES = 12
"""Tiles that must show something: fewer do not say whether a photograph moved or a highlight did."""

FEW_TILES = 6
"""The same of coarse details, which have fewer, and which finer ones confirm."""

ROUNDS = 8
"""Rounds at most at each size of details; one is enough where nothing moved."""

BETTER, ROBUSTLY = 0.98, 0.995
"""What bringing the photographs back must leave of the disagreement, at most.  It is mostly noise where the
artwork has hardly any texture, and gloss where it has strong varnish: there 2 px leave up to 0.992, and the second
limit holds for what was found where highlights had little say."""

SETTLED = 0.05
"""Change of a movement in samples below which a round was the last."""

FINAL = 0.02
"""Change of a movement below which its last measurement has settled, px."""

SURE = 0.08
"""Standard error up to which a movement's amount is told, px.  Of 42 so sure that drowned in noise none was
wrong by more than 0.16 px; of those at 0.08 to 0.1 one by 0.36, and at 0.12 by up to 0.54."""

SURE_TWICE, CONFIRMED = 0.15, 0.15
"""The same where the lamps' directions gave the same movement, to so many px: of 10 such, all below 0.125,
none was wrong by more than 0.22 px."""

AGREED = 0.3
"""By how much a quarter that is sure may disagree about a movement whose amount is told, px."""


@dataclass(frozen=True)
class Moves:
    """Movements of photographs against most of the others.

    Attributes
    ----------
    pixels : (L, 2) float array
        Right and down, px; 0 where none is certain.
    together : bool
        Whether those that moved moved alike.
    measured : tuple of int
        Photographs whose movement is sure, and in all quarters the same.
    """

    pixels: Array
    together: bool
    measured: tuple[int, ...] = ()


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
    known: Known = {}
    still = np.zeros((len(around.relative.lamps), 2))
    finest = _finest(levels, around, still, known)
    moves = Moves(still, False)
    steps = not finest.clear.all()
    if steps:
        # A shadow that is too thin to be seen lies beside steps that cast wider ones under other lamps.
        moves = _moves(levels, around, known, True, True)
    if not moves.pixels.any():
        # Beside steps, what the photographs agree about may be the shadows' edges.
        moves = _moves(levels, around, known, False, not steps)
        if steps and moves.pixels.any():
            moves = _seen_beside_steps(levels, around, moves)
    elif steps and not moves.measured:
        # What is clear of steps may be too little to measure.
        moves = _refine(levels, around, known, moves, None, False)
    return moves, _finest(levels, around, moves.pixels, known)


def _finest(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array, known: Known
) -> FineStructure:
    """Fine structure of the finest details, brought back."""
    weighed_structure(levels[:1], around, moves, known, False)
    return known[levels[0][0].scale, moves.tobytes(), False][0]


def _moves(
    levels: Sequence[Sequence[Detail]], around: Surroundings, known: Known, clear: bool, robust: bool
) -> Moves:
    """Movements that all tiles show, or only those clear of steps; ``robust``: highlights have little say."""
    still = np.zeros((len(around.relative.lamps), 2))
    alone = _alone(levels, around, known, clear)
    if alone.pixels.any():
        alone = _refine(levels, around, known, alone, None, clear)
        if alone.measured:
            return alone
    moves = Moves(still, False)
    for level in reversed(range(len(levels))):
        moves = _settled(levels, around, known, clear, robust, level, moves)
    if alone.pixels.any():
        return _refine(levels, around, known, alone, moves.pixels, clear)
    if not moves.pixels.any():
        return moves
    for details in levels[:3]:
        brought, left = (fine_structure(details, around, way) for way in (moves.pixels, still))
        if clear:
            brought, left = brought.part(brought.clear), left.part(left.clear)
        if brought.share() <= (ROBUSTLY if robust else BETTER) * left.share():
            return _refine(levels, around, known, moves, moves.pixels, clear)
    return Moves(still, False)


def _settled(
    levels: Sequence[Sequence[Detail]],
    around: Surroundings,
    known: Known,
    clear: bool,
    robust: bool,
    level: int,
    moves: Moves,
) -> Moves:
    """Movements as far as details of one size and all coarser ones are certain of them, from those known so far."""
    scale = levels[level][0].scale
    least = FOLLOWED * scale if level else LEAST
    for _ in range(ROUNDS):
        structure = weighed_structure(levels[level:], around, moves.pixels, known, clear, robust)
        before = moves.pixels
        if np.count_nonzero(structure.left() > 0) < (FEW_TILES if level else TILES):
            return Moves(np.zeros_like(before), False)
        moves = _follow(structure, before, least, level == 0)
        if np.abs(moves.pixels - before).max() < SETTLED * scale:
            break
    return moves


def _alone(levels: Sequence[Sequence[Detail]], around: Surroundings, known: Known, clear: bool) -> Moves:
    """The movement of one photograph that is no mixture of the others, whatever gloss and dark paint do to them."""
    still = np.zeros((len(around.relative.lamps), 2))
    nothing = Moves(still, False)
    first = departures(structures(levels[1:MIXED] or levels, around, still, known, clear))
    scores = [_score(one) for one in first]
    # Where there is gloss, the photograph of the opposite lamp may seem to have moved the other way.
    likely = [int(lamp) for lamp in np.argsort(scores)[-2:] if scores[lamp] >= BEGUN]
    before = disorder(structures(levels[:MIXED], around, still, known, clear))
    tried = []
    for lamp in likely:
        moves = Moves(still, False)
        for some in (levels[1:MIXED] or levels, levels[:MIXED]):
            moves, last = _brought(some, around, known, clear, moves, [lamp])
        if _is_alone(last, lamp, float(np.hypot(*moves.pixels[lamp]))):
            left = disorder(structures(levels[:MIXED], around, moves.pixels, known, clear))
            tried.append((before - left, moves))
    gains = sorted((gain for gain, _ in tried), reverse=True)
    if not tried or (len(tried) > 1 and gains[0] < CLEARLY * gains[1]):
        return nothing
    return max(tried, key=lambda one: one[0])[1]


def _is_alone(last: Sequence[Departure], lamp: int, size: float) -> bool:
    """Test whether a movement is certain, everywhere the same, and no other photograph moved beside."""
    quarters = [one.size for one in last[lamp].quarters()]
    others = [one for k, one in enumerate(last) if k != lamp]
    alone = max(one.size for one in others) < ALONE * size and max(map(_score, others)) < BEGUN
    same = len(quarters) > 2 and bool(np.median(quarters) < QUARTERS * size)
    return LEAST < size < FARTHEST and size > CERTAIN * last[lamp].error and alone and same


def _score(departure: Departure) -> float:
    """Standard errors by which a photograph seems moved; 0 where that is not told anyway."""
    return departure.size / departure.error if departure.size > LEAST else 0.0


def _brought(
    levels: Sequence[Sequence[Detail]],
    around: Surroundings,
    known: Known,
    clear: bool,
    moves: Moves,
    lamps: Sequence[int],
) -> tuple[Moves, list[Departure]]:
    """Movements of some photographs followed to where they are mixtures of the others, and what departs there."""
    pixels = moves.pixels.copy()
    for _ in range(ROUNDS):
        found = departures(structures(levels, around, pixels, known, clear))
        steps = np.array([found[lamp].step for lamp in lamps])
        if moves.together:
            weights = np.array([found[lamp].error for lamp in lamps]) ** -2.0
            steps[:] = weights @ steps / weights.sum()
        steps *= np.minimum(1, STRIDE / np.maximum(np.hypot(*steps.T), FINAL))[:, None]
        pixels[lamps] += steps
        if np.abs(steps).max() < FINAL:
            break
    return replace(moves, pixels=pixels), found


def _refine(
    levels: Sequence[Sequence[Detail]],
    around: Surroundings,
    known: Known,
    moves: Moves,
    modelled: Array | None,
    clear: bool,
) -> Moves:
    """The same movements, measured where the photographs are mixtures of each other, and which are sure.

    ``modelled``: what the lamps' directions gave, which has a say.
    """
    lamps = np.flatnonzero(moves.pixels.any(axis=1)).tolist()
    moves, found = _brought(levels[:MIXED], around, known, clear, moves, lamps)
    kept = np.where(np.hypot(*moves.pixels.T)[:, None] > LEAST, moves.pixels, 0.0)
    limits = np.full(len(moves.pixels), SURE)
    if modelled is not None:
        limits[np.hypot(*(moves.pixels - modelled).T) < CONFIRMED] = SURE_TWICE
    measured = tuple(lamp for lamp in lamps if _agree(found[lamp], float(limits[lamp])))
    return replace(moves, pixels=kept, measured=measured)


def _seen_beside_steps(levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Moves) -> Moves:
    """Keep the movements that tiles clear of steps rather show than not; all, where these are too few."""
    there = join(clearest_structures(levels, around, moves.pixels))
    if there.clear.all() or np.count_nonzero(there.clear) < TILES:
        return moves
    kept = moves.pixels.copy()
    for lamp in np.flatnonzero(moves.pixels.any(axis=1)):
        moved, still = moves.pixels[lamp], moves.pixels.copy()
        still[lamp] = 0
        here = join(clearest_structures(levels, around, still))
        # Noise lengthens gradients, so a step would come out short; which way each place pulls stays right.
        if sum(_pull(one.part(one.clear), int(lamp)) @ moved for one in (here, there)) <= 0:
            kept[lamp] = 0
    return replace(moves, pixels=kept, measured=tuple(k for k in moves.measured if kept[k].any()))


def _pull(structure: FineStructure, lamp: int) -> Array:
    """Direction in which some tiles pull a lamp's photograph, (2,): the slope of what is left unexplained."""
    count = structure.lamps
    return np.asarray(-structure.products[:, [count + lamp, 2 * count + lamp], :count].sum(axis=(0, 2)))


def _agree(departure: Departure, sure: float) -> bool:
    """Test whether a movement is sure, and all quarters would leave the photograph where the whole put it."""
    apart = [one.size < max(AGREED, 3 * one.error) for one in departure.quarters()]
    return departure.error < sure and all(apart)


def _follow(structure: FineStructure, moves: Array, least: float, last: bool) -> Moves:
    """Better movements, as far as they are certain and not below ``least`` px."""
    misfit = misfit_of(structure, moves)
    count = len(moves)
    most = misfit.level - misfit.least(range(count))[0]
    best, enough = Moves(np.zeros_like(moves), False), False
    before: tuple[int, ...] = ()
    for size, together in misfit.kinds():
        ranked = misfit.ranked(size, together, before)
        if not ranked:
            break
        rest, lamps, pixels = ranked[0]
        sizes = np.hypot(*pixels[list(lamps)].T)
        sure = sizes.min() > least and _certain(
            structure, misfit, moves, lamps, together, pixels, 3 if last else 2
        )
        if enough and not sure:
            break
        explained = (misfit.level - rest) / max(most, 1e-9)
        # A movement of several must explain what there is: gloss lets some of many sets seem to move alike.
        least_share = EXPLAINED if size != 1 else MOSTLY if last else 0
        if sure and explained > least_share and not (enough and together):
            best, before = Moves(pixels, together), lamps
        enough = enough or explained > EXPLAINED
    return best


def _certain(
    structure: FineStructure,
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
    scores = (structure.products @ combination)[:, count:]
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
            own = structure.products[inside].sum(axis=0)
            pair = [count + lamp, 2 * count + lamp]
            # With all else as found, what movement this quarter alone would want beside.
            wanted = np.linalg.lstsq(own[np.ix_(pair, pair)], own[pair] @ combination, rcond=1e-3)[0]
            if own[pair, pair].any():
                apart.append(float(np.hypot(*wanted)))
        if len(apart) < quarters or np.median(apart) > QUARTERS * size:
            return False
    return True
