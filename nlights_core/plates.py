"""Plates: what a flat white plate at z = 0 reads under each lamp, as a smooth function."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from nlights_core.arrays import write_array
from nlights_core.errors import TileError
from nlights_core.frames import Array, PixelGrid

COLUMNS = 256
"""About how many blocks across a plate is known on: it is smooth."""

MARGIN = 0.15
"""How far past the frame a plate is continued, as a share of its longer side: a lamp at 15
degrees reaches 40 mm past the frame for a surface 8 mm high."""


@dataclass(frozen=True)
class Plate:
    """A plate on a coarse grid that reaches past the frame.

    Parameters
    ----------
    logarithm : (L, h, w, C) float32 array
        Natural logarithm of the reading.
    left, top : float
        x and y of the first sample, mm.
    step : float
        Distance of samples, mm.
    """

    logarithm: Array
    left: float
    top: float
    step: float

    @cached_property
    def brightest(self) -> float:
        """The largest reading of any lamp."""
        return float(np.exp(np.max(self.logarithm)))

    @cached_property
    def shares(self) -> Array:
        """Share of each colour channel in the plate's light, (C,) float32.

        Images divided by the plate are best mixed to grey by these shares: with shot noise that
        is what counting the photons of all channels together would give, whatever the colour.
        """
        light = np.exp(self.logarithm).mean(axis=(0, 1, 2))
        return np.asarray(light / light.sum(), np.float32)

    def inside(self, grid: PixelGrid) -> Array:
        """Readings in the frame only, (L, h, w, C) float32: for people to look at."""
        x = self.left + self.step * np.arange(self.logarithm.shape[2])
        y = self.top - self.step * np.arange(self.logarithm.shape[1])
        columns = np.abs(x) < grid.columns * grid.pixel_size / 2
        rows = np.abs(y) < grid.rows * grid.pixel_size / 2
        return np.asarray(np.exp(self.logarithm[:, rows][:, :, columns]))

    def at(self, lamp: int, x: Array, y: Array) -> Array:
        """Read the plate at any points, by linear interpolation.

        Parameters
        ----------
        lamp : int
            Index of the lamp.
        x, y : (h, w) float32 arrays
            Points of the plane, mm.

        Returns
        -------
        (h, w, C) float32 array
            Past the margin, the reading at its edge.
        """
        from scipy.ndimage import map_coordinates

        places = np.stack([(self.top - y) / self.step, (x - self.left) / self.step])
        channels = self.logarithm.shape[-1]
        out = np.empty((*x.shape, channels), np.float32)
        for c in range(channels):
            map_coordinates(self.logarithm[lamp, ..., c], places, out[..., c], order=1, mode="nearest")
        return np.exp(out, out=out)


def block_size(grid: PixelGrid) -> int:
    """Edge of the blocks that a plate of this grid is averaged over, px."""
    return max(1, min(round(max(grid.rows, grid.columns) / COLUMNS), min(grid.shape) // 4))


def continued(reading: Array, x: Array, y: Array, step: float) -> Plate:
    """Make a plate from readings in the frame, continued past it.

    Outside, the logarithm follows a cubic polynomial fitted to the whole frame plus what the
    polynomial misses at the nearest sample of the frame, so that it is continuous.

    Parameters
    ----------
    reading : (L, h, w, C) array
        Positive; NaN where not known (filled the same way, from the nearest known sample).
    x, y : (w,) and (h,) arrays
        Centres of the samples, mm.
    step : float
        Their distance, mm.

    Raises
    ------
    TileError
        When a lamp's plate is known on less than half of the frame.
    """
    from scipy.ndimage import distance_transform_edt

    margin = int(np.ceil(MARGIN * max(reading.shape[1:3])))
    wide_x = x[0] + step * np.arange(-margin, len(x) + margin)
    wide_y = y[0] - step * np.arange(-margin, len(y) + margin)
    count, _, _, channels = reading.shape
    out = np.empty((count, len(wide_y), len(wide_x), channels), np.float32)
    inner = _cubic(x / (step * len(x)), y / (step * len(x)))
    wide = _cubic(wide_x / (step * len(x)), wide_y / (step * len(x)))
    for i in range(count):
        for c in range(channels):
            known = np.isfinite(reading[i, ..., c]) & (reading[i, ..., c] > 0)
            if known.mean() < 0.5:
                raise TileError(
                    f"flats: the reading of lamp {i + 1} is known on {known.mean():.0%} of the frame only "
                    "(the rest is saturated or black); photograph the flat reference again"
                )
            values = np.log(np.where(known, reading[i, ..., c], 1.0).astype(np.float64))
            fit = np.linalg.lstsq(inner[known], values[known], rcond=None)[0]
            missed = np.full(wide.shape[:2], np.nan)
            frame = (slice(margin, margin + len(y)), slice(margin, margin + len(x)))
            missed[frame] = np.where(known, values - inner @ fit, np.nan)
            nearest = distance_transform_edt(np.isnan(missed), return_distances=False, return_indices=True)
            out[i, ..., c] = wide @ fit + missed[tuple(nearest)]
    return Plate(out, float(wide_x[0]), float(wide_y[0]), step)


def write_plate(folder: Path, plate: Plate) -> None:
    """Write a plate as ``plate.npy`` and, where its samples are, ``plate.json``."""
    write_array(folder / "plate.npy", plate.logarithm)
    place = {"left": plate.left, "top": plate.top, "step": plate.step}
    (folder / "plate.json").write_text(json.dumps(place) + "\n", encoding="utf-8")


def read_plate(folder: Path) -> Plate:
    """Read what `write_plate` wrote."""
    place = json.loads((folder / "plate.json").read_text(encoding="utf-8"))
    return Plate(np.load(folder / "plate.npy"), **place)


def _cubic(x: Array, y: Array) -> Array:
    """All monomials of total degree up to 3, (h, w, 10) float64."""
    return np.stack([np.outer(y**b, x**a) for a in range(4) for b in range(4 - a)], axis=-1)
