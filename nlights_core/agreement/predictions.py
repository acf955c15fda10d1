"""Predictions of each photograph from the others, and what a photograph that differs from its own shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nlights_core.agreement.additive_light import Light, find_light
from nlights_core.agreement.details import LEAST, LEVELS, read_details
from nlights_core.agreement.gains import Gain, find_gains
from nlights_core.agreement.movement import Moves, find_moves
from nlights_core.agreement.relative_light import FEWEST, RelativeLight, relate_samples
from nlights_core.agreement.samples import Samples
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField

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
    found: list[CaptureWarning] = []
    if len(lamps) >= FEWEST:
        relative = relate_samples(samples, lamps, lights)
        gains = find_gains(relative) if relative.with_flats else []
        found += _of_gains(gains, relative, tile)
        relative = _levelled(relative, gains)
        light = find_light(relative) if relative.with_flats else None
        if light is not None and light.certain:
            found.append(_of_light(light))
        progress(0.6)
        details, around = read_details(tile, samples, relative, lights, scratch)
        progress(0.8)
        levels = [details]
        while len(levels) < LEVELS and min(min(one.images.shape[1:]) for one in levels[-1]) >= 2 * LEAST:
            levels.append([one.halved() for one in levels[-1]])
        moves, _ = find_moves(levels, around)
        found += _of_moves(moves, relative, tile)
    progress(1.0)
    return found


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
    return replace(relative, light=relative.light / factors, divisors=relative.divisors * factors)


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


def _of_light(light: Light) -> CaptureWarning:
    """The warning of light that the flats have not."""
    share = 100 * light.share
    return CaptureWarning(
        "additive-light",
        f"the photographs of the artwork hold light that its lamps did not give: {share:.1f} % (+- "
        f"{100 * light.error:.1f}) of the flats' median, in all of them and not in the flats; darken the room as "
        "for the flats, see that the dark frame is of the same exposure, and photograph the artwork again",
        (),
        round(share, 2),
        "%",
    )


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
        length = float(np.hypot(across, down))
        found.append(
            CaptureWarning(
                "moved",
                f"{named(lamps, tile)}: moved by {length:.1f} px against the other photographs (dx {across:+.1f}, "
                f"dy {-down:+.1f} px; x right, y up): the camera or the artwork was touched between the "
                "photographs; fix both and photograph this tile again",
                lamps,
                round(length, 2),
                "px",
            )
        )
    return found
