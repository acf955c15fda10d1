"""Photographs of chrome spheres with known circles and lamps, by tracing rays.

A camera far away looks straight down on a table, at z = 0, on which spheres lie.  Units are pixels: x
right, y up, z to the camera; column = x, row = -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array


@dataclass(frozen=True)
class Room:
    """Surroundings of the spheres.

    Attributes
    ----------
    table : (H, W) float array
        Albedo of the table, and of what lies flat on it.
    height : (H, W) float array
        Height of it, px; its slopes are shaded, it throws no shadow.
    gloss : (H, W) float array
        How much a mirror-like lobe of the table itself adds, as a stone's polish does.
    walls : float
        Light of the dark room above, as a share of saturation.
    chrome : float
        Share of the light that a sphere reflects.
    lamp_deg : float
        Radius of a lamp as seen from the table, degrees.
    """

    table: Array
    height: Array
    gloss: Array
    walls: float = 0.02
    chrome: float = 0.6
    lamp_deg: float = 2.0


def photograph(room: Room, spheres: Sequence[Sequence[float]], lamp: Array) -> Array:
    """A photograph under one distant lamp.

    Parameters
    ----------
    room : Room
    spheres : sequence of (column, row, radius)
        Circles in which the spheres are seen, px.
    lamp : (3,) array
        Unit vector to the lamp.

    Returns
    -------
    (H, W) float32 array
        Shares of saturation, clipped at 1.
    """
    lit = _lit_table(room, spheres, lamp)
    image = lit.copy()
    height, width = image.shape
    for column, row, radius in spheres:
        left, top = max(int(column - radius) - 1, 0), max(int(row - radius) - 1, 0)
        right, bottom = min(int(column + radius) + 3, width), min(int(row + radius) + 3, height)
        # Three by three samples of each pixel: a photographed outline is smooth.
        fine = (np.arange(3) - 1) / 3
        x = (np.arange(left, right)[:, None] + fine).ravel()[None, :]
        y = (np.arange(top, bottom)[:, None] + fine).ravel()[:, None]
        nx, ny = (x - column) / radius, (row - y) / radius
        inside = nx**2 + ny**2 < 1
        nz = np.sqrt(np.clip(1 - nx**2 - ny**2, 0, None))
        seen = np.stack([2 * nz * nx, 2 * nz * ny, 2 * nz**2 - 1], axis=-1)
        value = room.chrome * _surroundings(room, lit, seen, x + 0 * y, y + 0 * x, radius * (1 + nz), lamp)
        under = image[
            np.clip(np.round(y), 0, height - 1).astype(int), np.clip(np.round(x), 0, width - 1).astype(int)
        ]
        value = np.where(inside, value, under)
        shape = bottom - top, 3, right - left, 3
        image[top:bottom, left:right] = value.reshape(shape).mean(axis=(1, 3))
    return np.clip(image, 0, 1).astype(np.float32)


def _lit_table(room: Room, spheres: Sequence[Sequence[float]], lamp: Array) -> Array:
    height, width = room.table.shape
    rows, columns = np.mgrid[:height, :width]
    fall, rise = np.gradient(room.height)
    normal = np.stack([-rise, fall, np.ones_like(rise)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.clip(normal @ lamp, 0, None)
    half = lamp + np.array([0, 0, 1])
    lobe = np.clip(normal @ (half / np.linalg.norm(half)), 0, None) ** 200
    lit = np.ones((height, width), bool)
    for column, row, radius in spheres:
        # From the point to the sphere's centre, and how far the ray to the lamp passes it.
        to = column - columns, rows - row, radius
        along = to[0] * lamp[0] + to[1] * lamp[1] + to[2] * lamp[2]
        away = to[0] ** 2 + to[1] ** 2 + to[2] ** 2 - along**2
        lit &= ~((along > 0) & (away < radius**2))
    return np.asarray(room.table * (light * lit + 0.03) + room.gloss * lobe * lit)


def _surroundings(room: Room, lit: Array, seen: Array, x: Array, y: Array, z: Array, lamp: Array) -> Array:
    """Light that comes from directions ``seen`` at points of a sphere."""
    angle = np.degrees(np.arccos(np.clip(seen @ lamp, -1, 1)))
    glow = 3 * (angle < room.lamp_deg) + 0.15 * np.exp(-((angle / (3 * room.lamp_deg)) ** 2))
    # A wall's lower edge, the camera's dark lens straight above, a doorway.
    walls = room.walls * (1 + 0.8 * (seen[..., 2] > 0.5) + 2 * (seen[..., 0] > 0.8)) * (seen[..., 2] < 0.995)
    down = np.clip(-seen[..., 2], 1e-3, None)
    height, width = lit.shape
    column = x + seen[..., 0] / down * z
    row = y - seen[..., 1] / down * z
    there = (column >= 0) & (column < width - 1) & (row >= 0) & (row < height - 1)
    at = np.clip(row, 0, height - 1).astype(int), np.clip(column, 0, width - 1).astype(int)
    table = np.where(there, lit[at], 0.3 * (lamp[2] + 0.03))
    return np.asarray(np.where(seen[..., 2] > 0, walls + glow, table))
