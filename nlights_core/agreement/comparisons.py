"""Comparisons of photographs as they are: with their own end, the dark frame, their flats and computed light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from nlights_core.agreement.albedos import find_odd_albedo
from nlights_core.agreement.dark_frames import find_lit_dark
from nlights_core.agreement.exchanges import find_exchanged
from nlights_core.agreement.exposures import find_odd_exposures
from nlights_core.agreement.firing import find_unlit
from nlights_core.agreement.tone_curves import find_tone_curve
from nlights_core.agreement.truncation import find_truncated
from nlights_core.agreement.turns import ACROSS, find_turned, find_turned_together
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField
from nlights_core.reduced_light.coarse_light import CoarseLight, reduce_to_cells
from nlights_core.reduced_light.samples import Samples

LEAST_LAMPS = 3
"""Fewer photographs than that can be measured by nothing."""


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
        self.lamps |= _lamps_of(found)

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
    truncated = find_truncated(samples, tile)
    found.add(truncated)
    whole = samples.of(found.trusted(samples.lamps))
    # The dark frame is subtracted from every photograph: with a wrong one none can be judged.
    lit = [] if any(not warning.lamps for warning in truncated) else find_lit_dark(whole, tile)
    found.add(lit)
    if len(whole.lamps) < LEAST_LAMPS or any(not warning.lamps for warning in found.warnings):
        found.final = True
        return found
    found.add(find_unlit(whole, tile))
    cells = reduce_to_cells(samples, tile, lights)
    finer = reduce_to_cells(samples, tile, lights, ACROSS)
    found.add(find_turned_together(cells.of(found.trusted(samples.lamps)), tile))
    found.add(_find_misplaced(cells, finer, found.trusted(samples.lamps), tile))
    if len(found.trusted(samples.lamps)) < LEAST_LAMPS:
        found.final = True
        return found
    rest = cells.of(found.trusted(samples.lamps))
    curve = find_tone_curve(samples, rest, tile)
    if curve:
        # Neither levels nor predictions mean anything before the curve is undone.
        found.add(curve)
        found.final = True
        return found
    exposures = find_odd_exposures(rest, tile)
    # One fault, one sentence: where the files note the cause, the albedo that it gives is not told.
    if not any(not warning.lamps and warning.value is not None for warning in exposures):
        found.add(find_odd_albedo(samples, rest.lamps, tile))
    found.add(exposures)
    return found


def _find_misplaced(
    cells: CoarseLight, finer: CoarseLight, lamps: tuple[str, ...], tile: Tile
) -> list[CaptureWarning]:
    """Tell exchanged photographs from turned ones, which on a stand with opposite lamps look alike."""
    found: list[CaptureWarning] = []
    while True:
        turned = find_turned(finer.of(lamps), tile)
        suspects = {warning.lamps[0]: float(warning.value or 1) ** -2 for warning in turned}
        exchanged = find_exchanged(cells.of(lamps), tile, suspects)
        alone = [warning for warning in turned if warning.lamps[0] not in _lamps_of(exchanged)]
        # One by one, the most certain first: others may seem wrong by it.
        told = [max(alone, key=lambda warning: float(warning.value or 1))] if alone else exchanged
        if not told:
            return found
        found += told
        lamps = tuple(lamp for lamp in lamps if lamp not in _lamps_of(told))


def _lamps_of(warnings: Sequence[CaptureWarning]) -> set[str]:
    return {lamp for warning in warnings for lamp in warning.lamps}
