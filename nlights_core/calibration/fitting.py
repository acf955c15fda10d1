"""Fitting: rounds in which a tile's coarse height and what all its pixels share are found together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration import evidence
from nlights_core.calibration.linearisation import TUNING, Equations, improve_normals, linearise
from nlights_core.calibration.sampling import (
    Samples,
    choose_pixels,
    corrected,
    flat_field_of,
    view_directions,
)
from nlights_core.calibration.unknowns import Shared, groups, nothing, prior
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.near_light.overview import ReducedRoom
from nlights_core.photographs.development import Raw
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving.least_squares import fit, lit

PIXELS = 20_000
"""About how many pixels have a say."""

ROUNDS = 5
"""In which values and height are found; a level of millimetres bends the relief, which bends the level: each round
leaves a fifth of it."""

WITHOUT_CHOICE = 2
"""Rounds in which all groups are fitted: before the others are nearly right, evidence of one is not."""

STRANGE = 8.0
"""Pixels whose residual is so many times the median pixel's are of another material, such as gold: they have no say,
neither here nor in the coarse height."""

SHADOW = 0.05
"""Share of the brightest sample below which one is taken to be in shadow."""

CONDITION = 100.0
"""Of the lights of a pixel; a worse one leaves it unknown."""

STEEPEST_DEG = 70.0
"""To which slopes are limited: means over blocks are hardly ever so steep."""


@dataclass(frozen=True)
class Calibration:
    """What all pixels of a tile share, and how well it is known.

    Attributes
    ----------
    shared : Shared
    free : tuple of int
        Places of the unknowns that were fitted, among `Shared.vector`.
    believed : tuple of str
        Groups of which there is evidence.
    covariance : (M, M) float64 array
        Of the unknowns; 0 where not fitted.
    equations : Equations
        Of the last round.
    height : (h, w) float32 array
        Of the reduced photographs, level included, mm; NaN where not known.
    strange : (h, w) bool array
        Pixels of another material.
    """

    shared: Shared
    free: tuple[int, ...]
    believed: tuple[str, ...]
    covariance: Array
    equations: Equations
    height: Array
    strange: Array


def calibrate(
    room: ReducedRoom,
    lights: LightField,
    flat_field: FlatField,
    chosen: tuple[str, ...],
    progress: Callable[[float], None] = lambda _: None,
) -> Calibration:
    """Find what all pixels of a tile share.

    Parameters
    ----------
    room : ReducedRoom
        The photographs as means over blocks.
    lights, flat_field : LightField, FlatField
        Near lamps, and what a flat reads.
    chosen : tuple of str
        Groups that may be believed; and "level", which always is where it is sought.
    progress : callable
        Told the share done.

    Raises
    ------
    TileError
        When no normal could be found.
    """
    raw = room.raw(0, room.grid.rows, lights)
    count = len(lights.lamps)
    kinds = [group for group in groups(count) if group.name in chosen]
    always = (0,) if "level" in chosen else ()
    shared, z = nothing(count), np.zeros(room.grid.shape, np.float32)
    scaled: Array | None = None
    spread = 0.0
    for round_number in range(ROUNDS + 1):
        flat = flat_field_of(flat_field, lights, shared)
        readings = corrected(raw, flat_field, shared, scaled)
        scaled, surprise = _solve(room, readings, lights, flat, z, shared, scaled, spread)
        strange = _strange(surprise)
        z = _integrate(room, scaled, strange, shared.level)
        progress((round_number + 1) / (ROUNDS + 1))
        if round_number == ROUNDS:
            break
        known = np.isfinite(scaled[..., 0]) & ~strange & raw.inside
        pixels = choose_pixels(room, readings, known, PIXELS)
        place = (pixels.rows, pixels.columns)
        equations = linearise(room, pixels, lights, flat, z[place], scaled[place], shared)
        spread = equations.scale
        precisions, centres = prior(shared)
        right = equations.right + equations.matrix @ shared.vector()
        found = evidence.choose(
            equations.matrix, right, precisions, centres, kinds, round_number < WITHOUT_CHOICE, always
        )
        shared = shared.moved(found.values)
    return Calibration(
        shared, found.free, found.believed, _covariance(equations, shared, found), equations, z, strange
    )


def _covariance(equations: Equations, shared: Shared, found: evidence.Found) -> Array:
    """Covariance of the unknowns that were fitted, (M, M): the larger of two ways to find it.

    The scatter of the equations between parts of the field knows what neighbours share; the posterior, that what is
    wrong everywhere does not scatter.
    """
    precisions, _ = prior(shared)
    places = np.array(found.free, np.intp)
    block = np.ix_(places, places)
    inverse = np.linalg.inv(equations.matrix[block] + np.diag(precisions[places]))
    scattered = inverse @ (equations.scatter[block] + np.diag(precisions[places])) @ inverse
    out = np.zeros_like(equations.matrix)
    out[block] = _larger(inverse, scattered)
    return out


def _larger(one: Array, other: Array) -> Array:
    """The least covariance that is no smaller than one, and in no direction of that smaller than another."""
    root = np.linalg.cholesky(one)
    back = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(back @ other @ back.T)
    wide = root @ vectors
    return np.asarray((wide * np.maximum(values, 1)) @ wide.T)


def _solve(
    room: ReducedRoom,
    raw: Raw,
    lights: LightField,
    flat_field: FlatField,
    z: Array,
    shared: Shared,
    before: Array | None,
    spread: float,
) -> tuple[Array, Array]:
    """Scaled normals (h, w, 3) float64 of all pixels, and their residuals (h, w) in standard deviations."""
    band = room.develop(raw, lights, flat_field, z)
    count, *shape = band.grey.shape
    weights = lit(band.grey, band.weights, SHADOW)
    rays = np.broadcast_to(band.lights, (count, *shape, 3))
    scaled = (
        np.moveaxis(fit(band.grey, rays, weights, CONDITION).scaled, 0, -1).reshape(-1, 3).astype(np.float64)
    )
    if before is not None:
        # Begin where the last round ended: a highlight has more than one answer.
        known = np.isfinite(before.reshape(-1, 3)[:, 0])
        scaled[known] = before.reshape(-1, 3)[known]
    views = view_directions(room.grid, room.grid.points(0, room.grid.rows, z)).reshape(-1, 3)
    weights = weights.reshape(count, -1) * np.float32(PHOTONS)
    samples = Samples(band.grey.reshape(count, -1), weights, rays.reshape(count, -1, 3), views)
    limit = TUNING * spread if spread else np.inf
    surprise = improve_normals(samples, shared, scaled, limit, 3)
    if not spread:
        # How large residuals are is not known before all samples have counted the same.
        limit = TUNING * max(1.0, float(np.nanmedian(surprise)))
        surprise = improve_normals(samples, shared, scaled, limit, 3)
    if not np.isfinite(scaled).any():
        raise TileError(
            "calibration: not a single block has three usable lights; see the mask, the saturation level and "
            "the frames themselves"
        )
    return scaled.reshape(*shape, 3), surprise.reshape(shape)


def _strange(surprise: Array) -> Array:
    """Mark pixels of another material than most."""
    with np.errstate(invalid="ignore"):
        return np.asarray(surprise > STRANGE * np.nanmedian(surprise))


def _integrate(room: ReducedRoom, scaled: Array, strange: Array, level: float) -> Array:
    """Height of mean ``level``, (h, w) float32 mm; pixels of another material get the median normal."""
    from scipy.ndimage import binary_dilation

    size = np.linalg.norm(scaled, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        normals = (scaled / size).astype(np.float32)
    if strange.any():
        wide = binary_dilation(strange, iterations=2) & np.isfinite(normals[..., 0])
        normals[wide] = np.nanmedian(normals[~wide], axis=0)
    height = least_squares_height(normals, room.grid, stencil="6-point", steepest_deg=STEEPEST_DEG)
    height += np.float32(level - np.nanmean(height))
    return np.where(np.isnan(height), np.float32(level), height).astype(np.float32)
