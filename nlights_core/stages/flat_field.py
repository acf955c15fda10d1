"""The stage that says what a flat reads under each lamp."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nlights_core.algorithms import ImageDetrend
from nlights_core.capture import Tile
from nlights_core.capture_warnings import write_warnings
from nlights_core.contracts import verbs
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.lamps.emission import check_stand, write_stand_check
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import Progress
from nlights_core.photographs.block_means import average_blocks
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import block_size, extend_beyond_frame, vignetting, write_flat_field
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.noise import Noise, write_noise
from nlights_core.photographs.turned_flats import warn_of_bow, without_board
from nlights_core.stages.inputs import FLATS, facts_of_photographs, read_lights, size
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("capture_warnings", "integration", "lamps", "photographs")
"""Departments whose code decides the result, beside what all results rest on."""

ROWS = 8
"""Of each block of a flat, that are looked at: smoothed, that leaves 0.01 % of noise."""


def flat_field(store: Store, tile: Tile, detrend: ImageDetrend, lights: ArtefactRef) -> Work:
    """Readings of a flat: ``flat_field.npy`` and where its samples are, ``flat_field.json``."""
    turned = [tile.model_copy(update={"flats": one.flats}) for one in tile.turned_flats]
    if "flats" in detrend.needs:
        facts = facts_of_photographs(store, tile, "flats")
        if turned:
            sets = [facts_of_photographs(store, one, "flats")["flats"] for one in turned]
            facts["turned"] = [
                [one.turn_deg, kept] for one, kept in zip(tile.turned_flats, sets, strict=True)
            ]
    else:
        facts = facts_of_photographs(store, tile, "frames") | {"frames": None}
        facts["size"] = size(tile)
    ref, record = describe(
        "flat_field",
        tile.artwork,
        FLATS,
        rests_on=RESTS_ON,
        algorithm=detrend,
        inputs={"lights": lights},
        facts=facts,
    )

    def make(folder: Path, progress: Progress) -> None:
        field = read_lights(store, lights)
        info = survey(tile)
        grid = grid_of(tile, info)
        block = block_size(grid)
        blocks = grid.reduced(block)
        x, y = blocks.x(), blocks.y()
        flats = None
        if "flats" in detrend.needs:
            flats, noise = _read(store, tile, field, block, progress)
            write_noise(folder, noise)
            if turned:
                others = [_read(store, one, field, block, progress)[0] for one in turned]
                turns = [0.0, *(one.turn_deg for one in tile.turned_flats)]
                flats, bow = without_board([flats, *others], turns, field, x, y)
                write_warnings(folder, warn_of_bow(bow, x, y))

        def measured() -> None:
            reading = verbs.flat_field(detrend, flats, field, x, y, info.channels)
            found = extend_beyond_frame(reading, x, y, block * grid.pixel_size)
            if flats is not None and grid.camera is not None and field.near:
                lens = vignetting(reading, field, x, y, grid.camera)
                found = replace(found, camera=grid.camera, vignetting=lens)
            write_flat_field(folder, found)

        def checked() -> None:
            if flats is not None and tile.stand is not None and field.near:
                write_stand_check(folder, check_stand(flats, tile.stand, field.lamps, x, y))

        for _ in in_order(lambda work: work(), (measured, checked)):
            pass

    return Work(ref, record, make)


def _read(
    store: Store, tile: Tile, lights: LightField, block: int, progress: Progress
) -> tuple[Array, Noise]:
    """Readings of a tile's flats on blocks, (L, h, w, C), and their noise."""
    with store.scratch() as scratch, darkroom(tile, scratch, flats=True) as room:
        means = average_blocks(room, block, ROWS, progress)
        room.check()
        noise = room.noise
    flats = means.images / lights.power.astype(np.float32)[:, None, None, :]
    flats[means.saturated] = np.nan
    return np.asarray(flats), noise
