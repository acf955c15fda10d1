"""The stage that compares the photographs with one another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nlights_core.agreement.examination import examine_photographs
from nlights_core.capture import Tile
from nlights_core.capture_warnings import write_warnings
from nlights_core.machine.progress import Progress
from nlights_core.reduced_light.borders import find_border, write_border
from nlights_core.reduced_light.samples import Samples
from nlights_core.stages.inputs import facts_of_photographs, read_lights, with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("agreement", "capture_warnings", "lamps", "movement", "photographs", "reduced_light")
"""Departments whose code decides the result, beside what all results rest on."""


def agreement(store: Store, tile: Tile, lights: ArtefactRef, flats: bool) -> Work:
    """Agreement of the photographs with one another and with their flats: ``warnings.json``.

    Where there is no mask, ``border.json`` proposes what may be no part of the artwork, if anything is.
    Nothing that is measured rests on it.  ``flats``: whether the recipe uses the photographs of the flat.
    """
    tile = with_mask(store, tile)
    facts: dict[str, Any] = facts_of_photographs(store, tile, "frames")
    if flats:
        facts |= facts_of_photographs(store, tile, "flats")
    # Sentences name files; a limit may rest on how sure the stand's positions are.
    facts["names"] = {
        "frames": [path.name for path in tile.frames.values()],
        "flats": [path.name for path in tile.flats.values()] if flats and tile.flats else None,
        "dark": tile.dark.name if tile.dark else None,
    }
    facts["told"] = [warning.record() for warning in tile.warnings]
    facts["white_reflectance"] = tile.white_reflectance
    facts["stand"] = tile.stand.model_dump(mode="json", exclude={"source"}) if tile.stand else None
    ref, record = describe(
        "agreement", tile.artwork, tile.name, rests_on=RESTS_ON, inputs={"lights": lights}, facts=facts
    )

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)

        def propose(samples: Samples) -> None:
            if not tile.mask:
                write_border(folder, find_border(samples))

        with store.scratch() as scratch:
            write_warnings(folder, examine_photographs(tile, field, flats, scratch, progress, propose))

    return Work(ref, record, make)
