"""Light on a simulated artwork: lamp groups, cast shadows, highlights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.ndimage import map_coordinates

from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.surfaces import Surface
from nlights_core.stands import Stand

GROUP_EDGE_MM = 30.0
"""Edge of the square on whose corners the four lamps of a group sit."""
STRENGTH_SPREAD = 0.08
"""Standard deviation of the relative power of lamps, and of groups."""
AIM_SPREAD_DEG = 1.0
"""Standard deviation of a lamp's aiming error in each of two directions."""
VARNISH_REFLECTANCE = 0.04
"""Reflectance at normal incidence of a varnish of refractive index 1.5."""
VARNISH_EXPONENT = 80.0
"""Blinn-Phong exponent of the highlights: half as bright 7.5 degrees off the mirror normal."""


@dataclass(frozen=True)
class LampGroup:
    """One lamp group of a stand: four lamps around the measured position.

    Parameters
    ----------
    centre : (3,) float64 array
        Measured position, plane frame, mm.
    positions, axes : (4, 3) float64 arrays
        Where each lamp is, mm, and the unit vector along which it shines.
    powers : (4,) float64 array
        Relative power; about 1/4 each.
    exponent : float
        Emission exponent mu.
    """

    centre: Array
    positions: Array
    axes: Array
    powers: Array
    exponent: float


def lamp_groups(stand: Stand, random: Generator) -> list[LampGroup]:
    """The lamps as they really are: unequal, and aimed not quite at the field's centre.

    Parameters
    ----------
    stand : Stand
        The measured positions are the centres of the groups, exactly.
    random : Generator
        Draws powers and aiming errors.
    """
    groups = []
    for centre in stand.lamp_positions():
        aim = -centre / np.linalg.norm(centre)
        across = np.cross(aim, [0.0, 0.0, 1.0] if abs(aim[2]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        sides = np.stack([across, np.cross(aim, across)])
        corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * (GROUP_EDGE_MM / 2)
        positions = centre + corners @ sides
        errors = random.normal(0, np.tan(np.radians(AIM_SPREAD_DEG)), (4, 2))
        axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True) + errors @ sides
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        powers = random.normal(1, STRENGTH_SPREAD) * random.normal(1, STRENGTH_SPREAD, 4) / 4
        groups.append(LampGroup(centre, positions, axes, np.maximum(powers, 0.05), stand.lamp.exponent))
    return groups


@dataclass(frozen=True)
class Horizon:
    """Horizon that the relief makes between each point and a lamp, on a grid over the field.

    Parameters
    ----------
    tangent : (h, w) float32 array
        Tangent of the elevation of the horizon towards the lamp.
    grid : PixelGrid
        Its points, on the plane.
    """

    tangent: Array
    grid: PixelGrid

    def at(self, x: Array, y: Array) -> Array:
        """The tangent at points, interpolated; arrays of one shape."""
        column = x / self.grid.pixel_size + (self.grid.columns - 1) / 2
        row = (self.grid.rows - 1) / 2 - y / self.grid.pixel_size
        return np.asarray(map_coordinates(self.tangent, [row, column], order=1, mode="nearest"))


def horizon(surface: Surface, grid: PixelGrid, centre: Array, steps: int = 32) -> Horizon:
    """March from every point towards a lamp and keep the steepest line of sight.

    Parameters
    ----------
    surface : Surface
        The relief.
    grid : PixelGrid
        The photograph's grid; at most 1000 columns are used, for the horizon is smooth.
    centre : (3,) array
        The lamp, mm.
    steps : int
        Samples along the way, closer together near the point.
    """
    columns = min(grid.columns, 1000)
    size = grid.columns * grid.pixel_size / columns
    coarse = PixelGrid(round(grid.rows * grid.pixel_size / size), columns, size)
    x, y = np.meshgrid(coarse.x(), coarse.y())
    z = surface.height(x, y).astype(np.float32)
    relief = float(z.max() - z.min())
    if relief == 0:
        return Horizon(np.zeros_like(z), coarse)
    tangent = np.full(z.shape, -np.inf, np.float32)
    distance = np.hypot(centre[0] - x, centre[1] - y)
    along_x = (centre[0] - x) / np.maximum(distance, 1e-6)
    along_y = (centre[1] - y) / np.maximum(distance, 1e-6)
    # Beyond this way the lamp's ray has risen above the whole relief.
    way = max(relief * float(distance.max()) / (centre[2] - float(z.max())), 2 * size)
    heights = Horizon(z, coarse)
    for step in np.geomspace(size, way, steps):
        seen = heights.at(x + step * along_x, y + step * along_y)
        np.maximum(tangent, (seen - z) / np.float32(step), out=tangent)
    return Horizon(tangent, coarse)


def shine(
    group: LampGroup, points: Array, normals: Array, shadows: Horizon | None, camera: Array | None = None
) -> tuple[Array, Array]:
    """Light of one lamp group on a surface.

    Irradiance of a lamp: ``power max(0, -l.a)^mu / d^2 max(0, n.l)``, times the squared distance
    of its group from the origin, so that the numbers are of the order of 1.

    Parameters
    ----------
    group : LampGroup
        Four lamps.
    points : (3, h, w) float32 array
        x, y, z in mm.
    normals : (h, w, 3) float32 array
        Unit normals.
    shadows : Horizon, optional
        Cast shadows; None where nothing stands in the way.
    camera : (3,) array, optional
        Where it is, mm, if the surface is varnished.

    Returns
    -------
    matt, gloss : (h, w) float32 arrays
        Irradiance (radiance of a matt surface of albedo 1), and radiance of the highlights:
        normalised Blinn-Phong with Schlick's Fresnel term [1]_.

    References
    ----------
    .. [1] T. Akenine-Moller, E. Haines, N. Hoffman, Real-Time Rendering, 3rd ed., 2008, ch. 7.
    """
    matt, gloss = np.zeros((2, *points.shape[1:]), np.float32)
    normal = np.moveaxis(normals, -1, 0)
    skyline = None if shadows is None else shadows.at(points[0], points[1])
    view = None if camera is None else _unit(camera.astype(np.float32)[:, None, None] - points)
    for position, axis, power in zip(group.positions, group.axes, group.powers, strict=True):
        ray = position.astype(np.float32)[:, None, None] - points
        squared = np.einsum("khw,khw->hw", ray, ray)
        light = ray / np.sqrt(squared)
        emitted = np.maximum(-np.tensordot(axis.astype(np.float32), light, 1), 0)
        strength = np.float32(power * (group.centre @ group.centre)) * emitted ** np.float32(group.exponent)
        incident = strength / squared * np.maximum(np.einsum("khw,khw->hw", normal, light), 0)
        if skyline is not None:
            incident *= ray[2] > skyline * np.hypot(ray[0], ray[1])
        matt += incident
        if view is not None:
            half = _unit(light + view)
            grazing = (1 - np.einsum("khw,khw->hw", half, light)) ** 5
            fresnel = VARNISH_REFLECTANCE + (1 - VARNISH_REFLECTANCE) * grazing
            facing = np.maximum(np.einsum("khw,khw->hw", normal, half), 0)
            gloss += incident * fresnel * (VARNISH_EXPONENT + 8) / 8 * facing ** np.float32(VARNISH_EXPONENT)
    return matt, gloss


def _unit(vectors: Array) -> Array:
    """Vectors along the first axis, made unit."""
    return np.asarray(vectors / np.sqrt(np.einsum("khw,khw->hw", vectors, vectors)))
