"""Colours: the light of paint without its grey part, which holds no gloss.

Varnish mirrors a lamp as it is: relative to a grey flat a highlight is grey, whatever its shape, and however
the paint below slopes.  What is left of coloured paint is matt.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter

from nlights_core.frames import Array

GREY = 0.1
"""Colour below that share of the brightest channel is mostly noise."""

DIM = 1e-4
"""Share of saturation below which a flat, or the brightest lamp at a place, says nothing."""

AROUND = 5
"""Samples over which light is averaged: dark paint is noisy, and the mean of matt light is matt light."""


def colour_light(frames: Array, flats: Array) -> Array | None:
    """Take the grey part out of light relative to the flats.

    Parameters
    ----------
    frames, flats : (L, h, w, C) float32 arrays
        NaN where not known.

    Returns
    -------
    (L, h, w) float32 array or None
        Relative light along the colour of each place, which every lamp shares; NaN where the place is grey.
        None where there is no colour: of photographs with one channel.
    """
    if frames.shape[-1] == 1 or frames.shape != flats.shape:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.where(flats > DIM, frames / flats, np.float32(np.nan))
    known = np.isfinite(light)
    light = uniform_filter(np.where(known, light, np.float32(0)), (1, AROUND, AROUND, 1), mode="nearest")
    light[minimum_filter(known, (1, AROUND, AROUND, 1), mode="nearest") == 0] = np.nan
    mean = _mean_of_known(light)
    colour = mean - mean.mean(axis=-1, keepdims=True)
    size = np.linalg.norm(colour, axis=-1)
    found = np.einsum("lyxc,yxc->lyx", light, colour / np.maximum(size, np.float32(1e-9))[..., None])
    found[:, ~(size > GREY * mean.max(axis=-1))] = np.nan
    return np.asarray(found, np.float32)


def _mean_of_known(light: Array) -> Array:
    """Mean over the lamps that are known, (h, w, C)."""
    known = np.isfinite(light)
    return np.asarray(np.where(known, light, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.float32)
