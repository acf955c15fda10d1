"""Correction: what is taken out of developed photographs before a solver sees them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from nlights_core.frames import Array
from nlights_core.photographs.development import Band
from nlights_core.photographs.strips import Blocks, Optics, Strip


class Correction(NamedTuple):
    """Correction of the samples, in the two forms in which they are developed.

    Attributes
    ----------
    of_band : callable
        Makes a band anew.
    of_strip : callable
        Changes the blocks of a strip, all of them, in place; returns what it took out of the apparent colour,
        (h, w, 3) float32.
    """

    of_band: Callable[[Band], Band]
    of_strip: Callable[[Strip, Optics, Blocks], Array]
