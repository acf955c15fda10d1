"""Lamps that did not fire: photographs by nothing but the room's light."""

from __future__ import annotations

import numpy as np

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.coarse_light import CELLS, cell_medians
from nlights_core.reduced_light.samples import Samples

LEAST_RATIO = 0.1
"""Photograph over flat, as a share of the median lamp's, below which a lamp did not fire.  Sound lamps stay above
0.75 whatever the artwork, exchanged ones above 0.13; room light of 1 % leaves 0.07 at most."""

LEAST_LEVEL = 0.1
"""Light of a flat as a share of the median flat's: lamps of one stand differ by less than a factor of 3."""

LEAST_LEVEL_ALONE = 0.05
"""The same of a photograph that has no flat: a slope turned away, or another strength, leaves more than 0.15."""


def find_unlit(samples: Samples, tile: Tile) -> list[CaptureWarning]:
    """Look for photographs and flats whose lamp did not fire.

    Parameters
    ----------
    samples : Samples
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        One for each photograph.
    """
    edge = max(1, samples.grid.columns // CELLS)
    frames = cell_medians(samples.frames, edge)
    found = []
    if samples.flats is None or tile.flats is None:
        levels = _levels(frames)
        return [
            _told(tile.frames[lamp].name, lamp, level, LEAST_LEVEL_ALONE)
            for lamp, level in zip(samples.lamps, levels, strict=True)
            if level < LEAST_LEVEL_ALONE
        ]
    flats = cell_medians(samples.flats, edge)
    levels = _levels(flats)
    lit = ~(levels < LEAST_LEVEL)
    ratios = np.where(flats > 0, frames / np.where(flats > 0, flats, 1), np.nan)
    # Of a lamp whose flat is dark, the photograph is compared with the other photographs.
    shares = np.where(lit, _levels(ratios, lit), _levels(frames))
    for lamp, level, share in zip(samples.lamps, levels, shares, strict=True):
        if level < LEAST_LEVEL:
            found.append(
                _told(f"{tile.flats[lamp].parent.name}/{tile.flats[lamp].name}", lamp, level, LEAST_LEVEL)
            )
        if share < LEAST_RATIO:
            found.append(_told(tile.frames[lamp].name, lamp, share, LEAST_RATIO))
    return found


def _levels(light: Array, among: Array | None = None) -> Array:
    """Mean of each picture (L, h, w) over that of the median of some; NaN where nothing is known."""
    pictures = light.reshape(len(light), -1)
    counts = np.isfinite(pictures).sum(axis=1)
    means = np.nansum(pictures, axis=1) / np.where(counts, counts, np.nan)
    usual = np.nanmedian(means if among is None else means[among])
    return means / usual if usual > 0 else np.full(len(means), np.nan)


def _told(name: str, lamp: str, share: float, limit: float) -> CaptureWarning:
    return CaptureWarning(
        "not-fired",
        f"{name} (lamp {lamp}): the lamp did not fire: the photograph has {share:.1%} of the light of the "
        f"others, where a lamp that fires gives more than {limit:.0%}; see to the lamp and its cable, and "
        "photograph again",
        (lamp,),
        100 * share,
        "% of the others' light",
    )
