"""Correction of photographs by a calibration, so that any normal solver sees a matt surface under known light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration.linearisation import MISFIT, TUNING, improve_normals
from nlights_core.calibration.reflectance import Reflectance, excess
from nlights_core.calibration.sampling import (
    BEYOND,
    Samples,
    half_field,
    mean_flat,
    view_directions,
    within_flat,
)
from nlights_core.calibration.unknowns import Shared, nothing
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.photographs.development import Band
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.photographs.strips import Blocks, Optics, Strip
from nlights_core.solving.least_squares import fit, lit

SHADOW = 0.02
"""Share of the brightest sample below which one is taken to be in shadow."""

CONDITION = 100.0
"""Of the lights of a pixel; what is worse stays as it is."""

ROUNDS = 5
"""Of Gauss and Newton: a normal that a highlight depends on moves by ever less."""


def known_lights(lights: LightField, flat_field: FlatField, shared: Shared) -> LightField:
    """The lamps with the strengths, and the light of the room, that a calibration found."""
    stronger = lights.stronger(np.exp(shared.strengths))
    if not shared.room:
        return stronger
    return replace(stronger, ambient=np.full(len(lights.lamps), shared.room * mean_flat(flat_field)))


def take_out_gloss(band: Band, grid: PixelGrid, height: Array | None, reflectance: Reflectance) -> Band:
    """Subtract from the samples of a band what they read beyond matt paint.

    Parameters
    ----------
    band : Band
        Developed.
    grid : PixelGrid
        Of the tile.
    height : (h, w) array, optional
        Of these rows, mm.
    reflectance : Reflectance
        Of the tile.

    Returns
    -------
    Band
        The same where no normal could be found.
    """
    count, *shape = band.grey.shape
    rays = np.broadcast_to(band.lights, (count, *shape, 3)).reshape(count, -1, 3)
    weights = lit(band.grey, band.weights, SHADOW).reshape(count, -1) * np.float32(PHOTONS)
    grey = band.grey.reshape(count, -1)
    scaled = np.ascontiguousarray(fit(grey, rays, weights, CONDITION).scaled.T, np.float64)
    views = view_directions(grid, grid.points(band.start, band.stop, height)).reshape(-1, 3)
    shared = replace(
        nothing(count),
        gloss=reflectance.gloss,
        roughnesses=reflectance.roughnesses,
        grazing=reflectance.grazing,
        departure=reflectance.departure,
    )
    improve_normals(Samples(grey, weights, rays, views), shared, scaled, 2 * TUNING, ROUNDS)
    albedo = np.linalg.norm(scaled, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        gloss, departure = excess(reflectance, scaled / albedo[:, None], rays.astype(np.float64), views)
    gloss, departure = (np.nan_to_num(part).astype(np.float32) for part in (gloss, departure))
    albedo = np.nan_to_num(albedo).astype(np.float32)
    plain = grey - gloss
    # A channel's albedo is to the grey one as its light is.
    share = np.where(albedo > 0, albedo / np.maximum(np.abs(plain).sum(axis=0), np.float32(1e-12)), 0)
    images = band.images.reshape(count, -1, band.images.shape[-1]) - gloss[..., None]
    coloured = images.sum(axis=0) * share[:, None]
    images = images - departure[..., None] * coloured
    return replace(
        band,
        images=images.reshape(band.images.shape),
        grey=(plain - departure * albedo).reshape(band.grey.shape),
    )


def correct_strip(
    strip: Strip, optics: Optics, blocks: Blocks, grid: PixelGrid, reflectance: Reflectance, missed: bool
) -> Array:
    """Do as `take_out_gloss` and `leave_out_unreached` do, with developed blocks of a strip, in place.

    Parameters
    ----------
    strip, optics, blocks : Strip, Optics, Blocks
        See `nlights_core.photographs.strips`.
    grid : PixelGrid
        Of the tile.
    reflectance : Reflectance
    missed : bool
        Whether samples whose ray misses the photographed flat are left out.

    Returns
    -------
    (h, w, 3) float32 array
        What was taken out of the apparent colour.
    """
    from nlights_core.calibration.compiled_correction import correct_blocks
    from nlights_core.photographs.blocks import BLOCK

    reach = np.array(half_field(grid, BEYOND) if missed else (np.inf, np.inf))
    removed = np.empty((len(blocks.samples), 3 * BLOCK), np.float32)
    correct_blocks(
        strip.x, strip.y, strip.height, optics, blocks, reach, reflectance.gloss, reflectance.roughnesses,
        reflectance.grazing, reflectance.departure, SHADOW, MISFIT, 2 * TUNING, ROUNDS, removed,
    )  # fmt: skip
    rows, columns = len(strip.y), len(strip.x)
    colours = removed.reshape(rows, -1, 3, BLOCK).swapaxes(2, 3).reshape(rows, -1, 3)
    return colours[:, :columns]


def leave_out_unreached(band: Band, grid: PixelGrid, height: Array | None, lights: LightField) -> Band:
    """Leave out of a band the samples whose ray misses the photographed flat: what it would read there is a guess."""
    points = grid.points(band.start, band.stop, height)
    reached = within_flat(grid, lights, points, BEYOND)
    return replace(band, weights=np.where(reached, band.weights, np.float32(0)))


def unreached(grid: PixelGrid, height: Array, lights: LightField) -> float:
    """Share of the samples of a height map whose ray misses the photographed flat."""
    return 1 - float(within_flat(grid, lights, grid.points(0, grid.rows, height), BEYOND).mean())
