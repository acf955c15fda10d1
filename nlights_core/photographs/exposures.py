"""Exposures: whether photographs are neither black nor saturated, counted while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlights_core.errors import TileError
from nlights_core.frames import Array

BLACK = 5e-4
"""A frame whose mean is below this share of saturation shows that its lamp did not fire."""

BURNT = 0.99
"""A frame with more than this share of saturated pixels says nothing."""


@dataclass
class Exposure:
    """Brightness and saturation of one photograph, counted while it was read.

    Attributes
    ----------
    pixels, saturated : int
        Counts inside the mask.
    total : float
        Sum of the grey values, dark subtracted, as fractions of saturation.
    """

    pixels: int = 0
    saturated: int = 0
    total: float = 0.0

    def add(self, values: Array, saturated: Array) -> None:
        """Take in a band: values (n,) and flags (n,)."""
        self.pixels += values.size
        self.saturated += int(np.count_nonzero(saturated))
        self.total += float(values.sum(dtype=np.float64))

    def check(self, name: str, path: Path) -> None:
        """Refuse a photograph that says nothing.

        Raises
        ------
        TileError
            When it is black, or saturated nearly everywhere.
        """
        if not self.pixels:
            return
        if self.saturated > BURNT * self.pixels:
            raise TileError(
                f"{path}: {name}: {self.saturated / self.pixels:.1%} of its pixels are saturated; photograph "
                "again with a shorter exposure, or state the level in encoding.saturation"
            )
        if self.total < BLACK * self.pixels:
            raise TileError(
                f"{path}: {name}: all black (mean {self.total / self.pixels:.5f} of saturation after the "
                f"dark frame, at least {BLACK} is needed); see whether the lamp lit, and photograph again"
            )
