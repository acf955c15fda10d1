"""Verification of what an algorithm returned: a plugin's slip stops its tile, named, before it spreads."""

from __future__ import annotations

from typing import Any

import numpy as np

from nlights_core.algorithms import Algorithm, Solution
from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, LightField, NormalField
from nlights_core.frames import Array
from nlights_core.registry import installed

FACTOR = 3.0
"""What differs by more than this factor from what it should agree with is in another unit."""

CORRELATION = 0.5
"""Steps of the height that go along with the normals' less closely than this say nothing of a unit:
they are mostly noise.  A least-squares surface reaches 0.7 on noise alone."""

SAMPLES = 200
"""Rows and columns at which heights are compared with normals."""


def refusal(algorithm: Algorithm, what: str) -> TileError:
    """The fault of an algorithm that breaks its contract, naming slot, name and distribution."""
    return TileError(
        f"{algorithm.slot}: {algorithm.name} ({installed().origin(algorithm)}) {what}; report it to its "
        "author, or choose another algorithm"
    )


def checked_array(algorithm: Algorithm, what: str, value: Any, shape: tuple[int, ...]) -> Array:
    """An array that an algorithm returned, as float32 and of the shape that its contract says.

    Parameters
    ----------
    algorithm : Algorithm
        Who returned it.
    what : str
        What it should be, for the sentence.
    value : Any
        What it is.
    shape : tuple of int
        What it should have.

    Raises
    ------
    TileError
        Naming the algorithm, its origin, what was expected and what was found.
    """
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise refusal(algorithm, f"should return {what} as an array of float32; got {kind}")
    if value.shape != shape:
        raise refusal(algorithm, f"should return {what} of shape {shape}; got {value.shape}")
    return value.astype(np.float32, copy=False)


def checked_solution(algorithm: Algorithm, value: Any, shape: tuple[int, int, int]) -> Solution:
    """Check the solution that a normal solver returned for a band of (L, h, w) samples.

    Raises
    ------
    TileError
        When a part is of another shape or type, or known normals are not unit vectors towards
        the camera.
    """
    if not isinstance(value, Solution):
        raise refusal(algorithm, f"should return a Solution; got {type(value).__name__}")
    pixels = shape[1:]
    normals = checked_array(algorithm, "normals", value.normals, (*pixels, 3))
    lengths = np.einsum("hwk,hwk->hw", normals, normals)
    with np.errstate(invalid="ignore"):
        wrong = np.abs(lengths - 1) > 1e-3
    if wrong.any():
        raise refusal(
            algorithm, f"should return unit normals; got a length of {np.sqrt(lengths[wrong][0]):.4g}"
        )
    confidence = checked_array(algorithm, "confidence", value.confidence, pixels)
    if (confidence < 0).any():
        raise refusal(algorithm, "should return the confidence as an angle in degrees; got a negative one")
    return Solution(
        normals,
        checked_array(algorithm, "albedo", value.albedo, pixels),
        np.where(np.isfinite(lengths), confidence, np.float32(np.nan)),
        np.nan_to_num(checked_array(algorithm, "weights", value.weights, shape)),
    )


def checked_height(algorithm: Algorithm, value: Any, shape: tuple[int, int]) -> Array:
    """Check the height that an integrator returned, (H, W) float32.

    Raises
    ------
    TileError
        When it is no height map of this shape, or nothing in it is known.
    """
    if not isinstance(value, HeightMap):
        raise refusal(algorithm, f"should return a HeightMap; got {type(value).__name__}")
    height = checked_array(algorithm, "height", value.height, shape)
    if not np.isfinite(height).any():
        raise TileError(
            f"{algorithm.slot}: {algorithm.name} found no height at all: no two neighbouring normals are "
            "known; see the mask, the saturation level and the frames"
        )
    return height


def check_slopes(algorithm: Algorithm, height: Array, normals: NormalField) -> None:
    """Refuse a height in another unit than the grid's, or one that grows away from the camera.

    Parameters
    ----------
    algorithm : Algorithm
        Who found the height.
    height : (H, W) float32 array
        What it found.
    normals : NormalField
        What it was given.

    Raises
    ------
    TileError
        When steps of the height are more than `FACTOR` times as high or as low as the normals say,
        or fall where they should rise.

    Notes
    -----
    Steps h between neighbouring pixels are compared with the mean g of the two pixels' slopes.
    A least-squares surface is a projection of the slopes, so that ``sum(h g) = sum(h h)`` however
    noisy the slopes are, and a factor between units is ``sum(h h) / sum(h g)``.  The five percent of
    steps that are highest are left out: at an edge the slope is not known.
    """
    rows, columns = (np.arange(0, n - 1, max(1, n // SAMPLES)) for n in height.shape)
    here, right, below = np.ix_(rows, columns), np.ix_(rows, columns + 1), np.ix_(rows + 1, columns)
    across, down = (
        NormalField(np.stack([normals.normals[here], normals.normals[there]]), normals.grid).gradient()[axis]
        for axis, there in enumerate((right, below))
    )
    said = np.stack([across.mean(axis=0), down.mean(axis=0)]).astype(np.float64)
    found = np.stack([height[right] - height[here], height[below] - height[here]]).astype(np.float64)
    known = np.isfinite(said) & np.isfinite(found)
    said, found = said[known], found[known]
    if not found.size:
        return
    usual = np.abs(found) <= np.quantile(np.abs(found), 0.95)
    said, found = said[usual], found[usual]
    together = float(said @ found)
    if abs(together) <= CORRELATION * np.sqrt((said @ said) * (found @ found)):
        return
    if together < 0:
        raise refusal(
            algorithm,
            "should return height that grows towards the camera; got one that falls where the normals say that "
            "the surface rises",
        )
    factor = float(found @ found) / together
    if not 1 / FACTOR < factor < FACTOR:
        raise refusal(
            algorithm,
            f"should return height in {normals.grid.unit}; got steps that are {factor:.3g} times what the normals "
            "say, as in another unit",
        )


def checked_lights(algorithm: Algorithm, value: Any, tile: Tile) -> LightField:
    """Check the light field that a light model returned for a tile.

    Raises
    ------
    TileError
        When it is no light field of the tile's lamps, a number of it is not finite, a power is not
        positive, a direction is no unit vector, or lamps are more than `FACTOR` times as far away as
        the tile's stand says.
    """
    if not isinstance(value, LightField):
        raise refusal(algorithm, f"should return a LightField; got {type(value).__name__}")
    if value.lamps != tile.lamps:
        raise TileError(
            f"{tile.artwork}/{tile.name}: light_model: {algorithm.name} found lights for "
            f"{', '.join(value.lamps)}, but the frames are of {', '.join(tile.lamps)}"
        )
    for name in ("positions", "directions", "power", "ambient", "axes", "exponents"):
        array = getattr(value, name)
        if array is not None and not np.isfinite(array).all():
            raise refusal(
                algorithm, f"should return finite {name} of the lamps; got {array[~np.isfinite(array)][0]}"
            )
    if not (value.power > 0).all():
        raise refusal(algorithm, f"should return a positive power of every lamp; got {value.power.min():.4g}")
    for name in ("directions", "axes"):
        lengths = np.ones(1) if getattr(value, name) is None else np.linalg.norm(getattr(value, name), axis=1)
        worst = float(lengths[np.argmax(np.abs(lengths - 1))])
        if abs(worst - 1) > 1e-3:
            raise refusal(algorithm, f"should return {name} as unit vectors; got a length of {worst:.4g}")
    if value.positions is not None and tile.stand is not None and set(tile.lamps) <= set(tile.stand.lamps):
        measured = np.linalg.norm(tile.stand.lamp_positions(tile.lamps), axis=1)
        factor = float(np.median(np.linalg.norm(value.positions, axis=1) / measured))
        if not 1 / FACTOR < factor < FACTOR:
            raise refusal(
                algorithm,
                f"should return positions in mm; got lamps {factor:.3g} times as far away as the stand "
                f"'{tile.stand.name}' says, as in another unit",
            )
    return value


def checked_flat_field(algorithm: Algorithm, value: Any, shape: tuple[int, int, int], channels: int) -> Array:
    """Check the flat field that an image detrend returned, (L, h, w, C) or (L, h, w, 1) float32.

    Raises
    ------
    TileError
        When it is of another shape, negative or infinite.  0 counts as not known.
    """
    depth = value.shape[-1] if isinstance(value, np.ndarray) and value.ndim == 4 else channels
    reading = checked_array(algorithm, "the flat field", value, (*shape, 1 if depth == 1 else channels))
    wrong = (reading < 0) | np.isinf(reading)
    if wrong.any():
        raise refusal(algorithm, f"should return a positive flat field; got {reading[wrong][0]:.4g}")
    return reading


def checked_bias(algorithm: Algorithm, value: Any, shape: tuple[int, int]) -> Array:
    """Check the bias that a detrend of normals returned, (H, W, 3) float32.

    Raises
    ------
    TileError
        When it is of another shape, not finite everywhere, or larger than unit vectors can differ.
    """
    found = _finite(algorithm, "the bias", value, (*shape, 3))
    largest = max((float(np.abs(row).max()) for row in found), default=0.0)
    if largest > 2:
        raise refusal(algorithm, f"should return a difference of unit vectors; got {largest:.4g}")
    return found


def checked_trend(algorithm: Algorithm, value: Any, field: HeightMap) -> Array:
    """Check the trend that a detrend of heights returned, (H, W) float32.

    Raises
    ------
    TileError
        When it is of another shape, not finite everywhere, or varies more than `FACTOR` times as much
        as the height itself, or as the heights that somebody measured.
    """
    height = field.height
    found = _finite(algorithm, "the trend", value, height.shape)
    step = max(1, max(height.shape) // SAMPLES)
    before, removed = height[::step, ::step], found[::step, ::step]
    known = np.isfinite(before)
    if known.any():
        spread, own = float(np.std(removed[known])), float(np.std(before[known]))
        if field.known is not None and len(field.known.points):
            # Photographs may have lost a bow that was measured.
            own = max(own, float(np.std(field.known.points[:, 2])))
        # Below a micrometre it is rounding that varies.
        if spread > max(FACTOR * own, 1e-3):
            raise refusal(
                algorithm,
                f"should return the trend in the height's unit; got one that varies by {spread:.3g} where the "
                f"height varies by {own:.3g}",
            )
    return found


def _finite(algorithm: Algorithm, what: str, value: Any, shape: tuple[int, ...]) -> Array:
    """An array that must be known everywhere; looked at row by row, for it may be large."""
    found = checked_array(algorithm, what, value, shape)
    if not all(np.isfinite(row).all() for row in found):
        raise refusal(algorithm, f"should return {what} finite everywhere; got NaN or infinity")
    return found
