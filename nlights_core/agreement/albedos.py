"""Albedos that no surface has: photographs and flats that were not exposed alike, or a flat that is not white."""

from __future__ import annotations

import numpy as np

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.reduced_light.coarse_light import known_medians
from nlights_core.reduced_light.samples import Samples

BRIGHTEST = 1.15
"""Albedo of the brightest 5 % above which it is told.  Whites reflect at most 0.98 (0.93 is reached by sound
captures of paper and gold leaf); highlights are brighter, but under one lamp or two, and here the median counts."""

DARKEST = 0.01
"""Albedo of the brightest 5 % below which it is told: soot has 0.03."""

SHARE = 0.95
"""Quantile of the albedo over the artwork."""


def brightest_albedo(samples: Samples, lamps: tuple[str, ...], tile: Tile) -> float:
    """Albedo that 5 % of the artwork exceed, by photographs over flats under the median lamp; NaN where not known."""
    if samples.flats is None:
        return float("nan")
    chosen = [samples.lamps.index(lamp) for lamp in lamps]
    # Every third sample is plenty.
    frames, flats = samples.frames[chosen, ::3, ::3], samples.flats[chosen, ::3, ::3]
    ratios = np.where(flats > 0, frames / np.where(flats > 0, flats, 1), np.nan)
    medians = known_medians(np.moveaxis(ratios, 0, -1), 0.5)
    known = medians[np.isfinite(medians)]
    if known.size < 100:
        return float("nan")
    return tile.white_reflectance * float(np.quantile(known, SHARE))


def find_odd_albedo(samples: Samples, lamps: tuple[str, ...], tile: Tile) -> list[CaptureWarning]:
    """Look for an albedo that no surface has.

    Parameters
    ----------
    samples : Samples
    lamps : tuple of str
        Whose photographs can be trusted.
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        Of one at most, without lamps.
    """
    albedo = brightest_albedo(samples, lamps, tile)
    if not (albedo > BRIGHTEST or albedo < DARKEST):
        return []
    white = tile.white_reflectance
    if albedo > BRIGHTEST:
        found = f"5 % of the artwork have an albedo of more than {albedo:.2f}, but no surface has more than 1"
        cause = "the flats were exposed less than the photographs of the artwork, or the flat is less white than that"
    else:
        found = f"95 % of the artwork have an albedo of less than {albedo:.4f}, but soot has 0.03"
        cause = "the photographs of the artwork were exposed less than the flats"
    sentence = (
        f"{found} (white_reflectance {white:g}): {cause}; photograph flats and artwork with the same exposure, or "
        "state white_reflectance; normals and heights do not suffer, albedo does"
    )
    return [CaptureWarning("albedo-range", sentence, (), albedo, "albedo")]
