"""Truncation: files whose pixels end before the picture does, filled up with zeros."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.samples import Samples

LEAST_SHARE = 0.01
"""Share of a file's rows that must be zero.  Sound photographs have none: even a black border has noise,
and what a lens correction blackens is black in every photograph."""

ABRUPT = 0.1
"""Light just above the zeros, as a share of what it would be by another photograph: a shadow fades, a file ends.
Sound pictures of objects on black cloth, in 8 bits, fade to below 0.02; what a file lost ends at about 1."""

LIT = 0.002
"""Light, as a share of saturation, that another photograph must show where one is zero: two numbers of 8 bits
are not more."""


def find_truncated(samples: Samples, tile: Tile) -> list[CaptureWarning]:
    """Look for files that are zero from some row to the end, where other photographs are not.

    Parameters
    ----------
    samples : Samples
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        One for each file, with its lamp; the dark frame has none.
    """
    rows, found = samples.rows, []
    brightest = np.max(
        [light.max(axis=0) for light in (rows.frames, rows.flats) if light is not None], axis=0
    )
    for paths, light in ((tile.frames, rows.frames), (tile.flats, rows.flats)):
        if paths is None or light is None:
            continue
        usual = np.median(light, axis=0)
        for lamp, own in zip(samples.lamps, light, strict=True):
            share = zero_share(own, usual, brightest)
            if share:
                found.append(_told(paths[lamp], f" (lamp {lamp})", (lamp,), share))
    if tile.dark is not None and rows.dark is not None:
        share = zero_share(rows.dark, np.full(len(rows.dark), np.median(rows.dark)), brightest)
        if share:
            found.append(_told(tile.dark, " (the dark frame)", (), share))
    return found


def zero_share(rows: Array, usual: Array, brightest: Array) -> float:
    """Share of rows at the end of a file that are missing.

    Parameters
    ----------
    rows : (h,) array
        Mean light of the rows of the file, before the dark frame, shares of saturation.
    usual : (h,) array
        The same of a whole file.
    brightest : (h,) array
        The brightest of all files.

    Returns
    -------
    float
        0 where the rows are not zero, or fade to zero as shadows do, or are black in all files.
    """
    if not rows.any():
        return 0.0
    end = len(rows) - int(np.argmax(rows[::-1] != 0))
    # The last row that is not zero may be one in which the file ends.
    above = slice(max(0, end - 4), max(1, end - 1))
    whole = np.median(rows[:end]) * np.mean(usual[above]) / max(float(np.median(usual[:end])), 1e-9)
    abrupt = np.mean(rows[above]) > ABRUPT * whole
    lit = end < len(rows) and np.median(brightest[end:]) > LIT
    share = 1 - end / len(rows)
    return share if share >= LEAST_SHARE and abrupt and lit else 0.0


def _told(path: Path, whose: str, lamps: tuple[str, ...], share: float) -> CaptureWarning:
    return CaptureWarning(
        "truncated",
        f"{path.name}{whose}: its last {share:.1%} of rows are zero in all colours, where other photographs show "
        "something; a whole file has no such rows: a copy or an export broke off, so copy the file again from the "
        "camera or export it anew",
        lamps,
        100 * share,
        "% of rows",
    )
