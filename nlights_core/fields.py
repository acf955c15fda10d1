"""Fields that flow between the stages: light fields, normal fields, height maps.

Lengths are millimetres in the plane frame (see `nlights_core.frames`), directions are unit
vectors, images are fractions of the saturation level.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nlights_core.frames import Array, PixelGrid


@dataclass(frozen=True)
class LightField:
    """The lamps, as a function of position: direction and irradiance at any point.

    A field of 8 lamps over 100 megapixels would fill 10 GB as an array, so it is never one:
    `vectors` evaluates it for a band of rows.

    Parameters
    ----------
    lamps : tuple of str
        Names, in the order of every first axis ``L`` in the system.
    positions : (L, 3) float64 array, optional
        Near lamps: where they are, mm.  Exactly one of ``positions`` and ``directions`` is given.
    directions : (L, 3) float64 array, optional
        Distant lamps: unit vectors from the artwork to the lamp.
    power : (L, 1) or (L, C) float64 array
        Relative power, per colour channel where it differs.  Images are divided by it when they
        are developed, so that it is not part of `vectors`.
    ambient : (L,) float64 array
        Ambient light as a share of the lamp's power (alpha in Xiong's model
        ``I = albedo (l.n + alpha)``).
    axes : (L, 3) float64 array, optional
        Optical axes of near lamps, unit vectors from the lamp towards the artwork.
    exponents : (L,) float64 array, optional
        Emission exponents mu: the irradiance falls with ``(-l.a) ** mu`` off the axis.
    """

    lamps: tuple[str, ...]
    positions: Array | None = None
    directions: Array | None = None
    power: Array = field(default_factory=lambda: np.ones((1, 1)))
    ambient: Array = field(default_factory=lambda: np.zeros(1))
    axes: Array | None = None
    exponents: Array | None = None

    def __post_init__(self) -> None:
        count = len(self.lamps)
        if (self.positions is None) == (self.directions is None):
            raise ValueError("a light field has either positions (near) or directions (distant)")
        for places in (self.positions, self.directions):
            if places is not None and places.shape != (count, 3):
                raise ValueError(f"{count} lamps need places of shape ({count}, 3), got {places.shape}")
        if self.power.shape[0] == 1 and count != 1:
            object.__setattr__(self, "power", np.repeat(self.power, count, axis=0))
        if self.ambient.shape[0] == 1 and count != 1:
            object.__setattr__(self, "ambient", np.repeat(self.ambient, count, axis=0))

    @property
    def near(self) -> bool:
        """Test whether the lamps are at measured positions rather than infinitely far away."""
        return self.positions is not None

    def only(self, lamp: int) -> LightField:
        """The field of a single lamp, by its index."""
        one = slice(lamp, lamp + 1)

        def part(array: Array | None) -> Array | None:
            return None if array is None else array[one]

        return LightField(
            self.lamps[one],
            part(self.positions),
            part(self.directions),
            self.power[one],
            self.ambient[one],
            part(self.axes),
            part(self.exponents),
        )

    def stronger(self, factors: Array) -> LightField:
        """The same lamps, each stronger by a factor (L,)."""
        return replace(self, power=self.power * np.asarray(factors)[:, None])

    def vectors(self, points: Array) -> Array:
        """Direction times irradiance of every lamp at given points, at unit power.

        Parameters
        ----------
        points : (3, h, w) array
            x, y, z in mm.

        Returns
        -------
        (L, h, w, 3) float32 array for near lamps, (L, 1, 1, 3) for distant ones
            Near: the irradiance follows the inverse square law (and the emission, where
            known), relative to a lamp whose light meets the origin at full strength, so that
            the numbers are of the order of 1.
        """
        if self.directions is not None:
            return self.directions.astype(np.float32)[:, None, None, :]
        assert self.positions is not None
        out = np.empty((len(self.lamps), *points.shape[1:], 3), np.float32)
        for i, position in enumerate(self.positions):
            ray = [np.float32(position[k]) - points[k].astype(np.float32) for k in range(3)]
            squared = ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
            irradiance = np.float32(np.dot(position, position)) / squared
            irradiance /= np.sqrt(squared)
            if self.axes is not None and self.exponents is not None:
                axis = self.axes[i].astype(np.float32)
                cosine = -(ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2]) / np.sqrt(squared)
                irradiance *= np.maximum(cosine, 0) ** np.float32(self.exponents[i])
            for k in range(3):
                np.multiply(ray[k], irradiance, out=out[i, ..., k])
        return out

    def plane_points(self, points: Array) -> Array:
        """Points in which each lamp's rays through given points meet the plane z = 0.

        ``P0 = S + (P - S) S_z / (S_z - z)``: what a lamp emits towards P it emits towards P0
        too, so that a flat field read at P0 needs no model of the lamp.

        Parameters
        ----------
        points : (3, h, w) array
            x, y, z in mm, z below every lamp.

        Returns
        -------
        (L, 2, h, w) float32 array for near lamps, (1, 2, h, w) for distant ones
            x and y in mm.  For distant lamps the points' own x and y: their light is the same
            everywhere, and what a flat field corrects then belongs to the pixel.
        """
        if self.positions is None:
            return points[None, :2].astype(np.float32)
        out = np.empty((len(self.lamps), 2, *points.shape[1:]), np.float32)
        for i, position in enumerate(self.positions):
            stretch = np.float32(position[2]) / (np.float32(position[2]) - points[2])
            for k in range(2):
                out[i, k] = np.float32(position[k]) + (points[k] - np.float32(position[k])) * stretch
        return out

    def record(self) -> dict[str, Any]:
        """The field as plain lists, for JSON; `from_record` reads it back exactly."""
        names = ("positions", "directions", "power", "ambient", "axes", "exponents")
        arrays = {name: getattr(self, name) for name in names}
        return {
            "lamps": list(self.lamps),
            **{name: None if a is None else np.asarray(a).tolist() for name, a in arrays.items()},
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> LightField:
        """The light field that `record` described."""
        arrays = {k: np.array(v, float) for k, v in record.items() if k != "lamps" and v is not None}
        return cls(lamps=tuple(record["lamps"]), **arrays)


@dataclass(frozen=True)
class NormalField:
    """Unit normals of the surface on the photograph's grid.

    Parameters
    ----------
    normals : (H, W, 3) float32 array
        Unit vectors x, y, z in the plane frame (y up); NaN where not known.
    grid : PixelGrid
        Where the pixels are.
    confidence : (H, W) float32 array, optional
        Standard uncertainty of each normal, degrees (see `nlights_core.algorithms.Solution`).
    """

    normals: Array
    grid: PixelGrid
    confidence: Array | None = None

    def gradient(self, steepest_deg: float = 70.0) -> tuple[Array, Array]:
        """Height steps per column and per row, in `numpy.gradient`'s sense.

        Row indices grow downwards while y grows upwards; that is settled here, so that an
        integrator never meets the sign of y.

        Parameters
        ----------
        steepest_deg : float
            Slopes are limited to this angle, degrees: a normal close to the horizon says
            little about the slope, and a single one could dominate the integral.

        Returns
        -------
        per_column, per_row : (H, W) float32 arrays
            Height step from one pixel to the next, mm (dimensionless slope times pixel size);
            NaN where the normal is not known.
        """
        steepest = np.float32(np.tan(np.radians(steepest_deg)))
        n = self.normals
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            across = -n[..., 0] / n[..., 2]
            down = n[..., 1] / n[..., 2]
            slope = np.hypot(across, down)
            limit = np.where(slope > steepest, steepest / slope, np.float32(1))
        below = ~(n[..., 2] > 0)
        scale = (limit * np.float32(self.grid.pixel_size)).astype(np.float32)
        scale[below] = np.nan
        return (across * scale).astype(np.float32), (down * scale).astype(np.float32)


@dataclass(frozen=True)
class KnownHeights:
    """Heights of an artwork that somebody measured by other means: a probe, a scanner, photogrammetry.

    Their constant is free: no probe knows the plane of the flat.

    Parameters
    ----------
    points : (N, 3) float64 array
        x, y, z in the plane frame, mm.
    sigma : (N,) float64 array
        Standard uncertainty of each z, mm.
    registration_mm : float
        Standard uncertainty of x and of y, mm.
    tilted : bool
        Whether their frame may lean against the plane frame: then their tilt says nothing.
    source : str
        What sentences call them: the file's name.
    """

    points: Array
    sigma: Array
    registration_mm: float = 0.0
    tilted: bool = False
    source: str = "known_heights"


@dataclass(frozen=True)
class HeightMap:
    """Height of the surface towards the camera, on the photograph's grid.

    Parameters
    ----------
    height : (H, W) float32 array
        z in mm (or in pixels where the grid's unit says so); the constant is free, NaN where
        not known.
    grid : PixelGrid
        Where the pixels are.
    known : KnownHeights, optional
        Heights that somebody measured; given to a detrend that has "known_heights" among its `needs`.
    """

    height: Array
    grid: PixelGrid
    known: KnownHeights | None = None
