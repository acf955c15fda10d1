"""Coarse light: the logarithm of every photograph in some hundred cells, and of the light that the stand computes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlights_core.capture import Tile
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.reduced_light.samples import Samples

CELLS = 24
"""About how many cells a photograph is wide: light is smooth, and medians of 100 samples leave dirt and lines out."""

LEAST_CELLS = 40
"""Cells that two photographs must both know before they are compared: a robust spread of fewer says little."""


@dataclass(frozen=True)
class CoarseLight:
    """Logarithms of light per cell, of some lamps; NaN where not known.

    Attributes
    ----------
    lamps : tuple of str
        In the order of the first axis.
    frames : (L, h, w) float64 array
        Of the photographs of the artwork.
    flats : (L, h, w) float64 array or None
        Of those of the flat; None where there are none.
    computed : (L, h, w) float64 array or None
        Of the light that lamps where the stand has them, aimed at the centre of the field, throw on a
        plane; None where it is not known where the lamps are, or they are infinitely far away.
    """

    lamps: tuple[str, ...]
    frames: Array
    flats: Array | None
    computed: Array | None

    def of(self, lamps: tuple[str, ...]) -> CoarseLight:
        """The same of some of the lamps."""
        chosen = [self.lamps.index(lamp) for lamp in lamps]

        def part(light: Array | None) -> Array | None:
            return None if light is None else light[chosen]

        return CoarseLight(lamps, self.frames[chosen], part(self.flats), part(self.computed))


def reduce_to_cells(
    samples: Samples, tile: Tile, lights: LightField | None, across: int = CELLS
) -> CoarseLight:
    """Take medians of the samples in each cell, and compute the light of the stand's lamps there.

    Parameters
    ----------
    samples : Samples
    tile : Tile
    lights : LightField or None
    across : int
        About how many cells a photograph is wide.

    Returns
    -------
    CoarseLight
        Of all lamps.
    """
    edge = max(1, samples.grid.columns // across)
    computed = computed_light(samples, tile, lights)
    return CoarseLight(
        samples.lamps,
        _logarithm(cell_medians(samples.frames, edge)),
        None if samples.flats is None else _logarithm(cell_medians(samples.flats, edge)),
        None if computed is None else _logarithm(cell_medians(computed, edge)),
    )


def cell_medians(light: Array, edge: int) -> Array:
    """Medians of what is known in squares of samples; NaN where less than half of a square is.

    Parameters
    ----------
    light : (..., H, W) array
    edge : int
        Of a square, samples; a remainder is cut.

    Returns
    -------
    (..., H // edge, W // edge) float64 array
    """
    rows, columns = light.shape[-2] // edge, light.shape[-1] // edge
    cut = light[..., : rows * edge, : columns * edge].reshape(-1, rows, edge, columns, edge)
    squares = cut.swapaxes(2, 3).reshape(-1, edge * edge)
    return known_medians(squares, 0.5).reshape(*light.shape[:-2], rows, columns)


def known_medians(values: Array, least: float = 0.0) -> Array:
    """Medians along the last axis of what is not NaN, float64; NaN where a smaller share than ``least`` is known."""
    # NaN is sorted to the end; numpy.nanmedian takes ten times as long.
    order = np.sort(values, axis=-1)
    count = np.count_nonzero(np.isfinite(order), axis=-1)[..., None]
    low, high = (np.take_along_axis(order, np.maximum(k, 0), -1) for k in ((count - 1) // 2, count // 2))
    found = (low.astype(np.float64) + high.clip(max=np.inf)) / 2
    return np.where((count > least * values.shape[-1]) & (count > 0), found, np.nan)[..., 0]


def computed_light(samples: Samples, tile: Tile, lights: LightField | None) -> Array | None:
    """Light of the lamps on the plane as the stand has them, (L, H, W) float32; None where that is not known."""
    known = tile.stand is not None and set(samples.lamps) <= set(tile.stand.lamps)
    if known:
        assert tile.stand is not None
        positions = tile.stand.lamp_positions(samples.lamps)
        exponents = np.full(len(positions), tile.stand.lamp.exponent)
    elif lights is not None and lights.positions is not None and set(samples.lamps) <= set(lights.lamps):
        order = [lights.lamps.index(lamp) for lamp in samples.lamps]
        positions = lights.positions[order]
        exponents = np.ones(len(order)) if lights.exponents is None else lights.exponents[order]
    else:
        return None
    axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    field = LightField(samples.lamps, positions=positions, axes=axes, exponents=exponents)
    return np.asarray(field.vectors(samples.grid.points(0, samples.grid.rows))[..., 2])


def centred(logarithms: Array) -> Array:
    """Logarithms (L, h, w) less their median over the lamps in each cell: what all have in common is gone.

    That is albedo, vignetting and dust; a cell that a lamp does not know is known to no lamp.
    """
    return np.asarray(logarithms - np.median(logarithms, axis=0))


def misfits(first: Array, second: Array) -> Array:
    """Misfit of each of some pictures with each of others, but for a factor.

    Parameters
    ----------
    first, second : (L, h, w) and (M, h, w) arrays
        Logarithms.

    Returns
    -------
    (L, M) array
        Robust variance of the difference over the cells; NaN where too few cells are known.
    """
    others = second.reshape(len(second), -1)
    return np.stack([variance(one.reshape(1, -1) - others) for one in first])


def variance(differences: Array) -> Array:
    """Robust variance along the last axis: from the width of the narrowest half of the values (the shorth).

    Unlike the distance from the median, it forgives shadows and highlights that are all on one side.

    Parameters
    ----------
    differences : (..., N) array

    Returns
    -------
    (...) array
        NaN where less than `LEAST_CELLS` are known.
    """
    rows = np.sort(differences.reshape(-1, differences.shape[-1]), axis=1)
    counts = np.count_nonzero(np.isfinite(rows), axis=1)
    widths = np.full(len(rows), np.nan)
    # All pictures with as many known cells, which is nearly all of them, are measured in one go.
    for count in np.unique(counts[counts >= LEAST_CELLS]):
        half, alike = count // 2, counts == count
        some = rows[alike]
        widths[alike] = np.min(some[:, half:count] - some[:, : count - half], axis=1)
    return np.asarray((widths / (2 * 0.6745)) ** 2).reshape(differences.shape[:-1])


def _logarithm(light: Array) -> Array:
    """Logarithm, NaN where there is no light."""
    return np.log(np.where(light > 0, light, np.nan))
