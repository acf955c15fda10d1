"""Surfaces whose heights and normals are known exactly, from formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlights_core.fields import HeightMap, NormalField
from nlights_core.frames import Array, PixelGrid


@dataclass(frozen=True)
class Surface:
    """A height z(x, y) above the plane and its exact derivatives.

    Parameters
    ----------
    height : callable
        ``height(x, y)``: z in mm at points of the plane frame in mm; arrays of any one shape.
    slopes : callable
        ``slopes(x, y)``: the pair dz/dx, dz/dy (dimensionless), each of that shape.

    Examples
    --------
    Surfaces add up:

    >>> tilted_bow = plane(slope_x=0.01) + bow(sag=0.8, width=500, height=375)
    >>> float(tilted_bow.height(np.zeros(1), np.zeros(1))[0].round(3))
    0.267
    """

    height: Callable[[Array, Array], Array]
    slopes: Callable[[Array, Array], tuple[Array, Array]]

    def __add__(self, other: Surface) -> Surface:
        def slopes(x: Array, y: Array) -> tuple[Array, Array]:
            mine, others = self.slopes(x, y), other.slopes(x, y)
            return mine[0] + others[0], mine[1] + others[1]

        return Surface(lambda x, y: self.height(x, y) + other.height(x, y), slopes)

    def normals(self, x: Array, y: Array) -> Array:
        """Unit normals (-dz/dx, -dz/dy, 1) / norm, (..., 3) float64, plane frame."""
        across, up = self.slopes(x, y)
        steep = np.stack([-across, -up, np.ones_like(across)], axis=-1)
        return np.asarray(steep / np.linalg.norm(steep, axis=-1, keepdims=True))


def plane(slope_x: float = 0.0, slope_y: float = 0.0, level: float = 0.0) -> Surface:
    """A plane: z = level + slope_x x + slope_y y; mm, slopes dimensionless."""
    return Surface(
        lambda x, y: level + slope_x * x + slope_y * y,
        lambda x, y: (np.full(np.shape(x), slope_x), np.full(np.shape(x), slope_y)),
    )


def sphere_cap(radius: float, top: float = 0.0, centre: tuple[float, float] = (0.0, 0.0)) -> Surface:
    """The upper half of a sphere.

    Parameters
    ----------
    radius : float
        Radius of the sphere, mm.
    top : float
        Height of its highest point, mm.
    centre : tuple of 2 floats
        x, y of that point, mm.

    Returns
    -------
    Surface
        NaN beside the sphere.
    """

    def depth(x: Array, y: Array) -> Array:
        squared = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
        return np.sqrt(np.where(squared > 0, squared, np.nan))

    def slopes(x: Array, y: Array) -> tuple[Array, Array]:
        below = depth(x, y)
        return -(x - centre[0]) / below, -(y - centre[1]) / below

    return Surface(lambda x, y: depth(x, y) - radius + top, slopes)


def bow(sag: float, width: float, height: float) -> Surface:
    """A paraboloid over a field, as a canvas bows on its stretcher.

    Its mean over the field is zero: z = sag (1/3 - (u^2 + v^2)/2) with u = 2x / width and
    v = 2y / height.

    Parameters
    ----------
    sag : float
        How much higher the centre lies than the corners, mm.
    width, height : float
        The field, mm.
    """

    def elevation(x: Array, y: Array) -> Array:
        return sag * (1 / 3 - 2 * (x / width) ** 2 - 2 * (y / height) ** 2)

    return Surface(elevation, lambda x, y: (-4 * sag * x / width**2, -4 * sag * y / height**2))


def wave(amplitude: float, period: float, angle_deg: float = 0.0, phase: float = 0.0) -> Surface:
    """A sine wave.

    Parameters
    ----------
    amplitude, period : float
        In mm.
    angle_deg : float
        Direction in which it runs, degrees from x towards y.
    phase : float
        Phase at the origin, radians.
    """
    angle, number = np.radians(angle_deg), 2 * np.pi / period
    kx, ky = number * np.cos(angle), number * np.sin(angle)

    def slopes(x: Array, y: Array) -> tuple[Array, Array]:
        slope = amplitude * np.cos(kx * x + ky * y + phase)
        return kx * slope, ky * slope

    return Surface(lambda x, y: amplitude * np.sin(kx * x + ky * y + phase), slopes)


def peaks(top: float, half_width: float) -> Surface:
    """Three hills and three hollows: MATLAB's ``peaks``, scaled.

    Parameters
    ----------
    top : float
        About the height of the highest hill, mm.
    half_width : float
        Where the surface has died away, mm from the origin (3 in MATLAB's units).
    """
    scale, high = 3 / half_width, top / 8.1062

    def terms(x: Array, y: Array) -> tuple[Array, Array, Array, Array, Array]:
        u, v = scale * x, scale * y
        first = 3 * np.exp(-(u**2) - (v + 1) ** 2)
        second = 10 * np.exp(-(u**2) - v**2)
        third = np.exp(-((u + 1) ** 2) - v**2) / 3
        return u, v, first, second, third

    def height(x: Array, y: Array) -> Array:
        u, v, first, second, third = terms(x, y)
        middle = u / 5 - u**3 - v**5
        return np.asarray(high * ((1 - u) ** 2 * first - middle * second - third))

    def slopes(x: Array, y: Array) -> tuple[Array, Array]:
        u, v, first, second, third = terms(x, y)
        middle = u / 5 - u**3 - v**5
        du = -2 * (1 - u) * (1 + u * (1 - u)) * first
        du += -(1 / 5 - 3 * u**2 - 2 * u * middle) * second + 2 * (u + 1) * third
        dv = -2 * (v + 1) * (1 - u) ** 2 * first + (5 * v**4 + 2 * v * middle) * second + 2 * v * third
        return high * scale * du, high * scale * dv

    return Surface(height, slopes)


@dataclass(frozen=True)
class Stroke:
    """One elongated bump: z = height (1 - (u/length)^2 - (v/width)^2)^3, zero outside.

    It resembles a Gaussian but ends: its slopes and curvatures are continuous, and a point
    beyond its reach costs nothing.

    Parameters
    ----------
    x, y : float
        Its centre, mm.
    length, width : float
        Half axes along u and v, mm.
    angle_deg : float
        Direction of u, degrees from x towards y.
    height : float
        In mm.
    """

    x: float
    y: float
    length: float
    width: float
    angle_deg: float
    height: float

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Distance from its centre that the stroke extends along x and y, mm."""
        cosine, sine = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        across = np.hypot(self.length * cosine, self.width * sine)
        return float(across), float(np.hypot(self.length * sine, self.width * cosine))

    def axes(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Coordinates u / length and v / width, and 1 minus their squares, at least 0."""
        cosine, sine = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        u = ((x - self.x) * cosine + (y - self.y) * sine) / self.length
        v = ((y - self.y) * cosine - (x - self.x) * sine) / self.width
        return u, v, np.maximum(1 - u**2 - v**2, 0)


def _touched(parts: Sequence[Stroke], x: Array, y: Array) -> Iterator[tuple[Stroke, tuple[slice, ...]]]:
    """The strokes that reach any of the points, each with the block of the arrays it reaches."""
    spans = []
    for axis in range(np.ndim(x)):
        others = tuple(k for k in range(np.ndim(x)) if k != axis)
        spans.append((x.min(others), x.max(others), y.min(others), y.max(others)))
    left, right, bottom, top = x.min(), x.max(), y.min(), y.max()
    for part in parts:
        across, up = part.reach
        if part.x + across < left or part.x - across > right or part.y + up < bottom or part.y - up > top:
            continue
        block = []
        for lefts, rights, bottoms, tops in spans:
            near = (lefts <= part.x + across) & (rights >= part.x - across)
            near &= (bottoms <= part.y + up) & (tops >= part.y - up)
            places = np.flatnonzero(near)
            block.append(slice(places[0], places[-1] + 1) if places.size else slice(0, 0))
        yield part, tuple(block)


def strokes(parts: Sequence[Stroke]) -> Surface:
    """The sum of strokes; where they cross, their heights add up."""

    def height(x: Array, y: Array) -> Array:
        total = np.zeros(np.shape(x))
        for part, block in _touched(parts, x, y):
            total[block] += part.height * part.axes(x[block], y[block])[2] ** 3
        return total

    def slopes(x: Array, y: Array) -> tuple[Array, Array]:
        across, up = np.zeros(np.shape(x)), np.zeros(np.shape(x))
        for part, block in _touched(parts, x, y):
            u, v, inside = part.axes(x[block], y[block])
            along, aside = (-6 * part.height * inside**2 * w for w in (u / part.length, v / part.width))
            angle = np.radians(part.angle_deg)
            across[block] += along * np.cos(angle) - aside * np.sin(angle)
            up[block] += along * np.sin(angle) + aside * np.cos(angle)
        return across, up

    return Surface(height, slopes)


def seen_points(surface: Surface, grid: PixelGrid, start: int = 0, stop: int | None = None) -> Array:
    """Points in which the rays of a band of rows meet a surface.

    The point at height z seen through (x0, y0) is ``x = x0 + (Cx - x0) z / Cz``, likewise y; the
    fixed point z = height(x, y) is iterated to 1e-9 mm.

    Parameters
    ----------
    surface : Surface
        Slopes times the tangent of the rays must stay below 1 (nothing hides behind anything).
    grid : PixelGrid
        Without a camera the rays are parallel to z.
    start, stop : int, optional
        The band of rows; all by default.

    Returns
    -------
    (3, h, w) float64 array
        x, y, z in mm; NaN where the surface is not defined.

    Raises
    ------
    ValueError
        Where the surface is too steep for the iteration to settle.
    """
    x0, y0 = np.meshgrid(grid.x(), grid.y(start, stop))
    x, y, z = x0, y0, surface.height(x0, y0)
    if grid.camera is None:
        return np.stack([x, y, z])
    for _ in range(100):
        share = z / grid.camera[2]
        x, y = x0 + (grid.camera[0] - x0) * share, y0 + (grid.camera[1] - y0) * share
        previous, z = z, surface.height(x, y)
        change = np.abs(z - previous)
        if np.max(change, where=np.isfinite(change), initial=0.0) < 1e-9:
            return np.stack([x, y, z])
    raise ValueError("the surface is too steep for this camera: some points hide behind others")


def normal_field(surface: Surface, grid: PixelGrid) -> NormalField:
    """Exact normals of a surface at the centres of the pixels of a grid."""
    x, y, _ = seen_points(surface, grid)
    return NormalField(surface.normals(x, y).astype(np.float32), grid)


def height_map(surface: Surface, grid: PixelGrid) -> HeightMap:
    """Exact heights of a surface at the centres of the pixels of a grid, mm."""
    return HeightMap(seen_points(surface, grid)[2].astype(np.float32), grid)
