"""Arrays in, maps out: one step of the chain, without files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nlights.calling import told_in_python
from nlights.maps import Map
from nlights_core.algorithms import Algorithm, Integrator, NormalSolver
from nlights_core.contracts import verbs
from nlights_core.fields import LightField, NormalField
from nlights_core.files.reduction import bands_of_bytes
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.memory import ANY_TILE, require
from nlights_core.photographs import development
from nlights_core.photographs.development import Band
from nlights_core.photographs.images import grey
from nlights_core.recipe import choose
from nlights_core.solving.band_solving import coloured_albedo, solve_band
from nlights_flows.tiles.run_options import RunOptions

LENGTHS = (0.95, 1.05)
"""How long a unit normal may be: those decoded from 8 bits are off by up to 1 %."""


class Solved(NamedTuple):
    """Solution of `solve`, on one grid.

    Attributes
    ----------
    normals : (H, W, 3) float32 Map
        Unit normals in the plane frame, NaN where not known.
    albedo : (H, W) or (H, W, 3) float32 Map
        Of the images' scale.
    confidence : (H, W) float32 Map
        Standard uncertainty of each normal, degrees: 68 % are off by no more.
    """

    normals: Map
    albedo: Map
    confidence: Map


def solve(
    images: ArrayLike,
    lights: ArrayLike | LightField,
    *,
    solver: str | NormalSolver = "robust",
    weights: ArrayLike | None = None,
    grid: PixelGrid | None = None,
    **options: Any,
) -> Solved:
    """Find normals and albedo from images of known lights, pixel by pixel.

    Parameters
    ----------
    images : (L, H, W) or (L, H, W, 3) float array
        Linear light, one image a lamp, 1 at the camera's saturation; NaN where it must not be used, as where it is
        saturated.  May be mapped from a file: it is read by bands of rows, and never copied whole.
    lights : (L, 3) array, or LightField
        Unit vector from the surface to each lamp, times its irradiance: ``images = albedo * (lights . normal)``.  A
        light field may have lamps near by, powers, and ambient light.
    solver : str or NormalSolver
        Name of an installed solver, or one of your own.
    weights : (L, H, W) array, optional
        As `NormalSolver.solve` says, 0 or more; 1 by default.
    grid : PixelGrid, optional
        Where the pixels are; lamps near by need it.  Pixels by default.
    **options
        Of the solver, where it is named.

    Returns
    -------
    Solved
        Normals, albedo and confidence.

    Raises
    ------
    ValueError
        When an array is of another shape or kind than this, naming it.
    RecipeError
        When no solver is called so, or it has no such option.
    TileError
        When the solver breaks its contract.
    """
    chosen = _chosen("normals", solver, options, "solve")
    assert isinstance(chosen, NormalSolver)
    seen = _checked_images(np.asanyarray(images))
    field = lights if isinstance(lights, LightField) else _distant(np.asarray(lights, float), len(seen))
    if len(field.lamps) != len(seen):
        raise ValueError(
            f"lights: of {len(field.lamps)} lamps, but there are {len(seen)} images; give one a lamp"
        )
    if field.near and grid is None:
        raise ValueError("grid: is missing, and lamps near by need it; give a PixelGrid in mm")
    place = grid or PixelGrid(seen.shape[1], seen.shape[2], 1.0, unit="px")
    if seen.shape[1:3] != place.shape:
        raise ValueError(
            f"grid: of {place.shape} pixels, but the images have {seen.shape[1:3]}; they must be alike"
        )
    weighed = None if weights is None else np.asanyarray(weights)
    if weighed is not None and weighed.shape != seen.shape[:3]:
        raise ValueError(
            f"weights: should be of shape {seen.shape[:3]}, one for every sample; got {weighed.shape}"
        )
    out = Solved(
        Map(np.empty((*place.shape, 3), np.float32), place, ""),
        Map(np.empty(seen.shape[1:], np.float32), place, ""),
        Map(np.empty(place.shape, np.float32), place, "°"),
    )
    work = partial(_solved_band, chosen, seen, field, weighed, place)
    size = len(seen) * (4 * (seen.shape[3] if seen.ndim == 4 else 1) + 24)
    for rows, parts in in_order(work, (slice(*ends) for ends in development.bands_of_grid(place, size))):
        for whole, part in zip(out, parts, strict=True):
            whole[rows] = part
    return out


def _checked_images(images: Array) -> Array:
    """Images as they must be: floats, a stack of three or more, in grey or of three colours."""
    if images.dtype.kind != "f":
        raise ValueError(
            f"images: should be linear light as floats, 1 at saturation; got {images.dtype}; divide by the number at "
            "which the camera saturates, for instance images / np.float32(65535)"
        )
    if images.ndim not in (3, 4) or (images.ndim == 4 and images.shape[3] != 3):
        raise ValueError(
            f"images: should be of shape (L, H, W) or (L, H, W, 3); got {images.shape}; stack the photographs with "
            "np.stack"
        )
    if len(images) < 3:
        raise ValueError(
            f"images: photometric stereo needs at least 3 lamps; got {len(images)}; the first axis is the lamps'"
        )
    return images


def _distant(lights: Array, count: int) -> LightField:
    """Lights that are the same everywhere."""
    if lights.shape != (count, 3):
        raise ValueError(
            f"lights: should be of shape ({count}, 3), a vector for each image; got {lights.shape}; the first axis "
            "of images is the lamps'"
        )
    if not np.isfinite(lights).all():
        raise ValueError("lights: should be finite; got NaN or infinity; leave that lamp and its image out")
    return LightField(tuple(str(i + 1) for i in range(count)), directions=lights)


def _solved_band(
    solver: NormalSolver,
    images: Array,
    field: LightField,
    weights: Array | None,
    grid: PixelGrid,
    rows: slice,
) -> tuple[slice, tuple[Array, Array, Array]]:
    """Solve some rows: normals, albedo, confidence."""
    part = np.array(images[:, rows], np.float32)
    part = part.reshape(*part.shape[:3], -1)
    usable: Array = np.isfinite(part.sum(axis=-1))
    weight: Array = usable.astype(np.float32)
    if weights is not None:
        given = np.asarray(weights[:, rows], np.float32)
        if not (given >= 0).all() or np.isinf(given).any():
            raise ValueError("weights: should be finite, 0 or more; a sample that must not be used has 0")
        weight *= given
    part[~usable] = 0
    part /= field.power.astype(np.float32)[:, None, None, :]
    ambient = None
    if field.ambient.any():
        ambient = np.broadcast_to(field.ambient.astype(np.float32)[:, None, None], weight.shape)
    lights = field.vectors(grid.points(rows.start, rows.stop))
    band = Band(rows.start, rows.stop, part, weight, ~usable, lights, ambient, grey(part))
    found = solve_band(solver, band)
    if images.ndim == 3:
        return rows, (found.normals, found.albedo, found.confidence)
    shading = np.stack([(light * found.normals).sum(axis=-1) for light in lights])
    if ambient is not None:
        shading += ambient
    return rows, (found.normals, coloured_albedo(part, shading, found.weights), found.confidence)


def integrate(
    normals: ArrayLike,
    *,
    pixel_size: float | None = None,
    camera: tuple[float, float, float] | None = None,
    confidence: ArrayLike | None = None,
    integrator: str | Integrator = "simchony",
    memory: str | None = None,
    **options: Any,
) -> Map:
    """Integrate a field of normals to a height.

    Parameters
    ----------
    normals : (H, W, 3) float array
        Unit normals x, y, z: x right, y up (rows go down), z to the camera; NaN where not known.
    pixel_size : float, optional
        Edge of a pixel, mm.  Without it a `Map` brings its own grid, and of other arrays the height is in pixels.
    camera : (x, y, z), optional
        Centre of projection in the plane frame, in the unit of the height; else that of the map's grid, or none: seen
        straight on everywhere.
    confidence : (H, W) array, optional
        Standard uncertainty of each normal, degrees, for an integrator that weighs by it.
    integrator : str or Integrator
        Name of an installed integrator, or one of your own.
    memory : str, optional
        What may be taken, as ``"6GiB"``; half of the machine's by default.
    **options
        Of the integrator, where it is named.

    Returns
    -------
    (H, W) float32 Map
        z towards the camera in mm or px; mean 0, NaN where not known.

    Raises
    ------
    ValueError
        When an array is of another shape or kind than this, naming it.
    RecipeError
        When no integrator is called so, or it has no such option.
    TileError
        When the field does not fit the memory, or the integrator breaks its contract.
    """
    chosen = _chosen("integrator", integrator, options, "integrate")
    assert isinstance(chosen, Integrator)
    given = np.asanyarray(normals)
    _check_normals(given)
    trust = None if confidence is None else np.asanyarray(confidence)
    if trust is not None and trust.shape != given.shape[:2]:
        raise ValueError(
            f"confidence: should be of shape {given.shape[:2]}, as the normals; got {trust.shape}"
        )
    grid = _grid_of(given, pixel_size, camera)
    with told_in_python(), RunOptions(memory=memory).in_force():
        require(ANY_TILE + chosen.bytes_per_pixel * grid.rows * grid.columns, f"integrator: {chosen.name}")
        plain = [None if a is None else np.asarray(a, np.float32) for a in (given, trust)]
        assert plain[0] is not None
        return Map(verbs.integrate(chosen, NormalField(plain[0], grid, plain[1])), grid, grid.unit)


def _grid_of(
    normals: Array, pixel_size: float | None, camera: tuple[float, float, float] | None
) -> PixelGrid:
    """Grid of the normals: as is said, else as they know themselves, else in pixels."""
    rows, columns = normals.shape[:2]
    if pixel_size is not None:
        if not 0 < pixel_size < np.inf:
            raise ValueError(f"pixel_size: should be a length above 0, in mm; got {pixel_size}")
        grid = PixelGrid(rows, columns, float(pixel_size))
    elif isinstance(normals, Map) and normals.is_whole:
        grid = normals.grid
    else:
        grid = PixelGrid(rows, columns, 1.0, unit="px")
    return grid if camera is None else replace(grid, camera=camera)


def _check_normals(normals: Array) -> None:
    """Refuse what are no unit normals, as the colours of a normal map."""
    if normals.ndim != 3 or normals.shape[2] != 3 or min(normals.shape) < 2:
        raise ValueError(
            f"normals: should be of shape (H, W, 3), 2 pixels or more each way; got {normals.shape}"
        )
    if normals.dtype.kind != "f":
        raise ValueError(
            f"normals: should be unit vectors as floats; got {normals.dtype}; colours are decoded by v / 127.5 - 1"
        )
    for lengths in _lengths(normals):
        wrong = (lengths < LENGTHS[0]) | (lengths > LENGTHS[1])
        if wrong.any():
            raise ValueError(
                f"normals: should be unit vectors; got a length of {lengths[wrong][0]:.4g}; divide them by "
                "np.linalg.norm(normals, axis=-1, keepdims=True)"
            )


def _lengths(normals: Array) -> Iterator[Array]:
    for rows in bands_of_bytes(len(normals), normals[:1].nbytes):
        yield np.linalg.norm(normals[rows], axis=-1)


def _chosen(slot: str, algorithm: str | Algorithm, options: dict[str, Any], whose: str) -> Algorithm:
    """An algorithm by its name and its options, or one that is there."""
    if isinstance(algorithm, str):
        return choose(slot, algorithm, options, whose)
    if not isinstance(algorithm, Algorithm) or algorithm.slot != slot:
        raise ValueError(f"{slot}: should be the name of an algorithm or one itself; got {algorithm!r}")
    if options:
        raise ValueError(
            f"{', '.join(options)}: options go with the name of an algorithm; give {type(algorithm).__name__} its "
            "own when it is made"
        )
    return algorithm
