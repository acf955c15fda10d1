"""Pixels by which a tile's shared unknowns are found, developed at any height of the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration.reflectance import FLAT_LOBES, WHITE, highlights
from nlights_core.calibration.unknowns import Shared
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.photographs.development import Darkroom, Raw
from nlights_core.photographs.flat_fields import FlatField


@dataclass(frozen=True)
class Pixels:
    """Some pixels of reduced photographs, and where they look.

    Attributes
    ----------
    rows, columns : (N,) int arrays
        Which, on the room's grid.
    raw : Raw
        Their readings as one row, ``(L, 1, N, C)``.
    plane : (2, 1, N) float32 array
        x and y where their rays meet the plane, mm.
    """

    rows: Array
    columns: Array
    raw: Raw
    plane: Array


@dataclass(frozen=True)
class Samples:
    """Samples of some pixels, relative to the flat.

    Attributes
    ----------
    images, weights : (L, N) float32 arrays
        Grey; and one over the variance of a sample that reads 1, 0 where it must not be used.
    lights : (L, N, 3) float32 array
        Relative to the flat.
    views : (N, 3) float32 array
        Unit vectors to the camera.
    """

    images: Array
    weights: Array
    lights: Array
    views: Array


def choose_pixels(room: Darkroom, raw: Raw, known: Array, wanted: int) -> Pixels:
    """Choose pixels spread evenly over what is known.

    Parameters
    ----------
    room : Darkroom
    raw : Raw
        All its rows.
    known : (h, w) bool array
    wanted : int
        About how many.
    """
    apart = max(1, round(known.sum() / wanted))
    # Each row begins a little over a third further on, so that the pixels lie evenly in all directions.
    rows, columns = np.nonzero(known)
    chosen = (columns + round(0.382 * apart) * rows) % apart == apart // 2
    rows, columns = rows[chosen], columns[chosen]
    some = Raw(
        0,
        1,
        raw.images[:, rows, columns][:, None],
        raw.saturated[:, rows, columns][:, None],
        raw.inside[rows, columns][None],
    )
    plane = np.stack([room.grid.x()[columns], room.grid.y()[rows]]).astype(np.float32)[:, None]
    return Pixels(rows, columns, some, plane)


def develop_pixels(
    room: Darkroom, pixels: Pixels, lights: LightField, flat_field: FlatField, z: Array
) -> Samples:
    """Develop pixels whose surface lies at given heights.

    Parameters
    ----------
    room : Darkroom
    pixels : Pixels
    lights, flat_field : LightField, FlatField
        As they are believed to be.
    z : (N,) array
        Heights, mm.

    Returns
    -------
    Samples
        Those whose ray misses the photographed flat have weight 0: what it would read there is a guess.
    """
    points = _points(room.grid, pixels, z)
    band = room.develop_points(pixels.raw, lights, flat_field, points, pixels.plane)
    reached = within_flat(room.grid, lights, points)[:, 0]
    weights = np.where(reached, band.weights[:, 0] * np.float32(PHOTONS), np.float32(0))
    rays = np.ascontiguousarray(np.broadcast_to(band.lights, (*band.grey.shape, 3))[:, 0])
    return Samples(band.grey[:, 0], weights, rays, view_directions(room.grid, points)[0])


def readings_of_constant(
    room: Darkroom, pixels: Pixels, lights: LightField, flat_field: FlatField, z: Array
) -> Array:
    """Readings that light as bright as the mean flat, the same everywhere, adds to the pixels, (L, N) float32."""
    bright = (
        np.full_like(pixels.raw.images, mean_flat(flat_field))
        / lights.power.astype(np.float32)[:, None, None]
    )
    raw = pixels.raw._replace(images=bright)
    points = _points(room.grid, pixels, z)
    return room.develop_points(raw, lights, flat_field, points, pixels.plane).grey[:, 0]


def corrected(raw: Raw, flat_field: FlatField, shared: Shared, scaled: Array | None) -> Raw:
    """Readings without light that is always there, divided by what the lamps are stronger.

    Parameters
    ----------
    raw : Raw
    flat_field : FlatField
        As it was photographed.
    shared : Shared
    scaled : (h, w, 3) array, optional
        Scaled normals, which say how much of the room's light a pixel reflects.
    """
    always: Array | np.float32 = np.float32(shared.additive * mean_flat(flat_field))
    if shared.room and scaled is not None:
        reflected = np.nan_to_num(np.linalg.norm(scaled, axis=-1)).astype(np.float32)
        always = always + np.float32(shared.room * mean_flat(flat_field)) * reflected[..., None]
    stronger = np.exp(shared.strengths).astype(np.float32)[:, None, None, None]
    return raw._replace(images=(raw.images - always) / stronger)


def mean_flat(flat_field: FlatField) -> float:
    """Mean reading of the flat over lamps, field and colours, as a share of saturation."""
    return float(np.exp(flat_field.logarithm).mean())


BEYOND = 0.01
"""Share of the field's longer side by which a flat may be continued past its photograph: so far its light is known as
well as in it."""


def within_flat(grid: PixelGrid, lights: LightField, points: Array, beyond: float = 0.0) -> Array:
    """Test where a lamp's ray through points meets the plane inside the photographed flat, (L, h, w) bool.

    Parameters
    ----------
    grid : PixelGrid
        Of the photographs.
    lights : LightField
        Near lamps.
    points : (3, h, w) array
        Of the surface, mm.
    beyond : float
        Share of the field's longer side that it may lie outside.
    """
    x, y = np.moveaxis(lights.plane_points(points), 1, 0)
    across, up = half_field(grid, beyond)
    right, above = grid.centre
    return np.asarray((np.abs(x - right) <= across) & (np.abs(y - above) <= up))


def half_field(grid: PixelGrid, beyond: float) -> tuple[float, float]:
    """Half the photographed field, across and up, and a share of its longer side beyond it, mm."""
    margin = beyond * max(grid.shape) + 0.5
    return (grid.columns / 2 + margin) * grid.pixel_size, (grid.rows / 2 + margin) * grid.pixel_size


def view_directions(grid: PixelGrid, points: Array) -> Array:
    """Unit vectors from points (3, h, w) to the camera, (h, w, 3) float32."""
    if grid.camera is None:
        return np.broadcast_to(np.array([0, 0, 1], np.float32), (*points.shape[1:], 3)).copy()
    way = np.stack([np.float32(c) - p for c, p in zip(grid.camera, points, strict=True)], axis=-1)
    return np.asarray(way / np.linalg.norm(way, axis=-1, keepdims=True), np.float32)


def flat_field_of(flat_field: FlatField, lights: LightField, shared: Shared) -> FlatField:
    """The flat field without gloss of the flat and without light that the dark frame lacks."""
    always = (shared.additive + shared.room) * mean_flat(flat_field)
    if not always and not shared.flat_gloss.any():
        return flat_field
    logarithm = np.log(np.maximum(np.exp(flat_field.logarithm) - always, 1e-6))
    if shared.flat_gloss.any():
        logarithm -= np.log1p(_mirrored(flat_field, lights, shared.flat_gloss))[..., None]
    return replace(flat_field, logarithm=logarithm.astype(np.float32))


def _mirrored(flat_field: FlatField, lights: LightField, gloss: Array) -> Array:
    """Gloss of the flat as a share of its matt light, (L, h, w)."""
    _, rows, columns, _ = flat_field.logarithm.shape
    x = flat_field.left + flat_field.step * np.arange(columns)
    y = flat_field.top - flat_field.step * np.arange(rows)
    points = np.stack([*np.meshgrid(x, y), np.zeros((rows, columns))])
    camera = np.array(flat_field.camera if flat_field.camera is not None else (0.0, 0.0, 1e9))
    view = camera - np.moveaxis(points, 0, -1)
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    out = np.empty(flat_field.logarithm.shape[:3])
    for i in range(len(lights.lamps)):
        ray = np.broadcast_to(lights.only(i).vectors(points)[0], view.shape).astype(np.float64)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        lobes = highlights(np.array([0.0, 0.0, 1.0]), ray, view, FLAT_LOBES)
        out[i] = np.tensordot(gloss, lobes, 1) / (WHITE * ray[..., 2])
    return out


def _points(grid: PixelGrid, pixels: Pixels, z: Array) -> Array:
    """Points of the surface that pixels see at given heights, (3, 1, N) float32, mm."""
    points = np.empty((3, 1, len(z)), np.float32)
    points[2] = z
    points[:2] = pixels.plane
    if grid.camera is not None:
        shift = points[2] / np.float32(grid.camera[2])
        for k in range(2):
            points[k] += (np.float32(grid.camera[k]) - points[k]) * shift
    return points
