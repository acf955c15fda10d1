"""Sets of flats with the board turned in its plane: what turns with it is the board's, the rest is the lamps'."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField
from nlights_core.frames import Array

DEGREE = 4
"""Of the polynomials in x and y by which a board is bowed and uneven: boards bend smoothly."""

SMALLEST = 0.03
"""Singular value, as a share of the largest, below which a shape changes too little when the board is turned: with a
tenth of it noise of 0.1 % made smooth errors five times as large, and no shape was found better."""

BOWED = 1e-4
"""Height of a board from its lowest to its highest part, as a share of the field's longer side, that is too much:
0.05 mm on 500 mm bend a height by 0.01 to 0.02 mm."""

STEP = 1.0
"""Over which the light's change with height is taken, mm."""


def without_board(
    readings: Sequence[Array], turns_deg: Sequence[float], lights: LightField, x: Array, y: Array
) -> tuple[Array, float]:
    """Average sets of flats, each without what turns with the board.

    Parameters
    ----------
    readings : sequence of (L, h, w, C) arrays
        What each set reads; NaN where not known.
    turns_deg : sequence of float
        By which the board was turned in its plane for each set, anticlockwise as the camera sees it.
    lights : LightField
        The lamps.
    x, y : (w,) and (h,) arrays
        Centres of the blocks, mm.

    Returns
    -------
    reading : (L, h, w, C) float32 array
        What a plane, even board would read, as far as it can be told; NaN where a set does not know it.
    bow : float
        Height of the board that was found, from its lowest to its highest part, mm.

    Notes
    -----
    A board of height h(x, y) and albedo exp(a(x, y)) changes the logarithm of what lamp l reads by
    ``a - t . grad h + h d(log light)/dz``, t being the lamp's direction over its height.  Turned, it changes it by
    the same with h and a turned.  h and a are polynomials; the differences of all sets from the first say their
    coefficients by least squares, the smallest that do.  So what does not change when the board is turned stays:
    after 180 degrees all that is even, such as a bow about the middle of the field; after 90 degrees what is the same
    in all four directions, such as a bow that is round.
    """
    logarithms = [np.log(np.maximum(reading, np.float32(1e-9))) for reading in readings]
    changes = [_changes(lights, x, y, turn) for turn in turns_deg]
    grey = [logarithm.mean(axis=-1) for logarithm in logarithms]
    rows, right = [], []
    for change, seen in zip(changes[1:], grey[1:], strict=True):
        difference, columns = seen - grey[0], change - changes[0]
        known = np.isfinite(difference)
        for lamp in range(len(difference)):
            # Each photograph has an exposure of its own.
            here = known[lamp]
            part = columns[:, lamp][:, here].T
            rows.append(part - part.mean(axis=0))
            right.append(difference[lamp][here] - difference[lamp][here].mean())
    board = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=SMALLEST)[0]
    plane = [
        logarithm - np.tensordot(board, change, 1)[..., None].astype(np.float32)
        for logarithm, change in zip(logarithms, changes, strict=True)
    ]
    # The first set is as bright as the lamps were then; the others only tell the shape.
    level = np.nanmean(plane[0], axis=(1, 2), keepdims=True)
    shape = [one - np.nanmean(one, axis=(1, 2), keepdims=True) for one in plane]
    found = np.asarray(np.exp(level + np.mean(shape, axis=0)), np.float32)
    return found, float(np.ptp(np.tensordot(board[: len(board) // 2], _monomials(x, y), 1)))


def warn_of_bow(bow: float, x: Array, y: Array) -> list[CaptureWarning]:
    """Warn of a board that is not plane: what of its shape does not turn is still in the flats."""
    limit = BOWED * max(np.ptp(x), np.ptp(y))
    if bow <= limit:
        return []
    return [
        CaptureWarning(
            "flat-bowed",
            f"The sets of flats show a board that is not plane: {bow:.2f} mm from its lowest to its highest part, "
            f"{limit:.2f} mm are harmless. It was taken out, but what looks the same when the board is turned cannot "
            "be told, and may bend the height by as much again: take a plane board, or measure some heights.",
            value=bow,
            unit="mm",
        )
    ]


def _powers() -> list[tuple[int, int]]:
    """Exponents of x and y in the polynomials."""
    return [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j]


def _monomials(x: Array, y: Array) -> Array:
    """Terms of the polynomials over the field, (K / 2, h, w)."""
    size = max(np.ptp(x), np.ptp(y)) / 2
    u, v = np.meshgrid(x / size, y / size)
    return np.stack([u**i * v**j for i, j in _powers()])


def _changes(lights: LightField, x: Array, y: Array, turn_deg: float) -> Array:
    """Changes of the logarithm of what lamps read by a unit of each coefficient of a turned board, (K, L, h, w)."""
    size = max(np.ptp(x), np.ptp(y)) / 2
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    across, up = np.meshgrid(x, y)
    u, v = (cosine * across + sine * up) / size, (cosine * up - sine * across) / size
    points = np.stack([across, up, np.zeros_like(across)])
    shape = (len(lights.lamps), *across.shape, 3)
    rays, raised = (
        np.broadcast_to(lights.vectors(points + np.reshape([0, 0, z], (3, 1, 1))), shape).astype(np.float64)
        for z in (0.0, STEP)
    )
    slopes = rays[..., :2] / rays[..., 2:]
    growth = np.log(raised[..., 2] / rays[..., 2]) / STEP
    shapes, albedos = [], []
    for i, j in _powers():
        height = u**i * v**j
        by_u = i * u ** max(i - 1, 0) * v**j / size
        by_v = j * u**i * v ** max(j - 1, 0) / size
        gradient = np.stack([cosine * by_u - sine * by_v, sine * by_u + cosine * by_v], axis=-1)
        shapes.append(growth * height - (slopes * gradient).sum(axis=-1))
        albedos.append(np.broadcast_to(height, growth.shape))
    # A millimetre, and two per cent of albedo, are as likely as each other.
    return np.stack([*shapes, *(0.02 * np.array(albedos))])
