"""Tiles: what a capture holds, after its manifest was read and every path resolved."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from nlights_core.capture_warnings import CaptureWarning
from nlights_core.names.artworks import folder_of
from nlights_core.stands import Positive, Record, Stand

GAMMAS = (0.2, 5.0)
"""Smallest and largest exponent that is believed to be a tone curve's."""


def _transfer(text: str) -> str:
    """A tone curve's name as it should be written."""
    gamma = re.fullmatch(r"gamma ?(\d+(?:\.\d+)?)", text)
    if gamma and GAMMAS[0] <= float(gamma.group(1)) <= GAMMAS[1]:
        return f"gamma {float(gamma.group(1)):g}"
    if text in ("icc", "linear", "srgb", "L*"):
        return text
    raise ValueError(
        f"should be icc, linear, srgb, L* or gamma and a number from {GAMMAS[0]:g} to {GAMMAS[1]:g} "
        f"(gamma 2.2); got {text!r}"
    )


class Encoding(Record):
    """Relation of the numbers in the photographs to light."""

    transfer: Annotated[str, AfterValidator(_transfer)] | None = Field(
        default=None,
        description="tone curve of the files, which is undone: icc (that of the embedded profile), linear, "
        "srgb, gamma and a number, or L*; absent: that of the embedded profile where there is one, else linear",
    )
    mosaic: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = Field(
        default=None,
        description="colour filters of a Bayer mosaic stored as a plain grey image; each 2 x 2 cell "
        "becomes one pixel",
    )
    saturation: Positive | Literal["none"] | None = Field(
        default=None,
        description="level at which the sensor saturates, in the file's own numbers; none: nothing "
        "is saturated; absent: the largest number of the file's type (1.0 for float)",
    )


class Sensor(Record):
    """Known noise of the camera; measured in the photographs where it is not stated."""

    electrons_at_saturation: Positive = Field(
        description="electrons that a pixel holds at saturation level, at the ISO setting used"
    )
    read_noise_electrons: float = Field(default=0.0, ge=0, description="standard deviation in the dark")


class Sphere(Record):
    """Photographs of a chrome sphere under the same lamps."""

    frames: dict[str, Path] = Field(description="one photograph per lamp, absolute paths")
    circle_px: tuple[float, float, float] | None = Field(
        default=None, description="column and row of the centre, radius; px, pixel centres whole numbers"
    )
    points_px: tuple[tuple[float, float], ...] | None = Field(
        default=None, description="points clicked on the outline: column, row; px"
    )
    mask: Path | None = Field(default=None, description="image that is white on the sphere")
    outline: Path | None = Field(
        default=None, description="photograph in even light that shows the sphere's outline well"
    )


class TurnedFlats(Record):
    """Further photographs of the flat, with the board turned in its plane."""

    turn_deg: float = Field(description="anticlockwise as the camera sees it, against the first set")
    flats: dict[str, Path] = Field(description="one photograph per lamp, absolute paths")


class GivenLights(Record):
    """Files that state the lights (formats: see the given-directions light model)."""

    directions: Path
    intensities: Path | None = None


class HeightFile(Record):
    """File of heights that somebody measured, and how sure they are."""

    file: Path = Field(
        description="CSV with the columns x_mm, y_mm, z_mm and perhaps sigma_mm, or a PLY in mm"
    )
    sigma_mm: Positive | None = Field(
        default=None, description="standard uncertainty of each z, mm, where the file does not state it"
    )
    registration_mm: float = Field(
        default=0.0, ge=0, description="standard uncertainty of x and of y in the plane frame, mm"
    )
    tilted: bool = Field(
        default=False,
        description="whether their frame may lean against the plane frame: their tilt is not used",
    )


class Tile(Record):
    """One placement of the stand over an artwork: the unit of work, of caching and of failure."""

    artwork: str = Field(description="inventory number, as it was written")
    title: str = ""
    name: str = Field(description="a plain name, unique in the artwork")
    origin_mm: tuple[float, float] = Field(
        default=(0.0, 0.0), description="centre of the tile's field on the artwork: x right, y up, mm"
    )
    stand: Stand | None = None
    pixel_size_mm: float | None = Field(
        default=None, gt=0, description="edge of a pixel on the artwork, where no stand says it"
    )
    frames: dict[str, Path] = Field(description="one photograph per lamp")
    flats: dict[str, Path] | None = Field(default=None, description="photographs of a flat, per lamp")
    turned_flats: tuple[TurnedFlats, ...] = ()
    flats_averaged: int | None = Field(
        default=None, ge=1, description="of how many exposures each flat is the mean, where that is stated"
    )
    dark: Path | None = None
    mask: Path | None = Field(default=None, description="image that is white on the artwork")
    auto_mask: bool = Field(
        default=False, description="whether the mask is found in the photographs; a path in the store then"
    )
    spheres: tuple[Sphere, ...] = ()
    lights: GivenLights | None = None
    known_heights: HeightFile | None = None
    encoding: Encoding = Encoding()
    sensor: Sensor | None = None
    white_reflectance: float = Field(default=0.9, gt=0, le=1, description="albedo of the flat")
    warnings: tuple[CaptureWarning, ...] = Field(
        default=(), description="what the names of its photographs show that nobody may have meant"
    )

    @property
    def folder(self) -> str:
        """Name of the artwork's folder, in the products and in the store."""
        return folder_of(self.artwork)

    @property
    def lamps(self) -> tuple[str, ...]:
        """The lamps in the order of every first axis."""
        return tuple(self.frames)
