"""Examination of a tile's photographs: the order in which faults are looked for, from the grossest to the finest.

A gross fault makes finer ones appear that are not there: a lamp that did not fire seems moved, and
a tone curve looks like additive light.  So what is named takes its lamps out of all that follows.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nlights_core.agreement.comparisons import compare_photographs
from nlights_core.agreement.file_headers import header_warnings
from nlights_core.agreement.number_ranges import range_warnings
from nlights_core.agreement.predictions import compare_with_predictions
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField
from nlights_core.photographs.development import darkroom
from nlights_core.reduced_light.samples import Samples, sample_photographs


def examine_photographs(
    tile: Tile,
    lights: LightField | None,
    flats: bool,
    scratch: Path,
    progress: Callable[[float], None] = lambda _: None,
    seen: Callable[[Samples], object] = lambda _: None,
) -> list[CaptureWarning]:
    """Compare every photograph with its flat, with the stand, and with what the others predict.

    Parameters
    ----------
    tile : Tile
    lights : LightField or None
        Where the lamps are; None where that is not known: then nothing is predicted.
    flats : bool
        Whether the recipe uses the photographs of the flat.
    scratch : Path
        Folder for what must be kept decoded.
    progress : callable
        Told the share done.
    seen : callable
        Given the small pictures, before they are compared.

    Returns
    -------
    list of CaptureWarning
        In the order in which they should be read; empty where all agree.

    Raises
    ------
    TileError
        When a photograph is missing, cannot be read, or does not fit the others.
    """
    told = [*tile.warnings, *header_warnings(tile)]
    for which in (False, True) if flats and tile.flats else (False,):
        with darkroom(tile, scratch, flats=which) as room:
            told += range_warnings(room)
    samples = sample_photographs(tile, flats, scratch, lambda done: progress(0.4 * done))
    seen(samples)
    first = compare_photographs(samples, tile, lights)
    progress(0.5)
    found = first.warnings
    if not first.final and lights is not None:
        rest = first.trusted(samples.lamps)
        predicted = compare_with_predictions(samples, rest, tile, lights, scratch, progress)
        if any(warning.code == "exchanged" for warning in found):
            # The few lamps left tell light that is in all photographs from gloss no more; mended, all will.
            predicted = [warning for warning in predicted if warning.code != "additive-light"]
        found += predicted
    return found + told
