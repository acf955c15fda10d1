"""Relation of developed photographs to the flat field: what a sample is divided by, and the light that is left."""

from __future__ import annotations

import numpy as np

from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.photographs.images import EYE
from nlights_core.photographs.noise import Noise


def grey_shares(channels: int, flat_field: FlatField | None) -> Array:
    """Share of each channel in the grey that a solver sees, (C,) float32: the flat field's, or else the eye's."""
    if flat_field is not None and len(flat_field.shares) == channels:
        return np.asarray(flat_field.shares, np.float32)
    return np.asarray(EYE if channels > 1 else np.ones(1), np.float32)


def relate(
    images: Array,
    weights: Array,
    ambient: Array | None,
    lights: LightField,
    flat_field: FlatField,
    points: Array,
    pixels: Array | None,
    noise: Noise,
    mix: Array,
) -> tuple[Array, Array | None]:
    """Divide images by the flat field and weigh them, in place; make the lights relative to it.

    The flat field is read where each lamp's ray through a point meets the plane (numerics, section
    1): power, emission and fall-off cancel there, and only geometry is left.
    """
    vectors, origins = lights.vectors(points), lights.plane_points(points)
    relative = np.empty((len(images), *points.shape[1:], 3), np.float32)
    for i, power in enumerate(lights.power.astype(np.float32)):
        x, y = origins[i if len(origins) > 1 else 0]
        reading = flat_field.at(i, x, y, pixels)
        # A flat field that is not known, or nearly dark, leaves the sample unknown.
        usable: Array = np.all(np.isfinite(reading) & (reading > 1e-6 * flat_field.brightest), axis=-1)
        reading = np.where(usable[..., None], reading, np.float32(1))
        images[i] /= reading
        weights[i] *= np.where(usable, 1 / noise.photons(reading * power, mix), np.float32(0))
        if ambient is not None:
            ambient[i] *= (mix / reading).sum(axis=-1)
        if lights.near:
            on_plane = lights.only(i).vectors(np.stack([x, y, np.zeros_like(x)]))[0, ..., 2]
            relative[i] = vectors[i] / on_plane[..., None]
        else:
            relative[i] = vectors[i] / vectors[i, ..., 2:]
    return relative, ambient


def relate_compiled(
    images: Array,
    weights: Array,
    lights: LightField,
    flat_field: FlatField,
    points: Array,
    pixels: Array | None,
    photons: Array,
) -> Array:
    """Do as `relate` does, for near lamps without ambient light; ``photons`` (L, C) is the variance they bring."""
    from nlights_core.photographs import compiled_relation

    assert lights.positions is not None
    relative = np.empty((len(images), *points.shape[1:], 3), np.float32)
    seen, lens = np.empty((0, 0), np.float32), np.zeros(4)
    if pixels is not None and flat_field.camera is not None:
        x, y, z = flat_field.camera
        lens = np.array([x, y, z**-2, flat_field.vignetting])
        seen = 1 + ((pixels[0] - np.float32(x)) ** 2 + (pixels[1] - np.float32(y)) ** 2) * np.float32(z**-2)
    place, least = np.array([flat_field.left, flat_field.top, flat_field.step]), 1e-6 * flat_field.brightest
    for i, position in enumerate(lights.positions):
        # A computed flat field has one channel, whatever the photographs have.
        own = np.broadcast_to(flat_field.logarithm[i], (*flat_field.logarithm.shape[1:3], images.shape[-1]))
        own = np.require(own, np.float32, ["C", "W"])
        compiled_relation.relate(
            points, position, own, place, lens, seen, photons[i], least, images[i], weights[i], relative[i]
        )
    return relative
