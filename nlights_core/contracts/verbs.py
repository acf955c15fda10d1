"""Verbs: each kind's one, called with input that cannot be written to, faults that are named, output verified."""

from __future__ import annotations

import inspect
import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nlights_core.algorithms import (
    Algorithm,
    HeightDetrend,
    ImageDetrend,
    Integrator,
    LightModel,
    NormalDetrend,
    NormalSolver,
    Read,
    Solution,
)
from nlights_core.capture import Tile
from nlights_core.contracts.verification import (
    check_slopes,
    checked_bias,
    checked_flat_field,
    checked_height,
    checked_lights,
    checked_solution,
    checked_trend,
    refusal,
)
from nlights_core.errors import NlightsError
from nlights_core.fields import HeightMap, KnownHeights, LightField, NormalField
from nlights_core.frames import Array

Lent = TypeVar("Lent")


def locate(model: LightModel, tile: Tile, read: Read) -> LightField:
    """Ask a light model; see `nlights_core.algorithms.LightModel.locate`.

    Raises
    ------
    TileError
        As the model raises it, or naming the model when it fails or breaks its contract.
    """
    with name_in_faults(model):
        found = model.locate(tile, read)
    return checked_lights(model, found, tile)


def flat_field(
    detrend: ImageDetrend, flats: Array | None, lights: LightField, x: Array, y: Array, channels: int
) -> Array:
    """Ask an image detrend; see `nlights_core.algorithms.ImageDetrend.flat_field`.

    Parameters
    ----------
    detrend : ImageDetrend
        Who is asked.
    flats, lights, x, y : arrays and LightField
        What it is given.
    channels : int
        Colour channels of the photographs.

    Raises
    ------
    TileError
        As for `locate`.
    """
    with name_in_faults(detrend):
        found = detrend.flat_field(lent(flats), lent(lights), lent(x), lent(y))
    return checked_flat_field(detrend, found, (len(lights.lamps), len(y), len(x)), channels)


def solve(solver: NormalSolver, images: Array, lights: Array, weights: Array) -> Solution:
    """Ask a normal solver for a band; see `nlights_core.algorithms.NormalSolver.solve`.

    Raises
    ------
    TileError
        As for `locate`.
    """
    with name_in_faults(solver):
        found = solver.solve(lent(images), lent(lights), lent(weights))
    return checked_solution(solver, found, images.shape)


def bias(detrend: NormalDetrend, reference: NormalField) -> Array:
    """Ask a detrend of normals; see `nlights_core.algorithms.NormalDetrend.bias`.

    Raises
    ------
    TileError
        As for `locate`.
    """
    with name_in_faults(detrend):
        found = detrend.bias(lent(reference))
    return checked_bias(detrend, found, reference.grid.shape)


def integrate(integrator: Integrator, normals: NormalField) -> Array:
    """Ask an integrator; see `nlights_core.algorithms.Integrator.integrate`.

    Returns
    -------
    (H, W) float32 array
        The height, mm.

    Raises
    ------
    TileError
        As for `locate`; also when the height's steps are not those of the normals, see
        `nlights_core.contracts.verification.check_slopes`.
    """
    with name_in_faults(integrator):
        found = integrator.integrate(lent(normals))
    height = checked_height(integrator, found, normals.grid.shape)
    check_slopes(integrator, height, normals)
    return height


def trend(detrend: HeightDetrend, height: HeightMap) -> Array:
    """Ask a detrend of heights; see `nlights_core.algorithms.HeightDetrend.trend`.

    Raises
    ------
    TileError
        As for `locate`.
    """
    with name_in_faults(detrend):
        found = detrend.trend(lent(height))
    return checked_trend(detrend, found, height)


def lent(value: Lent) -> Lent:
    """An array, or a field of arrays, as an algorithm gets it: not to be written to, and not copied.

    Examples
    --------
    >>> own = np.zeros(2)
    >>> lent(own)[0] = 1
    Traceback (most recent call last):
    ValueError: assignment destination is read-only
    >>> own[0] = 1
    """
    if isinstance(value, np.ndarray):
        view = value.view()
        view.flags.writeable = False
        return view
    if is_dataclass(value) and not isinstance(value, type):
        parts = {part.name: getattr(value, part.name) for part in fields(value)}
        kept = (np.ndarray, KnownHeights)
        return replace(value, **{name: lent(part) for name, part in parts.items() if isinstance(part, kept)})
    return value


@contextmanager
def name_in_faults(algorithm: Algorithm) -> Iterator[None]:
    """Name slot, name and distribution of an algorithm in whatever it raises while it works.

    What says itself what to do passes: faults of nLights, of the system, and a lack of memory.

    Raises
    ------
    TileError
        When the algorithm writes into what it was given, fails, or wants to end the program.
    """
    try:
        yield
    except (NlightsError, OSError, MemoryError):
        raise
    except (Exception, SystemExit) as fault:
        if re.search("read-?only", str(fault)):
            what = f"changed its input {_place(algorithm, fault)}; its contract is to work on a copy"
        else:
            what = f"failed with {type(fault).__name__}: {fault} {_place(algorithm, fault)}"
        raise refusal(algorithm, what) from fault


def _place(algorithm: Algorithm, fault: BaseException) -> str:
    """Place in the algorithm's own code where a fault arose, or else where it was raised."""
    own: Any = inspect.getsourcefile(type(algorithm))
    frames = traceback.extract_tb(fault.__traceback__)
    frame = next((f for f in reversed(frames) if f.filename == own), frames[-1])
    return f"({Path(frame.filename).name}:{frame.lineno})"
