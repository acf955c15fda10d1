"""Stands: measured positions of camera and lamps, mapped to the plane frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from nlights_core.frames import Array

Axis = Literal["X", "Y", "Z", "-X", "-Y", "-Z"]
Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class Record(BaseModel):
    """A frozen record read from a person's file: unknown keys and infinities are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


WANDERING = 1 / 60
"""Share of an emitter's size by which the place that its light comes from is not known, per axis.  The lamps of a
group are not equally bright, nor aimed alike, so the middle of their light wanders over the field: in simulated
groups of 60 mm by 0.8 mm about a place 0.5 mm off."""


class Axes(Record):
    """Assignment of the measured axes, or their opposites, to those of the plane frame."""

    x: Axis = "X"
    y: Axis = "Y"
    z: Axis = "Z"

    def matrix(self) -> Array:
        """The rotation from measured coordinates to the plane frame, (3, 3) float64."""
        out = np.zeros((3, 3))
        for row, axis in enumerate((self.x, self.y, self.z)):
            out[row, "XYZ".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
        return out

    @model_validator(mode="after")
    def _is_rotation(self) -> Axes:
        if not np.isclose(np.linalg.det(self.matrix()), 1.0):
            raise ValueError(
                f"x: {self.x}, y: {self.y}, z: {self.z} is not a rotation (each measured axis once, "
                "right-handed); for the vertical stand it is x: X, y: Z, z: -Y"
            )
        return self


class Lamp(Record):
    """Properties that all lamp groups of a stand share."""

    half_angle_deg: float = Field(gt=0, lt=90, description="angle off the axis at half power, degrees")
    emitter_size_mm: Positive = Field(description="largest extent of a group's light-emitting area, mm")

    @property
    def wandering_mm(self) -> float:
        """Standard uncertainty of the place that a group's light comes from, about its middle, per axis, mm."""
        return WANDERING * self.emitter_size_mm

    @property
    def exponent(self) -> float:
        """Emission exponent mu = ln 0.5 / ln cos(half angle)."""
        return float(np.log(0.5) / np.log(np.cos(np.radians(self.half_angle_deg))))


class Optics(Record):
    """Lens and sensor, for information: the framed field sets the scale."""

    camera: str | None = None
    lens: str | None = None
    focal_length_mm: Positive | None = None
    sensor_mm: tuple[Positive, Positive] | None = None
    sensor_px: tuple[int, int] | None = None


class Stand(Record):
    """A measured repro stand.

    Lengths are mm.  ``lamps`` and ``camera`` are in the axes in which they were measured;
    `lamp_positions` and `camera_position` give them in the plane frame.
    """

    name: str
    source: str = Field(description="where the numbers come from")
    measured: str | None = Field(default=None, description="date of the measurement")
    axes: Axes = Axes()
    field_mm: tuple[Positive, Positive] = Field(description="framed field: width, height, mm")
    camera: Vector = Field(description="centre of the sensor plane, mm, measured axes")
    lamps: dict[str, Vector] = Field(description="centroid of each lamp group, mm, measured axes")
    lamp: Lamp
    uncertainty_mm: Positive = Field(description="standard uncertainty of a position, per axis, mm")
    optics: Optics = Optics()
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """File that it was read from; None where it was given otherwise."""
        return self._file

    @property
    def camera_position(self) -> Array:
        """Camera in the plane frame, (3,) float64, mm."""
        return np.asarray(self.axes.matrix() @ np.array(self.camera))

    def lamp_positions(self, names: tuple[str, ...] | None = None) -> Array:
        """Lamps in the plane frame, (L, 3) float64, mm, in the order of ``names``."""
        chosen = tuple(self.lamps) if names is None else names
        measured = np.array([self.lamps[n] for n in chosen], float)
        return np.asarray(measured @ self.axes.matrix().T)

    @model_validator(mode="after")
    def _is_usable(self) -> Stand:
        if len(self.lamps) < 3:
            raise ValueError(f"lamps: photometric stereo needs at least 3, got {len(self.lamps)}")
        if self.camera_position[2] <= 0:
            raise ValueError("camera: must be on the side of positive z of the plane frame; check axes")
        half = np.array(self.field_mm) / 2
        for name, position in zip(self.lamps, self.lamp_positions(), strict=True):
            if position[2] <= 0:
                raise ValueError(f"lamps.{name}: must have positive z in the plane frame; check axes")
            beside = np.maximum(np.abs(position[:2]) - half, 0)
            distance = float(np.hypot(np.linalg.norm(beside), position[2]))
            least = 5 * self.lamp.emitter_size_mm
            if distance < least:
                raise ValueError(
                    f"lamps.{name}: {distance:.0f} mm from the field, but a lamp counts as a point only "
                    f"from five times its emitter's size on ({least:.0f} mm); move the lamp away or "
                    "use a smaller emitter"
                )
        return self
