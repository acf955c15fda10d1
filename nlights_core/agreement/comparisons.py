"""Comparisons of photographs as they are: with their own end, the dark frame, their flats and computed light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from nlights_core.agreement.albedos import find_odd_albedo
from nlights_core.agreement.coarse_light import reduce_to_cells
from nlights_core.agreement.dark_frames import find_lit_dark
from nlights_core.agreement.exchanges import find_exchanged
from nlights_core.agreement.exposures import find_odd_exposures
from nlights_core.agreement.firing import find_unlit
from nlights_core.agreement.samples import Samples
from nlights_core.agreement.tone_curves import find_tone_curve
from nlights_core.agreement.truncation import find_truncated
from nlights_core.agreement.turns import ACROSS, find_turned
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

    def add(self, found: Sequence[CaptureWarning]) -> None:
        """Take in warnings, and leave their lamps out of what follows."""
        self.warnings += found
        self.lamps |= {lamp for warning in found for lamp in warning.lamps}

    def trusted(self, lamps: Sequence[str]) -> tuple[str, ...]:
        """Those of some lamps that nothing was said about."""
        return tuple(lamp for lamp in lamps if lamp not in self.lamps)


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
    found = Comparison()
    found.add(find_truncated(samples, tile))
    lit = find_lit_dark(samples, tile)
    if lit:
        # It is subtracted from every photograph: none can be judged.
        found.add(lit)
        found.final = True
        return found
    found.add(find_unlit(samples, tile))
    cells = reduce_to_cells(samples, tile, lights)
    found.add(find_exchanged(cells.of(found.trusted(samples.lamps)), tile))
    finer = reduce_to_cells(samples, tile, lights, ACROSS)
    found.add(find_turned(finer.of(found.trusted(samples.lamps)), tile))
    rest = cells.of(found.trusted(samples.lamps))
    found.add(find_tone_curve(samples, rest, tile))
    exposures = find_odd_exposures(rest, tile)
    # One fault, one sentence: where the files note the cause, the albedo that it gives is not told.
    if not any(not warning.lamps and warning.value is not None for warning in exposures):
        found.add(find_odd_albedo(samples, rest.lamps, tile))
    found.add(exposures)
    return found
