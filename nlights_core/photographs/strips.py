"""Strips: rows of photographs, and all that compiled development needs to know, as plain arrays."""

from __future__ import annotations

from typing import NamedTuple

from nlights_core.frames import Array


class Strip(NamedTuple):
    """Rows of the photographs.

    Attributes
    ----------
    numbers : (L, h, w C) or (L + 1, h, w C) array of uint8, uint16 or float32
        What the files hold, the dark frame last.  There may be more rows than are meant.
    inside : (h, w) or (0, 0) uint8 array
        The mask, not 0 inside, if there is one.
    height : (h, w) or (0, 0) float32 array
        Height of the pass before, mm; of no size: the plane.
    x, y : (w,) and (h,) float32 arrays
        Where the rays of the pixels meet the plane, mm.
    """

    numbers: Array
    inside: Array
    height: Array
    x: Array
    y: Array


class Optics(NamedTuple):
    """Constants of all pixels of a tile; float32 arrays.

    Attributes
    ----------
    scale : (3,)
        Light per number; the number at which the sensor saturates; the largest light there is.
    lamps : (L, 4, 3)
        Of each colour one over the power; share in the grey; variance per inverse reading, share^2 gain / power;
        share in what the eye sees.
    positions : (L, 3)
        Of near lamps, mm; directions of distant ones, of z = 1.
    near : (1,)
        1 for near lamps, 0 for distant ones.
    camera : (3,)
        Centre of projection, mm; z is infinite where there is none.
    flat_field : (L, H W, 12)
        Minus the binary logarithm of the flat field: of each cell, numbered as its first corner is, and
        each colour the value at that corner, the slopes to the right and downwards, and the twist.
    flat_field_shape : tuple of 2 int
        H and W.
    place : (3,)
        x and y of the flat field's first sample and their distance, mm.
    lens : (4,)
        The x, y and 1 / z^2 of the camera that saw the flat; its vignetting times 4 / ln 2.
    limits : (2,)
        The largest inverse reading that is usable; the constant of
        `nlights_core.photographs.noise.Noise.with_readout`.
    """

    scale: Array
    lamps: Array
    positions: Array
    near: Array
    camera: Array
    flat_field: Array
    flat_field_shape: tuple[int, int]
    place: Array
    lens: Array
    limits: Array


class Blocks(NamedTuple):
    """Developed blocks.

    Attributes
    ----------
    samples : (S, L, SAMPLE) float32 array
        See `nlights_core.solving.compiled_fits`.
    colours : (S, L, 3 BLOCK) float32 array
        The images, divided by power and flat field.
    counts : (S, COUNTED) float32 array
        How many lights are saturated, and how many in shadow.
    totals : (L + 1, 2 BLOCK) float32 array
        To which grey values and then numbers of saturated pixels inside the mask are added.
    scratch : (SCRATCH,) float32 array
    """

    samples: Array
    colours: Array
    counts: Array
    totals: Array
    scratch: Array
