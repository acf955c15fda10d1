"""Scenes under the simulated camera: relief and colour of four artworks, and a stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.random import Generator

from nlights_core.frames import Array
from nlights_core.simulation.surfaces import Stroke, Surface, bow, plane, strokes, wave
from nlights_core.stands import Axes, Lamp, Stand


@dataclass(frozen=True)
class Scene:
    """An artwork: its relief and its colour.

    Parameters
    ----------
    surface : Surface
        Relief in mm, close to the plane z = 0.
    albedo : callable
        ``albedo(x, y)``: reflectance of the matt surface from 0 to 1, (..., 3) linear RGB, at
        points in mm.
    """

    surface: Surface
    albedo: Callable[[Array, Array], Array]


def synthetic_stand() -> Stand:
    """A vertical stand of round numbers: four low lamps and four high ones around 500 x 375 mm.

    It is measured in axes of its own (Y runs into the wall), so that an algorithm that forgets
    to map them to the plane frame is found out.
    """
    lamps = {}
    for k in range(4):
        azimuth = np.pi / 2 * k
        for ring, distance, height in (("low", 640.0, -170.0), ("high", 470.0, -460.0)):
            x, z = round(distance * np.cos(azimuth), 6), round(distance * np.sin(azimuth), 6)
            lamps[f"{ring}_{k + 1}"] = (x, height, z)
    return Stand(
        name="synthetic",
        source="round numbers near those of the measured stands",
        axes=Axes(x="X", y="Z", z="-Y"),
        field_mm=(500.0, 375.0),
        camera=(0.0, -1540.0, 0.0),
        lamps=lamps,
        lamp=Lamp(half_angle_deg=12.5, emitter_size_mm=60.0),
        uncertainty_mm=0.5,
    )


def _waves(random: Generator, count: int, amplitude: float, periods: tuple[float, float]) -> Surface:
    """Waves of random direction and phase, each of the given amplitude; mm."""
    return reduce(
        add,
        (
            wave(amplitude, random.uniform(*periods), random.uniform(0, 360), random.uniform(0, 2 * np.pi))
            for _ in range(count)
        ),
    )


def _scattered(random: Generator, size: tuple[float, float], count: int) -> Array:
    """Random places over a field, (count, 2), mm."""
    return random.uniform(-0.5, 0.5, (count, 2)) * size


PIGMENTS = np.array(
    [
        [0.80, 0.76, 0.66],  # lead white, aged
        [0.68, 0.50, 0.24],  # yellow ochre
        [0.56, 0.26, 0.18],  # red earth
        [0.26, 0.38, 0.54],  # azurite
        [0.38, 0.45, 0.28],  # green earth
        [0.30, 0.24, 0.19],  # umber
    ]
)
"""Albedo of a painter's pigments, lightened with white as on a palette; linear red, green, blue."""


def flat_card(size: tuple[float, float], finest: float, random: Generator) -> Scene:
    """A matt grey card, albedo 0.7, in the plane z = 0."""
    return Scene(plane(), lambda x, y: np.full((*np.shape(x), 3), 0.7))


def drawing(size: tuple[float, float], finest: float, random: Generator) -> Scene:
    """Ink lines on paper that has cockled by about 1.5 mm, with a grain of some micrometres.

    Parameters
    ----------
    size : tuple of 2 floats
        Width and height of the field, mm.
    finest : float
        Least half width of a line and quarter period of the grain, mm.
    random : Generator
        Where chance enters.
    """
    cockle = _waves(random, 4, 0.25, (0.3 * size[0], 0.8 * size[0]))
    grain = _waves(random, 6, 0.004, (max(2.0, finest), 2 * max(2.0, finest)))
    width = max(1.2, finest)
    lines = [
        Stroke(x, y, random.uniform(20, 70) + width, width, random.uniform(0, 180), 3.0)
        for x, y in _scattered(random, size, 120)
    ]
    density = strokes(lines)

    def albedo(x: Array, y: Array) -> Array:
        bare = np.exp(-density.height(x, y))[..., None]
        return np.asarray(np.array([0.82, 0.78, 0.70]) * bare + np.array([0.10, 0.09, 0.08]) * (1 - bare))

    return Scene(cockle + grain, albedo)


def painting(size: tuple[float, float], finest: float, random: Generator) -> Scene:
    """Patches of pigments with brush strokes up to 0.2 mm high, on a canvas bowed by 0.8 mm.

    Parameters
    ----------
    size : tuple of 2 floats
        Width and height of the field, mm.
    finest : float
        Least half width of a stroke, mm.
    random : Generator
        Where chance enters.
    """
    parts = []
    for x, y in _scattered(random, size, 1500):
        width = max(random.uniform(1.5, 4.0), finest)
        height = min(random.uniform(0.02, 0.08) * width, 0.2)
        length = width * random.uniform(2, 5)
        parts.append(Stroke(x, y, length, width, random.normal(60, 40), height))
    brush = strokes(parts)
    fields = [_waves(random, 5, 1.0, (0.1 * size[0], 0.5 * size[0])) for _ in PIGMENTS]

    def albedo(x: Array, y: Array) -> Array:
        # Where a pigment's field is highest it prevails; between them they mix.
        shares = np.exp(np.stack([2.5 * field.height(x, y) for field in fields], axis=-1))
        shares /= shares.sum(axis=-1, keepdims=True)
        worn = 1 - 0.3 * np.tanh(8 * brush.height(x, y))
        return np.asarray(shares @ PIGMENTS * worn[..., None])

    return Scene(brush + bow(0.8, *size), albedo)


def relief(size: tuple[float, float], finest: float, random: Generator) -> Scene:
    """A smooth relief 8 mm high that ends before the border, with a fine texture.

    Parameters
    ----------
    size : tuple of 2 floats
        Width and height of the field, mm.
    finest : float
        Least half width of the texture, mm.
    random : Generator
        Where chance enters.
    """
    width, height = size
    hills = [
        Stroke(-0.22 * width, 0.06 * height, 0.24 * width, 0.15 * width, 35.0, 8.0),
        Stroke(0.20 * width, 0.12 * height, 0.18 * width, 0.14 * width, -20.0, 6.5),
        Stroke(0.16 * width, -0.22 * height, 0.22 * width, 0.10 * width, 5.0, 4.0),
        Stroke(-0.05 * width, -0.20 * height, 0.12 * width, 0.12 * width, 0.0, 3.0),
    ]
    fine = max(4.0, finest)
    grain = [
        Stroke(x, y, 2 * fine, fine, random.uniform(0, 180), 0.03) for x, y in _scattered(random, size, 400)
    ]
    tint = _waves(random, 4, 0.5, (0.15 * width, 0.6 * width))

    def albedo(x: Array, y: Array) -> Array:
        return np.array([0.62, 0.52, 0.40]) * (1 + 0.25 * np.tanh(tint.height(x, y)))[..., None]

    return Scene(strokes(hills + grain), albedo)


SCENES: dict[str, Callable[[tuple[float, float], float, Generator], Scene]] = {
    "plane": flat_card,
    "drawing": drawing,
    "painting": painting,
    "relief": relief,
}
"""The scenes by name, each made from the field's size (mm), its finest detail (mm) and chance."""
