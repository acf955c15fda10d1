"""Movement: photographs that do not lie on each other, because camera or artwork moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from nlights_core.frames import Array
from nlights_core.movement.details import Detail, Surroundings
from nlights_core.movement.fine_structure import FineStructure, fine_structure, join
from nlights_core.movement.weighed_structures import Known, clearest_structures, misfit_of, weighed_structure
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
"""Share of what free movements of all photographs would explain that a smaller set of them must, or a single one
that was followed before it was certain: photographs that moved reach 0.96 to 1 there, others up to 0.77."""

MOSTLY = 0.4
"""The same of a single photograph that is told: less may be the movement of another."""

LED = 3
"""Sizes of details, from the finest, in which a movement is followed before it is certain: they know of 2 px."""

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

SURE = 0.12
"""Standard error up to which a size of details, or a quarter, says where a photograph lies, px.  Where one size
alone does, nothing contradicts it: at 0.13 the whole is wrong by up to 0.45 under strong varnish on dark relief."""

FAINT = 10
"""The same as a multiple of the best one's: what knows a hundred times less has no say in the movement."""

AGREED = 0.3
"""By how much these may disagree about a movement whose amount is told, px.  Where gloss cannot be taken out they
reach 0.3 to 0.9, and the whole is then wrong by up to 0.8; else it is wrong by up to 0.25."""


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
        Photographs whose movement all that is sure of it agrees about.
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
    moves = Moves(still, False)
    for level in reversed(range(len(levels))):
        moves = _settled(levels, around, known, clear, robust, level, moves)
    if robust and not moves.pixels.any():
        moves = _led(levels, around, known, clear)
    if not moves.pixels.any():
        return moves
    for details in levels[:3]:
        brought, left = (fine_structure(details, around, way) for way in (moves.pixels, still))
        if clear:
            brought, left = brought.part(brought.clear), left.part(left.clear)
        if brought.share() <= (ROBUSTLY if robust else BETTER) * left.share():
            return _refine(levels, around, moves, clear, robust)
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


def _led(levels: Sequence[Sequence[Detail]], around: Surroundings, known: Known, clear: bool) -> Moves:
    """The movement of one photograph that is certain only once it is followed to its end, as beside gloss.

    Steps are short there at first, and the quarters far apart.  So the photograph that explains most is followed
    whatever it is; all that a movement must pass, it must pass where it ends.
    """
    pixels = np.zeros((len(around.relative.lamps), 2))
    for level in reversed(range(min(LED, len(levels)))):
        scale = levels[level][0].scale
        for _ in range(ROUNDS):
            structure = weighed_structure(levels[level:], around, pixels, known, clear, True)
            if np.count_nonzero(structure.left() > 0) < (FEW_TILES if level else TILES):
                return Moves(np.zeros_like(pixels), False)
            before = pixels
            pixels = misfit_of(structure, before).ranked(1, False, ())[0][2]
            if np.abs(pixels - before).max() < SETTLED * scale:
                break
        if np.hypot(*pixels.T).max() < LEAST:
            return Moves(np.zeros_like(pixels), False)
    moves = _settled(levels, around, known, clear, True, 0, Moves(pixels, False))
    lamps = np.flatnonzero(moves.pixels.any(axis=1)).tolist()
    misfit = misfit_of(weighed_structure(levels, around, moves.pixels, known, clear, True), moves.pixels)
    most = misfit.level - misfit.least(range(misfit.lamps))[0]
    enough = lamps and misfit.level - misfit.least(lamps)[0] > EXPLAINED * most
    return moves if enough else Moves(np.zeros_like(pixels), False)


def _refine(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Moves, clear: bool, robust: bool
) -> Moves:
    """The same movements, measured without gloss where that can be told, and by how much parts disagree on them."""
    lamps = np.flatnonzero(moves.pixels.any(axis=1)).tolist()
    pixels = moves.pixels
    for _ in range(ROUNDS):
        parts = clearest_structures(levels, around, pixels, clear, robust)
        structure, before = join(parts), pixels
        if not len(structure.sizes):
            break
        pixels = pixels + misfit_of(structure, np.zeros_like(pixels)).least(lamps, moves.together)[1]
        if np.abs(pixels - before).max() < FINAL:
            break
    measured = tuple(lamp for lamp in lamps if _agree(parts, structure, lamp))
    return Moves(np.where(np.hypot(*pixels.T)[:, None] > LEAST, pixels, 0.0), moves.together, measured)


def _seen_beside_steps(levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Moves) -> Moves:
    """Keep the movements that tiles clear of steps rather show than not; all, where these are too few."""
    there = join(clearest_structures(levels, around, moves.pixels, False))
    if there.clear.all() or np.count_nonzero(there.clear) < TILES:
        return moves
    kept = moves.pixels.copy()
    for lamp in np.flatnonzero(moves.pixels.any(axis=1)):
        moved, still = moves.pixels[lamp], moves.pixels.copy()
        still[lamp] = 0
        here = join(clearest_structures(levels, around, still, False))
        # Noise lengthens gradients, so a step would come out short; which way each place pulls stays right.
        if sum(_pull(one.part(one.clear), int(lamp)) @ moved for one in (here, there)) <= 0:
            kept[lamp] = 0
    return replace(moves, pixels=kept, measured=tuple(k for k in moves.measured if kept[k].any()))


def _pull(structure: FineStructure, lamp: int) -> Array:
    """Direction in which some tiles pull a lamp's photograph, (2,): the slope of what is left unexplained."""
    count = structure.powers.shape[1]
    return np.asarray(-structure.products[:, [count + lamp, 2 * count + lamp], :count].sum(axis=(0, 2)))


def _agree(sizes: Sequence[FineStructure], whole: FineStructure, lamp: int) -> bool:
    """Test whether details of all sizes, and the quarters, would leave a lamp's photograph where the whole put it."""
    quarters = [whole.part(whole.quarters == quarter) for quarter in range(4)]
    levels = [_wanted(one, lamp) for one in sizes if len(one.sizes)]
    limit = min(SURE, FAINT * min((error for _, error in levels), default=0.0))
    sure = [place for place, error in levels if error < limit]
    apart = [a - b for a, b in combinations([*sure, np.zeros(2)], 2)]
    apart += [
        place for place, error in (_wanted(one, lamp) for one in quarters if len(one.sizes)) if error < limit
    ]
    return bool(sure) and all(np.hypot(*one) < AGREED for one in apart)


def _wanted(structure: FineStructure, lamp: int) -> tuple[Array, float]:
    """Movement that some tiles would want beside, px, and its standard error."""
    count = structure.powers.shape[1]
    pair = [count + lamp, 2 * count + lamp]
    own = structure.products.sum(axis=0)[np.ix_(pair, pair)]
    steps = structure.products[:, pair, :count].sum(axis=2) @ np.linalg.pinv(own)
    unknown = np.linalg.matrix_rank(own) < 2
    return -steps.sum(axis=0), float("inf") if unknown else float(np.sqrt((steps**2).sum()))


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
