"""Refinement of a tile's lamps: samples of its photographs for the fit of strengths and ambient light."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlights_core import strengths
from nlights_core.block_means import block_means
from nlights_core.capture import Tile
from nlights_core.development import bands, darkroom
from nlights_core.emission_on_artwork import fit_emission_on_artwork
from nlights_core.fields import LightField
from nlights_core.images import grey

BLOCKS = 40
"""Across the artwork, where the emission of its lamps is fitted."""

ROWS = 16
"""Of each block, that are looked at."""

SAMPLES = 5000
"""How many pixels the refinement of lamp strengths looks at."""


def refined(tile: Tile, field: LightField, prior: float, scratch: Path) -> LightField:
    """Fit strengths and ambient light to a sample of the photographs, or the emission where it is stated.

    Raises
    ------
    TileError
        When the photographs cannot be read, or show too little.
    """
    with darkroom(tile, scratch) as room:
        if field.near and field.axes is not None:
            block = max(1, room.grid.columns // BLOCKS)
            means = block_means(room, block, ROWS)
            images = grey(means.images / field.power.astype(np.float32)[:, None, None, :])
            images[means.saturated | ~means.inside] = np.nan
            return fit_emission_on_artwork(images, field, *room.grid.block_centres(block))
        every = max(1, int(np.sqrt(room.grid.rows * room.grid.columns / (8 * SAMPLES))))
        samples, vectors = [], []
        for start, stop in bands(room.grid, len(field.lamps) * 36):
            raw = room.raw(start, stop, field)
            usable = raw.inside & ~raw.saturated.any(axis=0)
            rows, columns = np.nonzero(usable[::every, ::every])
            points = room.grid.points(start, stop)
            light = np.broadcast_to(field.vectors(points), (len(field.lamps), *usable.shape, 3))
            samples.append(grey(raw.images)[:, rows * every, columns * every])
            vectors.append(light[:, rows * every, columns * every])
        room.check()
    shown, light = np.concatenate(samples, axis=1), np.concatenate(vectors, axis=1)
    chosen = np.random.default_rng(0).permutation(shown.shape[1])[:SAMPLES]
    return strengths.refine(field, shown[:, chosen], light[:, chosen], prior)
