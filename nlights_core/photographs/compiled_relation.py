"""Compiled relation of reduced photographs to the flat field, and their light.

What `nlights_core.photographs.development` says in numpy, pixel after pixel, with the same results up to rounding.
Import this only where it is used: Numba takes half a second.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel


@kernel
def relate(
    points: Array,
    position: Array,
    flat_field: Array,
    place: Array,
    lens: Array,
    seen: Array,
    photons: Array,
    least: float,
    images: Array,
    weights: Array,
    lights: Array,
) -> None:
    """Divide a near lamp's image by the flat field and weigh it, in place; give its light relative to the flat field.

    Parameters
    ----------
    points : (3, h, w) float32 array
        Of the surface, mm.
    position : (3,) float64 array
        The lamp's, mm.
    flat_field : (H, W, C) float32 array
        Logarithm of its flat field.
    place, lens : (3,) and (4,) float64 arrays
        Left, top and step of the flat field's samples, mm; x, y and z^-2 of the camera that saw the
        flat, and its vignetting.
    seen : (h, w) or (0, 0) float32 array
        1 + the square of the tangent at which the camera sees the pixels; of no size: the surface is the
        plane.
    photons : (C,) float64 array
        Variance by photons per inverse reading.
    least : float
        Readings of the flat below are not usable.
    images : (h, w, C) float32 array
    weights : (h, w) float32 array
    lights : (h, w, 3) float32 array
        Receives ``ray (S_z / (S_z - z))^3 / S_z`` (numerics, section 1): power, emission and fall-off cancel.
    """
    sx, sy, sz = position[0], position[1], position[2]
    down, right, channels = flat_field.shape
    reading = np.empty(channels, np.float32)
    for i in range(points.shape[1]):
        for j in range(points.shape[2]):
            rx, ry = sx - points[0, i, j], sy - points[1, i, j]
            # To the plane, where the flat was, the ray is longer by this factor than to the point; it ends at x, y.
            stretch = sz / (sz - points[2, i, j])
            factor = stretch * stretch * stretch / sz
            lights[i, j, 0], lights[i, j, 1] = rx * factor, ry * factor
            lights[i, j, 2] = stretch * stretch
            x, y = sx - rx * stretch, sy - ry * stretch
            column = min(max((x - place[0]) / place[2], 0.0), right - 1.0)
            row = min(max((place[1] - y) / place[2], 0.0), down - 1.0)
            # First corner of the cell and place in it (s, t), clipped: farther out the flat field is not known.
            left, above = min(int(column), max(right - 2, 0)), min(int(row), max(down - 2, 0))
            after, below = min(left + 1, right - 1), min(above + 1, down - 1)
            s, t = column - left, row - above
            dimmed = 0.0
            if seen.size:
                met = 1 + ((x - lens[0]) ** 2 + (y - lens[1]) ** 2) * lens[2]
                dimmed = lens[3] * -2 * math.log(seen[i, j] / met)
            # Of all colours together: one that is not usable spoils the sample.
            usable, variance = True, 0.0
            for c in range(channels):
                first = flat_field[above, left, c] * (1 - s) + flat_field[above, after, c] * s
                second = flat_field[below, left, c] * (1 - s) + flat_field[below, after, c] * s
                value = math.exp(np.float32(first * (1 - t) + second * t + dimmed))
                usable = usable and value > least and value < np.inf
                reading[c] = value
                variance += photons[c] / value
            weights[i, j] = weights[i, j] / np.float32(variance) if usable else np.float32(0)
            if usable:
                for c in range(channels):
                    images[i, j, c] /= reading[c]
