"""Predictions of each photograph from the others, and what a photograph that differs from its own shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from nlights_core.agreement.samples import Samples
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField


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
    """
    return []
