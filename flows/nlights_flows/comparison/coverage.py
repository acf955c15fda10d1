"""Coverage: how many errors of each variant are no larger than the uncertainty it states for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nlights_core.files.tiffs import read_tiff
from nlights_core.frames import Array
from nlights_core.simulation.evaluation import covered


class Coverage:
    """Counts of the errors within their stated uncertainty, of K variants.

    Parameters
    ----------
    folders : sequence of Path
        The tile's products, per variant.
    name : str
        Of the map of standard uncertainties (H, W) among them; a variant that has none is not measured.
    """

    def __init__(self, folders: Sequence[Path], name: str) -> None:
        paths = [folder / name for folder in folders]
        self._stated = [read_tiff(path) if path.is_file() else None for path in paths]
        self._counts = np.zeros((len(paths), 2), np.int64)

    def states(self, variant: int) -> bool:
        """Test whether a variant states its uncertainty."""
        return self._stated[variant] is not None

    def add(self, variant: int, band: slice, errors: Array, known: Array) -> None:
        """Count a band's errors (h, W), where they are ``known`` (h, W)."""
        stated = self._stated[variant]
        if stated is not None:
            self._counts[variant] += covered(errors[known], np.asarray(stated[band])[known])

    def percents(self) -> list[float | None]:
        """Share of the errors that each variant covers, % of pixels; None where it states nothing."""
        return [100 * float(within) / float(of) if of else None for within, of in self._counts]
