"""Movement: photographs that do not lie on each other, because camera or artwork moved between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from nlights_core.agreement.details import Detail, Surroundings
from nlights_core.agreement.explanations import Misfit
from nlights_core.agreement.fine_structure import FineStructure, brought_back, fine_structure, join
from nlights_core.agreement.gloss import without_gloss
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

MOSTLY = 0.4
"""The same of a single photograph that is told: less may be the movement of another."""

TILES = 12
"""Tiles that must show something: fewer do not say whether a photograph moved or a highlight did."""

FEW_TILES = 6
"""The same of coarse details, which have fewer, and which finer ones confirm."""

ROUNDS = 8
"""Rounds at most at each size of details; one is enough where nothing moved."""

BETTER = 0.98
"""What bringing the photographs back must leave of the disagreement, at most.  It is mostly noise where the
artwork has hardly any texture."""

NOISY = 0.6
"""Unexplained share of details from which on they are noise and gloss, and say nothing that coarser ones do not."""

SHARED = 0.25
"""Share of its gradients that the others are taken to explain at least: a step is lengthened four times at most."""

SETTLED = 0.05
"""Change of a movement in samples below which a round was the last."""


FINAL = 0.02
"""Change of a movement below which its last measurement has settled, px."""

SURE = 0.15
"""Standard error up to which a size of details, or a quarter, says where a photograph lies, px."""

FAINT = 10
"""The same as a multiple of the best one's: what knows a hundred times less has no say in the movement."""

AGREED = 0.3
"""By how much these may disagree about a movement whose amount is told, px.  Where gloss cannot be taken out they
reach 0.3 to 0.9, and the whole is then wrong by up to 0.8; else it is wrong by up to 0.25."""

MATT = 0.6
"""What is left unexplained without gloss, as a share of what is left with it, from which on it is taken out.
Varnished paintings reach 0.1 to 0.5; noise that is cut off on its bright side leaves 0.8."""

Known = dict[tuple[int, bytes], tuple[FineStructure, dict[bool, FineStructure]]]


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


def weighed_structure(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array, known: Known, clear: bool = False
) -> FineStructure:
    """Fine structure of details of several sizes, per pixel of movement, each by what it knows of the movement.

    ``clear``: of tiles clear of steps alone.
    """
    parts = []
    for details in levels:
        key = (details[0].scale, moves.tobytes())
        if key not in known:
            found = fine_structure(details, around, moves)
            known[key] = found, {}
        found, chosen = known[key]
        if clear not in chosen:
            chosen[clear] = _per_pixel(found.part(found.clear) if clear else found, details[0].scale)
        parts.append(chosen[clear])
    return join(parts)


def _per_pixel(one: FineStructure, scale: int) -> FineStructure:
    """Fine structure of one size, per pixel of movement and by what it knows; of no tile where all is noise."""
    left = one.left()
    if not (left > 0).any() or one.share() > NOISY:
        return one.part(np.zeros(0, np.intp))
    # Noise is in the finest details, and hardly in coarse ones: each counts by its own disagreement.
    weights = one.sizes / (left + np.median(left[left > 0]))
    count = one.powers.shape[1]
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
    if not finest.clear.all():
        # A shadow that is too thin to be seen lies beside steps that cast wider ones under other lamps.
        moves = _moves(levels, around, known, True)
    if not moves.pixels.any():
        moves = _moves(levels, around, known, False)
        if moves.pixels.any():
            moves = _seen_beside_steps(levels, around, moves)
    return moves, _finest(levels, around, moves.pixels, known)


def _finest(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array, known: Known
) -> FineStructure:
    """Fine structure of the finest details, brought back."""
    weighed_structure(levels[:1], around, moves, known, False)
    return known[levels[0][0].scale, moves.tobytes()][0]


def _moves(levels: Sequence[Sequence[Detail]], around: Surroundings, known: Known, clear: bool) -> Moves:
    """Movements that all tiles show, or only those clear of steps."""
    moves = Moves(np.zeros((len(around.relative.lamps), 2)), False)
    for level in reversed(range(len(levels))):
        scale = levels[level][0].scale
        least = FOLLOWED * scale if level else LEAST
        for _ in range(ROUNDS):
            structure = weighed_structure(levels[level:], around, moves.pixels, known, clear)
            before = moves.pixels
            if np.count_nonzero(structure.left() > 0) < (FEW_TILES if level else TILES):
                moves = Moves(np.zeros_like(before), False)
                break
            moves = _follow(structure, before, least, level == 0)
            if np.abs(moves.pixels - before).max() < SETTLED * scale:
                break
    still = np.zeros_like(moves.pixels)
    if not moves.pixels.any():
        return moves
    for details in levels[:3]:
        brought, left = (fine_structure(details, around, way) for way in (moves.pixels, still))
        if clear:
            brought, left = brought.part(brought.clear), left.part(left.clear)
        if brought.share() <= BETTER * left.share():
            return _refine(levels, around, moves, clear)
    return Moves(still, False)


def _refine(levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Moves, clear: bool) -> Moves:
    """The same movements, measured without gloss where that can be told, and by how much parts disagree on them."""
    lamps = np.flatnonzero(moves.pixels.any(axis=1)).tolist()
    pixels = moves.pixels
    for _ in range(ROUNDS):
        parts = clearest_structures(levels, around, pixels, clear)
        structure, before = join(parts), pixels
        if not len(structure.sizes):
            break
        pixels = pixels + misfit_of(structure, np.zeros_like(pixels)).least(lamps, moves.together)[1]
        if np.abs(pixels - before).max() < FINAL:
            break
    measured = tuple(lamp for lamp in lamps if _agree(parts, structure, lamp))
    return Moves(np.where(np.hypot(*pixels.T)[:, None] > LEAST, pixels, 0.0), moves.together, measured)


def clearest_structures(
    levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array, clear: bool = False
) -> list[FineStructure]:
    """Fine structures of all sizes, brought back, without gloss where it is much of what is unexplained."""
    still = np.zeros_like(moves)
    glossy = [fine_structure(one, around, moves) for one in levels]
    cleaned = [without_gloss(brought_back(one, moves), around) for one in levels[0]]
    matt = []
    for _ in levels:
        matt.append(fine_structure(cleaned, around, still))
        cleaned = [one.halved() for one in cleaned]
    if clear:
        glossy, matt = ([one.part(one.clear) for one in some] for some in (glossy, matt))
    shares = [(a.share(), b.share()) for a, b in zip(glossy, matt, strict=True) if a.share() < NOISY]
    chosen = matt if shares and shares[0][1] < MATT * shares[0][0] else glossy
    return [_per_pixel(one, details[0].scale) for one, details in zip(chosen, levels, strict=True)]


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
