"""Predictions of each photograph from the others, and what a photograph that differs from its own shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nlights_core.agreement.additive_light import find_light, warning_of_light
from nlights_core.agreement.gains import Gain, find_gains
from nlights_core.agreement.oddities import find_odd
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField
from nlights_core.movement.details import LEAST, LEVELS, Detail, Surroundings, read_details
from nlights_core.movement.fine_structure import fine_structure
from nlights_core.movement.moves import Moves, find_moves
from nlights_core.movement.sharpness import find_blurred
from nlights_core.reduced_light.relative_light import FEWEST, RelativeLight, relate_samples
from nlights_core.reduced_light.samples import Samples

FAR = 2.0
"""Movement from which on it explains why a photograph does not agree, px."""

COARSER = 2
"""How many halvings lie between the details that sharpness compares."""

ALIKE = 0.3
"""Movements that differ by less, px, are told as one: it was one push."""


def compare_with_predictions(
    samples: Samples,
    lamps: Sequence[str],
    tile: Tile,
    lights: LightField,
    scratch: Path,
    progress: Callable[[float], None],
) -> list[CaptureWarning]:
    """Look for photographs that moved, are blurred, are exposed otherwise or do not agree with the others.

    Parameters
    ----------
    samples : Samples
    lamps : sequence of str
        Whose photographs can be trusted so far.
    tile : Tile
    lights : LightField
        Where the lamps are.
    scratch : Path
        Folder for what must be kept decoded.
    progress : callable
        Told the share done, from 0.5 to 1.

    Returns
    -------
    list of CaptureWarning
        Empty also where there are too few lamps to predict one from the others.

    Raises
    ------
    TileError
        When a photograph cannot be read.
    """
    if len(lamps) < FEWEST:
        return []
    relative = relate_samples(samples, lamps, lights)
    gains = find_gains(relative) if relative.with_flats else []
    found = _of_gains(gains, relative, tile)
    relative = _levelled(relative, gains)
    odd = find_odd(relative)
    everyone = range(len(lamps))
    rest = [i for i in everyone if odd is None or i != odd[0]]
    light = find_light(relative.of(rest)) if relative.with_flats and len(rest) >= FEWEST else None
    if light is not None and light.certain:
        found.append(warning_of_light(light.share, light.error))
    progress(0.6)
    details, around = read_details(tile, samples, relative, lights, scratch)
    progress(0.8)
    moves, blurred = _compare_details(details, around)
    if odd is not None and np.hypot(*moves.pixels[odd[0]]) > FAR:
        odd = None  # that it moved is why
    spoilt = {lamp for lamp, _ in blurred} | ({odd[0]} if odd else set())
    if spoilt and moves.pixels.any():
        # What is wrong with one photograph makes others seem moved.
        kept = [i for i in everyone if i not in spoilt]
        moves, _ = _compare_details(
            [one.of(kept) for one in details], replace(around, relative=relative.of(kept))
        )
        found += _of_moves(moves, around.relative.of(kept), tile)
    else:
        found += _of_moves(moves, relative, tile)
    found += [_of_blur(lamps[lamp], left, tile) for lamp, left in blurred if odd is None or lamp != odd[0]]
    if odd is not None:
        found.append(_of_odd(lamps[odd[0]], odd[1], tile))
    progress(1.0)
    return found


def _compare_details(
    details: Sequence[Detail], around: Surroundings
) -> tuple[Moves, list[tuple[int, float]]]:
    """Movements of the photographs, and those that are blurred."""
    levels = [list(details)]
    while len(levels) < LEVELS and min(min(one.images.shape[1:]) for one in levels[-1]) >= 2 * LEAST:
        levels.append([one.halved() for one in levels[-1]])
    moves, fine = find_moves(levels, around)
    if len(levels) <= COARSER:
        return moves, []
    return moves, find_blurred(fine, fine_structure(levels[COARSER], around, moves.pixels))


def named(lamps: Sequence[str], tile: Tile) -> str:
    """The photographs of some lamps, for a sentence: file names, and the lamps in brackets."""
    files = ", ".join(tile.frames[lamp].name for lamp in lamps)
    return f"{files} ({'lamp' if len(lamps) == 1 else 'lamps'} {', '.join(lamps)})"


def _levelled(relative: RelativeLight, gains: Sequence[Gain]) -> RelativeLight:
    """The same with gains taken out, so that what follows can be seen."""
    if not gains:
        return relative
    factors = np.ones((len(relative.lamps), 1, 1), np.float32)
    for one in gains:
        factors[list(one.lamps)] = one.gain
    colour = None if relative.colour is None else relative.colour / factors
    return replace(
        relative, light=relative.light / factors, divisors=relative.divisors * factors, colour=colour
    )


def _of_gains(gains: Sequence[Gain], relative: RelativeLight, tile: Tile) -> list[CaptureWarning]:
    """Warnings of photographs at another level."""
    found = []
    for one in gains:
        lamps = tuple(relative.lamps[i] for i in one.lamps)
        changed = 100 * (one.gain - 1)
        many = len(lamps) > 1
        found.append(
            CaptureWarning(
                "exposure",
                f"{named(lamps, tile)}: {'are' if many else 'is'} {abs(changed):.0f} % "
                f"{'brighter' if changed > 0 else 'darker'} than the flat{'s' if many else ''} and the other lamps "
                "say: the photograph or its flat was exposed otherwise, or the lamp shone otherwise; photograph "
                "artwork and flat of this lamp again with the exposure of the others".replace(
                    "this lamp", "these lamps" if many else "this lamp"
                ),
                lamps,
                round(changed, 1),
                "%",
            )
        )
    return found


def _of_moves(moves: Moves, relative: RelativeLight, tile: Tile) -> list[CaptureWarning]:
    """Warnings of photographs that moved; one for those that moved alike."""
    sets: list[list[int]] = []
    for lamp in np.flatnonzero(moves.pixels.any(axis=1)):
        for alike in sets:
            if np.hypot(*(moves.pixels[lamp] - moves.pixels[alike[0]])) < ALIKE:
                alike.append(int(lamp))
                break
        else:
            sets.append([int(lamp)])
    found = []
    for some in sets:
        lamps = tuple(relative.lamps[i] for i in some)
        across, down = (float(value) for value in moves.pixels[some].mean(axis=0))
        measured = set(some) <= set(moves.measured)
        length = float(np.hypot(across, down))
        found.append(
            CaptureWarning(
                "moved",
                f"{named(lamps, tile)}: moved {_amount(across, -down, measured)}: the camera or the artwork was "
                "touched between the photographs; fix both and photograph this tile again",
                lamps,
                round(length, 2) if measured else None,
                "px" if measured else "",
            )
        )
    return found


def _amount(across: float, up: float, measured: bool) -> str:
    """Amount by which photographs moved, for a sentence."""
    if measured:
        return (
            f"by {np.hypot(across, up):.1f} px against the other photographs (dx {across:+.1f}, dy {up:+.1f} px; "
            "x right, y up)"
        )
    return (
        "against the other photographs; by how much could not be measured, because its parts and its details of "
        "several sizes disagree, as gloss or noise makes them"
    )


def _of_blur(lamp: str, left: float, tile: Tile) -> CaptureWarning:
    """The warning of a photograph that is not sharp."""
    return CaptureWarning(
        "blur",
        f"{named([lamp], tile)}: not sharp: its finest detail has {100 * left:.0f} % of the contrast that the other "
        "photographs predict; fix camera and artwork, focus once for all lamps, and photograph it again",
        (lamp,),
        round(100 * left, 1),
        "%",
    )


def _of_odd(lamp: str, differs: float, tile: Tile) -> CaptureWarning:
    """The warning of a photograph that differs, nobody knows why."""
    return CaptureWarning(
        "odd",
        f"{named([lamp], tile)}: does not agree with the others: half of its places differ by more than "
        f"{100 * differs:.0f} % from what they predict; the cause is not known: look at the photograph, see that its "
        "lamp and no other was lit, and photograph it again or leave the lamp out",
        (lamp,),
        round(100 * differs, 1),
        "%",
    )
