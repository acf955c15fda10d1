"""Relative light: photographs over their flats, which every lamp's direction explains with three numbers a place.

A matt place of albedo rho and normal n reads ``rho n . v / v_z`` relative to a flat, v being the direction of
the lamp: so three lamps determine it, and every further lamp can be predicted from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter

from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.reduced_light.colours import DIM
from nlights_core.reduced_light.samples import Samples

FEWEST = 5
"""Lamps from which on a photograph that differs can be told: of four, each could be the one that is wrong."""

SHADED = 0.6
"""Light below this share of what the others predict, at the brighter places of a patch, is a shadow that was
cast: no paint is so dark nearly all over a patch under one lamp only."""

BRIGHT = 0.8
"""Which quantile of a patch its brighter places are: lines that moved do not reach it, nor do small highlights."""

DARK, DEEP = 0.2, 0.5
"""The same of the darker places of a patch, so that the edge of a shadow is seen as well."""

PATCHES = 24
"""Patches across a photograph in which shadows are looked for."""

FITTED = 1500
"""About how many samples the strengths of the lamps are fitted to: two or three numbers a lamp need no more."""

ROUNDS = 20
"""Rounds of that fit; from strengths that differ by half it has settled by then."""

DUST = 15
"""Samples over which flats are averaged, so that nothing of their dust is left."""

SPECK = np.float32(0.01)
"""Deviation of a flat from the mean around it that is no speck of dust."""


@dataclass(frozen=True)
class RelativeLight:
    """Light of some lamps relative to the flat, or to each lamp's strength where there are no flats.

    Attributes
    ----------
    lamps : tuple of str
        In the order of the first axis.
    light : (L, h, w) float32 array
        NaN where not known.
    divisors : (L, h, w) or (L, 1, 1) float32 array
        What the photographs were divided by.
    vectors : (L, h, w, 3) float32 array
        Such that a matt surface reads ``vectors . (albedo normal)``.
    shaded : (L, y, x) bool array
        Patches of ``patch`` x ``patch`` samples in which a shadow was cast.
    patch : int
        Edge of a patch, samples.
    with_flats : bool
        Whether the level of each lamp is known.
    lights : LightField
        Where these lamps, and perhaps others, are.
    grid : PixelGrid
        Where the samples are on the plane.
    colour : (L, h, w) float32 array or None
        Light relative to the flat without its grey part, so without gloss; NaN where paint is grey.
    """

    lamps: tuple[str, ...]
    light: Array
    divisors: Array
    vectors: Array
    shaded: Array
    patch: int
    with_flats: bool
    lights: LightField
    grid: PixelGrid
    colour: Array | None = None

    def of(self, kept: Sequence[int]) -> RelativeLight:
        """The same of some lamps, by their indices."""
        some = np.array(kept, np.intp)
        return replace(
            self,
            lamps=tuple(self.lamps[i] for i in kept),
            light=self.light[some],
            divisors=self.divisors[some],
            vectors=self.vectors[some],
            shaded=self.shaded[some],
            colour=None if self.colour is None else self.colour[some],
        )

    @cached_property
    def smooth_divisors(self) -> Array:
        """The divisors without noise and dust, (L, h, w) or (L, 1, 1) float32."""
        if self.divisors.shape[1:] == (1, 1):
            return self.divisors
        known = np.isfinite(self.divisors)
        share = uniform_filter(known.astype(np.float32), (1, DUST, DUST), mode="nearest")
        smooth = self.divisors
        for limit in (np.inf, SPECK, np.inf):
            # A speck is cut off before the mean is taken that counts; its box would have edges in all photographs.
            if limit < np.inf:
                smooth = np.clip(self.divisors, smooth * (1 - limit), smooth * (1 + limit))
            total = uniform_filter(np.where(known, smooth, np.float32(0)), (1, DUST, DUST), mode="nearest")
            smooth = np.where(share > 0.01, total / np.maximum(share, np.float32(0.01)), np.float32(np.nan))
        return smooth


def relate_samples(samples: Samples, lamps: Sequence[str], lights: LightField) -> RelativeLight:
    """Divide photographs by their flats, and say how each lamp's direction explains what is left.

    Parameters
    ----------
    samples : Samples
    lamps : sequence of str
        Which of them.
    lights : LightField
        Where the lamps are.

    Returns
    -------
    RelativeLight
        Without flats relative to strengths that make the photographs fit one another.
    """
    chosen = [samples.lamps.index(lamp) for lamp in lamps]
    places = [lights.lamps.index(lamp) for lamp in lamps]
    frames = samples.frames[chosen]
    vectors = lamp_vectors(lights, samples.grid.points(0, samples.grid.rows), samples.flats is not None)
    vectors = np.broadcast_to(vectors[places], (*frames.shape, 3))
    if samples.flats is not None:
        divisors = np.where(samples.flats[chosen] > DIM, samples.flats[chosen], np.float32(np.nan))
    else:
        power = lights.power[places].mean(axis=1).astype(np.float32)[:, None, None]
        divisors = power * _strengths(frames / power, vectors)[:, None, None]
    light = frames / divisors
    patch = max(2, samples.grid.columns // PATCHES)
    return RelativeLight(
        tuple(lamps),
        light,
        divisors,
        vectors,
        _shaded(light, vectors, patch),
        patch,
        samples.flats is not None,
        lights,
        samples.grid,
        None if samples.colour is None else samples.colour[chosen],
    )


def lamp_vectors(lights: LightField, points: Array, with_flats: bool) -> Array:
    """Vectors that explain light relative to a flat, or light, at points (3, h, w): those of `LightField.vectors`."""
    vectors = lights.vectors(points)
    return vectors / vectors[..., 2:] if with_flats else vectors


def left_out(light: Array, vectors: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Predict every lamp's light from the others.

    Parameters
    ----------
    light : (L, n) array
        Of n places; not read where the weight is 0.
    vectors : (L, n, 3) array
    weights : (L, n) array

    Returns
    -------
    predicted : (L, n) float32 array
        From the other lamps by weighted least squares; NaN where they do not determine it.
    residual : (L, n) float32 array
        What all lamps together leave of each.
    freedom : (L, n) float32 array
        Share of a lamp's own deviation that stays in its residual; 0: the others say nothing about it.
    """
    weights = weights.astype(np.float32)
    light = np.where(weights > 0, light, np.float32(0))
    weighted = vectors * weights[..., None]
    matrix = np.einsum("lni,lnj->nij", weighted, vectors)
    matrix += 1e-5 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3, dtype=np.float32)
    matrix += 1e-12 * np.eye(3, dtype=np.float32)
    inverse = np.linalg.inv(matrix)
    found = np.einsum("nij,nj->ni", inverse, np.einsum("lni,ln->ni", weighted, light))
    residual = light - np.einsum("lni,ni->ln", vectors, found)
    leverage = np.einsum("lni,nij,lnj->ln", vectors, inverse, weighted, optimize=True)
    freedom = np.clip(1 - leverage, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        predicted = light - np.where(weights > 0, residual / freedom, residual)
    predicted[freedom < 0.02] = np.nan
    return predicted, residual, freedom


def _strengths(light: Array, vectors: Array) -> Array:
    """Strength of each lamp that makes the photographs fit one another, (L,) float32; their median is 1."""
    count = len(light)
    flat = light.reshape(count, -1)
    usable = np.flatnonzero(np.isfinite(flat).sum(axis=0) >= min(count, FEWEST))
    chosen = usable[:: max(1, len(usable) // FITTED)]
    some, directions = flat[:, chosen], vectors.reshape(count, -1, 3)[:, chosen]
    strengths = np.ones(count, np.float32)
    if count < FEWEST or not chosen.size:
        return strengths
    bright = np.nanmax(some, axis=0)
    weights = (np.isfinite(some) & (some > 0.15 * bright) & (bright > DIM)).astype(np.float32)
    some = np.nan_to_num(some)
    for _ in range(ROUNDS):
        relative = some / strengths[:, None]
        _, residual, _ = left_out(relative, directions, weights)
        fitted = relative - residual
        scale = 0.05 * np.maximum(fitted.max(axis=0), DIM)
        trust = weights / (1 + (residual / scale) ** 2)
        step = (trust * relative * fitted).sum(axis=1) / np.maximum((trust * fitted**2).sum(axis=1), 1e-12)
        strengths *= np.clip(step, 0.5, 2)
        strengths /= np.median(strengths)
    return strengths


def _shaded(light: Array, vectors: Array, patch: int) -> Array:
    """Patches that lie in a lamp's cast shadow, (L, y, x) bool."""
    count, rows, columns = light.shape
    down, across = -(-rows // patch), -(-columns // patch)
    padded = np.full((count, down * patch, across * patch), np.nan, np.float32)
    padded[:, :rows, :columns] = light
    blocks = (
        padded.reshape(count, down, patch, across, patch).swapaxes(2, 3).reshape(count, down * across, -1)
    )
    known = np.isfinite(blocks)
    middle_y = np.minimum(np.arange(down) * patch + patch // 2, rows - 1)
    middle_x = np.minimum(np.arange(across) * patch + patch // 2, columns - 1)
    directions = vectors[:, middle_y][:, :, middle_x].reshape(count, -1, 3)
    weights = known.any(axis=-1).astype(np.float32)
    shaded = np.zeros(weights.shape, bool)
    ranks = [int(share * (blocks.shape[-1] - 1)) for share in (BRIGHT, DARK)]
    ordered = np.partition(np.where(known, blocks, np.float32(0)), ranks, axis=-1)
    for rank, limit in zip(ranks, (SHADED, DEEP), strict=True):
        seen = ordered[..., rank]
        for _ in range(2):
            # The darkest first: a shadow lowers the predictions of the others.
            predicted, _, _ = left_out(seen, directions, weights * ~shaded)
            # Of all neighbours, so that a dark place that moved is no shadow.
            least = minimum_filter(np.nan_to_num(predicted).reshape(count, down, across), (1, 3, 3))
            shaded |= (weights > 0) & (seen < limit * least.reshape(count, -1))
    return shaded.reshape(count, down, across)


def enlarge(small: Array, block: int, rows: Array, columns: Array) -> Array:
    """Read maps of samples (L, h, w) between their centres, at rows and columns of the photographs."""

    def between(places: Array, count: int) -> tuple[Array, Array]:
        place = np.clip((places + 0.5) / block - 0.5, 0, count - 1)
        before = np.minimum(place.astype(np.intp), max(count - 2, 0))
        return before, (place - before).astype(np.float32)

    above, down = between(rows, small.shape[1])
    left, across = between(columns, small.shape[2])
    below, right = np.minimum(above + 1, small.shape[1] - 1), np.minimum(left + 1, small.shape[2] - 1)
    lines = small[:, above] * (1 - down)[:, None] + small[:, below] * down[:, None]
    return np.asarray(lines[:, :, left] * (1 - across) + lines[:, :, right] * across)
