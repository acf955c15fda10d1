"""Verification of what an algorithm returned: a plugin's slip stops its tile, named, before it spreads."""

from __future__ import annotations

from typing import Any

import numpy as np

from nlights_core.algorithms import Algorithm, Solution
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap
from nlights_core.frames import Array
from nlights_core.registry import installed


def _refuse(algorithm: Algorithm, what: str) -> TileError:
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
        raise _refuse(algorithm, f"should return {what} as an array of float32; got {kind}")
    if value.shape != shape:
        raise _refuse(algorithm, f"should return {what} of shape {shape}; got {value.shape}")
    return value.astype(np.float32, copy=False)


def checked_solution(algorithm: Algorithm, value: Any, shape: tuple[int, int, int]) -> Solution:
    """What a normal solver returned for a band of (L, h, w) samples.

    Raises
    ------
    TileError
        When a part is of another shape or type, or known normals are not unit vectors towards
        the camera.
    """
    if not isinstance(value, Solution):
        raise _refuse(algorithm, f"should return a Solution; got {type(value).__name__}")
    pixels = shape[1:]
    normals = checked_array(algorithm, "normals", value.normals, (*pixels, 3))
    lengths = np.einsum("hwk,hwk->hw", normals, normals)
    with np.errstate(invalid="ignore"):
        wrong = np.abs(lengths - 1) > 1e-3
    if wrong.any():
        raise _refuse(
            algorithm, f"should return unit normals; got a length of {np.sqrt(lengths[wrong][0]):.4g}"
        )
    confidence = checked_array(algorithm, "confidence", value.confidence, pixels)
    if (confidence < 0).any():
        raise _refuse(algorithm, "should return the confidence as an angle in degrees; got a negative one")
    return Solution(
        normals,
        checked_array(algorithm, "albedo", value.albedo, pixels),
        np.where(np.isfinite(lengths), confidence, np.float32(np.nan)),
        np.nan_to_num(checked_array(algorithm, "weights", value.weights, shape)),
    )


def checked_height(algorithm: Algorithm, value: Any, shape: tuple[int, int]) -> Array:
    """What an integrator returned, (H, W) float32.

    Raises
    ------
    TileError
        When it is no height map of this shape, or nothing in it is known.
    """
    if not isinstance(value, HeightMap):
        raise _refuse(algorithm, f"should return a HeightMap; got {type(value).__name__}")
    height = checked_array(algorithm, "height", value.height, shape)
    if not np.isfinite(height).any():
        raise TileError(
            f"{algorithm.slot}: {algorithm.name} found no height at all: no two neighbouring normals are "
            "known; see the mask, the saturation level and the frames"
        )
    return height


def checked_plate(algorithm: Algorithm, value: Any, shape: tuple[int, int, int], channels: int) -> Array:
    """What an image detrend returned, (L, h, w, C) or (L, h, w, 1) float32.

    Raises
    ------
    TileError
        When it is of another shape.
    """
    depth = value.shape[-1] if isinstance(value, np.ndarray) and value.ndim == 4 else channels
    return checked_array(algorithm, "the plate", value, (*shape, 1 if depth == 1 else channels))
