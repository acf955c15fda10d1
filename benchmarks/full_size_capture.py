"""A capture of any size, made fast: a smaller rendering, enlarged, with noise of its own in every pixel."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

from nlights_core.configurations import load_stand
from nlights_core.files.tiffs import BandTiff
from nlights_core.frames import Array
from nlights_core.simulation.captures import (
    BLACK_LEVEL,
    EXPOSURE,
    FULL_WELL,
    READ_NOISE,
    SATURATION,
    Studio,
    set_up,
)

RENDERED = 1460
"""About how many columns are rendered; neighbouring pixels between them are interpolated."""
BAND = 128
RANDOM = 1 << 23
"""Random numbers drawn; every band takes them from another place on."""


def write_capture(folder: Path, columns: int) -> tuple[int, int]:
    """Write photographs of a simulated painting, flats, a dark frame and the manifest.

    Parameters
    ----------
    folder : Path
        New.
    columns : int
        Of the photographs; rounded to a multiple of the enlargement.

    Returns
    -------
    rows, columns : int
    """
    factor = max(1, round(columns / RENDERED))
    studio = set_up(load_stand("horizontal"), "painting", columns // factor, False, 1)
    (folder / "flat").mkdir(parents=True)
    noise = np.random.default_rng(1).standard_normal(RANDOM, np.float32)
    gain = EXPOSURE / studio.brightest() * FULL_WELL
    names = list(load_stand("horizontal").lamps)
    shape = (studio.grid.rows * factor, studio.grid.columns * factor)
    for lamp in range(-1, len(names)):
        pictures = _radiance(studio, lamp)
        paths = ["dark.tif"] if lamp < 0 else [f"light_{lamp + 1}.tif", f"flat/light_{lamp + 1}.tif"]
        for k, (path, picture) in enumerate(zip(paths, pictures, strict=True)):
            with BandTiff(folder / path, (*shape, 3), "uint16") as file:
                for start, light in _enlarged(picture, factor):
                    place = (97 * start + 7919 * (2 * lamp + k)) * 3571 % RANDOM
                    file.write(_exposed(light, gain, noise, place))
    manifest = {
        "artwork": {"id": f"painting-{shape[1]}", "title": f"Simulated painting, {shape[1]} columns"},
        "stand": "horizontal",
        "frames": {name: f"light_{n}.tif" for n, name in enumerate(names, 1)},
        "flats": {name: f"flat/light_{n}.tif" for n, name in enumerate(names, 1)},
        "dark": "dark.tif",
    }
    (folder / "artwork.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
    return shape


def _radiance(studio: Studio, lamp: int) -> tuple[Array, ...]:
    """Artwork and flat under a lamp, (h, w, 3) each; a single black picture for the lamp -1."""
    rows, columns = studio.grid.shape
    if lamp < 0:
        return (np.zeros((rows, columns, 3), np.float32),)
    pictures = tuple(np.empty((rows, columns, 3), np.float32) for _ in range(2))
    only = Studio(
        studio.scene,
        studio.grid,
        studio.groups[lamp : lamp + 1],
        studio.horizons[lamp : lamp + 1],
        studio.varnish,
    )
    for start in range(0, rows, 64):
        stop = min(start + 64, rows)
        for matt, _, flat in only.radiance(start, stop, studio.truth(start, stop)):
            pictures[0][start:stop], pictures[1][start:stop] = matt, flat
    return pictures


def _enlarged(picture: Array, factor: int) -> Iterator[tuple[int, Array]]:
    """Bands of a picture enlarged by linear interpolation, each with its first row."""
    rows, columns = picture.shape[:2]

    def between(index: Array, last: int) -> tuple[Array, Array]:
        place = np.clip((index + 0.5) / factor - 0.5, 0, last)
        before = np.minimum(place.astype(int), max(last - 1, 0))
        return before, (place - before).astype(np.float32)

    left, across = between(np.arange(columns * factor), columns - 1)
    right = np.minimum(left + 1, columns - 1)
    for start in range(0, rows * factor, BAND):
        above, down = between(np.arange(start, min(start + BAND, rows * factor)), rows - 1)
        below = np.minimum(above + 1, rows - 1)
        lines = picture[above] + (picture[below] - picture[above]) * down[:, None, None]
        first = lines[:, left]
        yield start, first + (lines[:, right] - first) * across[None, :, None]


def _exposed(light: Array, gain: float, noise: Array, place: int) -> Array:
    """What `nlights_core.simulation.captures.expose` does, with noise that is drawn already."""
    electrons = light * np.float32(gain)
    deviation = np.sqrt(electrons + np.float32(READ_NOISE**2))
    drawn = np.take(noise, np.arange(place, place + electrons.size) % RANDOM).reshape(electrons.shape)
    electrons += deviation * drawn
    numbers = BLACK_LEVEL + electrons * np.float32((SATURATION - BLACK_LEVEL) / FULL_WELL)
    return np.asarray(np.clip(np.rint(numbers), 0, SATURATION), np.uint16)
