"""The noise of a camera: photon noise and readout noise, measured in its own photographs."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order

if TYPE_CHECKING:
    from nlights_core.capture import Sensor
    from nlights_core.photographs.images import Photograph
    from nlights_core.photographs.masks import Mask

BLOCK = 16
"""Edge of the blocks, px, within which a photograph's variance about a smooth surface is taken: larger than
the reach of a demosaicing filter, so that noise it has spread over neighbours still counts."""

BLOCKS = 64
"""Blocks looked at across a photograph, and a quarter as many down it."""

SMOOTHEST = 0.1
"""Of an artwork's blocks this quantile of the variance is believed to be noise, not texture."""

DIM = 0.25
"""Blocks below this share of the mean level say little of photons."""

PATTERNS = 3
"""In which albedo and relief of a block can change its photographs: a scaled normal has three numbers."""

QUIETEST = 1e-4
"""No photograph is taken to be better than this standard deviation at its mean level: a simulation
without noise must not make differences in the last digit significant."""


@dataclass(frozen=True)
class Noise:
    """Variance of a photograph's sample: ``gain * signal + readout``.

    Signals are fractions of the saturation level, dark subtracted.

    Parameters
    ----------
    gain : (C,) float64 array
        Variance per signal: one over the number of electrons at saturation.
    readout : (C,) float64 array
        Variance in the dark, that of the subtracted dark frame included.
    """

    gain: Array
    readout: Array

    def photons(self, full: Array, shares: Array) -> Array:
        """Variance by photons of a grey sample that reads 1 after division by what reads ``full``.

        ``sum_c share_c^2 gain_c / full_c``; of a sample that reads r it is r times that.

        Parameters
        ----------
        full : (..., C) array
            By what the signals were divided.
        shares : (C,) array
            Share of each channel in the grey.

        Returns
        -------
        (...) array of the type of ``full``
        """
        return np.asarray(((shares**2 * self.gain).astype(full.dtype) / full).sum(axis=-1))

    def with_readout(self, weights: Array, images: Array, shares: Array) -> None:
        """Take the readout into account in weights that know photons only, in place.

        Divided by its reading r, a sample's variance is ``1 / w + readout / (full^2 r)``, and
        ``readout / full^2`` is a constant times ``1 / w^2``.  For r the mean over the lamps is
        taken, since a weight must not follow the noise of its own sample.

        Parameters
        ----------
        weights : (L, h, w) float32 array
            ``1 / photons``, 0 where a sample must not be used.
        images : (L, h, w) float32 array
            Grey readings.
        shares : (C,) array
            As for `photons`.
        """
        constant = np.float32(self.readout.mean() / (self.gain.mean() ** 2 * np.sum(shares**2)))
        used = weights > 0
        count = np.maximum(np.count_nonzero(used, axis=0), 1).astype(np.float32)
        reading = np.where(used, images, np.float32(0)).sum(axis=0) / count
        # A black pixel has readout noise only, infinite beside its light, and its normal will not be known.
        reading = np.maximum(reading, np.finfo(np.float32).tiny)
        with np.errstate(over="ignore", divide="ignore"):
            for weight in weights:
                np.divide(weight, 1 + constant / (np.where(weight > 0, weight, 1) * reading), out=weight)

    @classmethod
    def of_sensor(cls, sensor: Sensor, channels: int, dark: bool) -> Noise:
        """Noise that a capture states of its sensor; ``dark``: a dark frame is subtracted."""
        electrons = sensor.electrons_at_saturation
        readout = (sensor.read_noise_electrons / electrons) ** 2 * (2 if dark else 1)
        return cls(np.full(channels, 1 / electrons), np.full(channels, readout))


def block_statistics(image: Array, usable: Array) -> tuple[Array, Array]:
    """Mean, and variance about a cubic surface, of blocks spread over some rows of a photograph.

    Parameters
    ----------
    image : (h, w, C) float32 array
        Fractions of saturation; h at least `BLOCK`, of which the first rows are used.
    usable : (h, w) bool array
        Blocks with any other pixel are left out.

    Returns
    -------
    means, variances : (n, C) float64 arrays
    """
    edge = min(BLOCK, *image.shape[:2])
    blocks, smooth = _blocks(image, usable), _smooth(edge)
    # Block by block: one large product would be shared out to cores that have their own work.
    left = np.sum(blocks**2, axis=1) - np.sum((smooth.T @ blocks) ** 2, axis=1)
    freedom = edge**2 - smooth.shape[1]
    return blocks.mean(axis=1), np.maximum(left, 0) / freedom


def _blocks(image: Array, usable: Array) -> Array:
    """Blocks of the first rows of a photograph that can be used throughout, (n, edge^2, C) float64."""
    rows, columns, channels = image.shape
    edge = min(BLOCK, rows, columns)
    across = _block_columns(columns, edge)
    blocks = np.moveaxis(image[:edge][:, across], 1, 0).astype(np.float64)
    kept = usable[:edge][:, across].all(axis=(0, 2))
    return np.asarray(blocks[kept].reshape(-1, edge**2, channels))


def _block_columns(columns: int, edge: int) -> Array:
    """Columns of blocks spread over rows of so many, (n, edge)."""
    first = np.unique(np.linspace(0, columns - edge, min(BLOCKS, columns // edge)).round().astype(int))
    return np.asarray(first[:, None] + np.arange(edge))


@cache
def _smooth(edge: int) -> Array:
    """Orthonormal basis of the cubic surfaces over a block, (edge^2, 10): light is smooth, noise is not."""
    y, x = np.indices((edge, edge), dtype=np.float64) / edge - 0.5
    terms = [x**a * y**b for a in range(4) for b in range(4 - a)]
    return np.asarray(np.linalg.qr(np.stack(terms, axis=-1).reshape(edge**2, -1))[0])


def measure_noise(
    photographs: Collection[Photograph],
    dark: Photograph | None,
    *,
    smooth: bool,
    mask: Mask | None = None,
    averaged: int = 1,
) -> Noise | None:
    """Measure the noise in the photographs of a tile or of its flat.

    Parameters
    ----------
    photographs : collection of Photograph
        Of one size.
    dark : Photograph, optional
        The dark frame, which is subtracted.
    smooth : bool
        They show a flat: the median block is noise.  Otherwise they show an artwork,
        and only the smoothest tenth of its blocks is believed to be.
    mask : Mask, optional
        Of the artwork: what lies outside, such as a clean black background, says nothing.
    averaged : int
        Of how many exposures each of them is the mean; the noise is that of one.

    Returns
    -------
    Noise or None
        None where no block is free of saturated pixels.
    """
    strips = _Strips(next(iter(photographs)), dark, mask)

    def of_photograph(photograph: Photograph) -> list[tuple[Array, Array]]:
        return [block_statistics(*strip) for strip in strips.of(photograph)]

    found = [part for parts in in_order(of_photograph, photographs) for part in parts]
    means, variances = (np.concatenate([part[k] for part in found]) for k in (0, 1))
    return fit_noise(means, variances, strips.dark_variances(), smooth=smooth, averaged=averaged)


def measure_noise_between_lamps(
    photographs: Collection[Photograph], dark: Photograph | None, mask: Mask | None
) -> Noise | None:
    """Measure the noise in photographs of an artwork under several lamps, whatever its texture.

    Within a block, albedo and relief change the photographs by a mixture of three patterns, as many as a normal times
    an albedo has numbers; what is left of five lamps or more is noise.  Of blocks with noise alone it
    is 10 % too small, since the three largest of its parts are taken for the artwork.

    Parameters
    ----------
    photographs, dark, mask : as for `measure_noise`

    Returns
    -------
    Noise or None
        None with fewer than five lamps, or where no block can be seen under all of them.
    """
    from scipy.special import chdtri

    if len(photographs) < PATTERNS + 2:
        return None
    strips = _Strips(next(iter(photographs)), dark, mask)
    seen = list(in_order(strips.of, photographs))
    unlit = strips.dark_variances()
    channels = seen[0][0][0].shape[-1]
    readout = 2 * np.median(unlit, axis=0) if unlit is not None else np.zeros(channels)
    parts = [_left_over(list(strip), readout) for strip in zip(*seen, strict=True)]
    levels, gains = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    if not len(levels):
        return None
    freedom = (BLOCK**2 - 10) * (len(photographs) - PATTERNS)
    bright = levels >= DIM * levels.mean(axis=0)
    gain = np.array([np.quantile(gains[bright[:, c], c], SMOOTHEST) for c in range(channels)])
    gain *= freedom / chdtri(freedom, 1 - SMOOTHEST)
    return Noise(np.maximum(gain, QUIETEST**2 * levels.mean(axis=0)), readout)


def _left_over(strips: list[tuple[Array, Array]], readout: Array) -> tuple[Array, Array]:
    """Levels, and variances per signal of what is left of the blocks of a strip under all lamps, (n, C) each."""
    usable = np.logical_and.reduce([whole for _, whole in strips])
    blocks = np.stack([_blocks(image, usable) for image, _ in strips])
    lamps, count, area, channels = blocks.shape
    if not count:  # a mask may leave no whole block of a strip
        return np.empty((0, channels)), np.empty((0, channels))
    means = blocks.mean(axis=2)
    lit = (means > DIM * means.mean(axis=(0, 1))).all(axis=(0, 2))
    blocks, means = blocks[:, lit], means[:, lit]
    smooth = _smooth(int(np.sqrt(area)))
    gains = np.empty((blocks.shape[1], channels))
    for n in range(len(gains)):
        for c in range(channels):
            rest = blocks[:, n, :, c] / np.sqrt(means[:, n, None, c])
            rest = rest - (rest @ smooth) @ smooth.T
            own = np.linalg.eigvalsh(rest @ rest.T)[: lamps - PATTERNS].mean()
            gains[n, c] = own / (area - smooth.shape[1]) - readout[c] * (1 / means[:, n, c]).mean()
    return means.mean(axis=0), gains


class _Strips:
    """Some rows of photographs of one size, in which blocks lie side by side."""

    def __init__(self, first: Photograph, dark: Photograph | None, mask: Mask | None) -> None:
        info = first.info
        self.edge = min(BLOCK, info.rows, info.columns)
        count = min(BLOCKS // 4, info.rows // self.edge)
        self.starts = np.unique(np.linspace(0, info.rows - self.edge, count).round().astype(int)).tolist()
        self.columns = _block_columns(info.columns, self.edge).ravel()
        self.limit = 1.0 if np.isfinite(info.saturation) else np.inf
        self.black = self._read(dark) if dark is not None else []
        self.inside = [
            mask.band(start, start + self.edge)[:, self.columns] if mask is not None else True
            for start in self.starts
        ]

    def _read(self, photograph: Photograph) -> list[Array]:
        return [photograph.band(start, start + self.edge)[:, self.columns] for start in self.starts]

    def of(self, photograph: Photograph) -> list[tuple[Array, Array]]:
        """Strips of a photograph without the dark frame, and where they can be used."""
        images = self._read(photograph)
        usable = [
            np.asarray((image < self.limit).all(axis=-1) & inside)
            for image, inside in zip(images, self.inside, strict=True)
        ]
        if self.black:
            images = [image - black for image, black in zip(images, self.black, strict=True)]
        return list(zip(images, usable, strict=True))

    def dark_variances(self) -> Array | None:
        """Variances of the blocks of the dark frame, (m, C)."""
        found = [block_statistics(black, np.ones(black.shape[:2], bool))[1] for black in self.black]
        return np.concatenate(found) if found else None


def fit_noise(
    means: Array, variances: Array, dark: Array | None, *, smooth: bool, averaged: int = 1
) -> Noise | None:
    """Photon and readout noise from the statistics of blocks.

    Parameters
    ----------
    means, variances : (n, C) arrays
        Of blocks of photographs, dark subtracted; see `block_statistics`.
    dark : (m, C) array, optional
        Variances of blocks of the dark frame.
    smooth, averaged : bool, int
        See `measure_noise`.

    Returns
    -------
    Noise or None
        None where there is no block, or no light.
    """
    from scipy.special import chdtri

    if not len(means) or not (means.mean(axis=0) > 0).all():
        return None
    # Frame and dark frame are read out once each; the readings of a mean are averaged with its photons.
    once = np.median(dark, axis=0) if dark is not None else np.zeros(means.shape[1])
    readout = once * (1 + 1 / averaged)
    level = means.mean(axis=0)
    freedom = BLOCK**2 - 10
    share = 0.5 if smooth else SMOOTHEST
    gain = np.empty(means.shape[1])
    for c in range(means.shape[1]):
        bright = means[:, c] >= DIM * level[c]
        ratios = (variances[bright, c] - readout[c]) / means[bright, c]
        gain[c] = np.quantile(ratios, share) * freedom / chdtri(freedom, 1 - share)
    return Noise(averaged * np.maximum(gain, QUIETEST**2 * level), 2 * once)


def write_noise(folder: Path, noise: Noise) -> None:
    """Write ``noise.json``."""
    record = {"gain": noise.gain.tolist(), "readout": noise.readout.tolist()}
    (folder / "noise.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_noise(folder: Path) -> Noise | None:
    """Read what `write_noise` wrote; None where it wrote nothing."""
    path = folder / "noise.json"
    if not path.is_file():
        return None
    record = json.loads(path.read_text(encoding="utf-8"))
    return Noise(np.array(record["gain"]), np.array(record["readout"]))
