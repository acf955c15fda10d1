"""The stage that finds the mask where the manifest leaves it to the photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from nlights_core.capture import Tile
from nlights_core.machine.progress import Progress
from nlights_core.photographs.headers import survey
from nlights_core.reduced_light.borders import find_border, write_border
from nlights_core.reduced_light.samples import sample_photographs
from nlights_core.stages.inputs import facts_of_photographs
from nlights_core.store import Store, Work, describe

RESTS_ON = ("photographs", "reduced_light")
"""Departments whose code decides the result, beside what all results rest on."""

FILE = "mask.tif"
"""The mask itself, 1 bit a pixel."""


def mask(store: Store, tile: Tile, flats: bool) -> Work:
    """Mask of the artwork: ``mask.tif``, and ``border.json`` where that is not all.

    ``flats``: whether the recipe uses the photographs of the flat.
    """
    facts: dict[str, Any] = facts_of_photographs(store, tile, "frames")
    if flats:
        facts |= facts_of_photographs(store, tile, "flats")
    ref, record = describe("mask", tile.artwork, tile.name, rests_on=RESTS_ON, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        info = survey(tile)
        with store.scratch() as scratch:
            samples = sample_photographs(tile, flats, scratch, progress)
        border = find_border(samples)
        inside = np.ones((info.rows, info.columns), bool)
        if border is not None:
            inside = border.mask(info.rows, info.columns, samples.block)
        write_border(folder, border)
        # Bits are packed, and written by Python.  Other arrays tifffile leaves to numpy, which says nothing when
        # the disk is full at the very end: they go through `nlights_core.files.tiffs`.
        tifffile.imwrite(folder / FILE, inside)

    return Work(ref, record, make)
