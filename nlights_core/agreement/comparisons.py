"""Comparisons of photographs as they are: with their own end, the dark frame, their flats and computed flats."""

from __future__ import annotations

from dataclasses import dataclass, field

from nlights_core.agreement.samples import Samples
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField


@dataclass
class Comparison:
    """Findings so far.

    Attributes
    ----------
    warnings : list of CaptureWarning
        In the order in which they should be read.
    lamps : set of str
        Whose photographs cannot be trusted: they are left out of what follows.
    final : bool
        Whether nothing that follows could be believed.
    """

    warnings: list[CaptureWarning] = field(default_factory=list)
    lamps: set[str] = field(default_factory=set)
    final: bool = False


def compare_photographs(samples: Samples, tile: Tile, lights: LightField | None) -> Comparison:
    """Look for what needs no prediction of one photograph from the others.

    Parameters
    ----------
    samples : Samples
    tile : Tile
    lights : LightField or None
        Where the lamps are.

    Returns
    -------
    Comparison
    """
    return Comparison()
