"""Lamps calibrated on the artwork itself, against lamps that are known."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.lamps.emission_on_artwork import fit_emission_on_artwork
from nlights_core.simulation.illumination import lamp_groups, shine
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.simulation.surfaces import bow

GRID = PixelGrid(30, 40, 12.5)
X, Y = GRID.x(), GRID.y()
SURFACE = bow(0.8, 500, 375)


def given_lamps() -> LightField:
    stand = synthetic_stand()
    positions = stand.lamp_positions()
    axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    exponents = np.full(8, stand.lamp.exponent)
    return LightField(tuple(stand.lamps), positions=positions, axes=axes, exponents=exponents)


def off(lights: LightField, seed: int) -> LightField:
    """Lamps 8 % unequal, 1.5 degrees off in aim and 20 % in exponent."""
    random = np.random.default_rng(seed)
    assert lights.axes is not None
    assert lights.exponents is not None
    axes = lights.axes + random.normal(0, np.radians(1.5), (8, 3))
    return replace(
        lights,
        power=random.normal(1, 0.08, (8, 1)),
        axes=axes / np.linalg.norm(axes, axis=1, keepdims=True),
        exponents=lights.exponents * random.uniform(0.8, 1.2),
    )


def painted(random: np.random.Generator) -> Array:
    """Albedo of blocks: any."""
    return np.asarray(random.uniform(0.1, 0.9, GRID.shape))


def photographed(lights: LightField, seed: int) -> Array:
    """A painting, bowed by 0.8 mm, under ideal lamps, with 0.2 % noise."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(X, Y)
    light = lights.vectors(np.stack([x, y, SURFACE.height(x, y)]))
    shading = np.sum(light * SURFACE.normals(x, y), axis=-1) * lights.power[:, :, None]
    return np.asarray(shading * painted(random) * random.normal(1, 0.002, shading.shape))


def flat_field_error(found: LightField, true: LightField) -> float:
    """Rms share by which computed flat fields differ, but for a factor common to all lamps."""
    points = np.stack([*np.meshgrid(X, Y), np.zeros(GRID.shape)])
    ratio = [np.log(f.vectors(points)[..., 2] * f.power[:, :, None]) for f in (found, true)]
    return float(np.std(ratio[0] - ratio[1]))


@pytest.mark.parametrize("seed", range(3))
def test_wrong_lamps_are_mended(seed: int) -> None:
    given = given_lamps()
    true = off(given, seed)
    found = fit_emission_on_artwork(photographed(true, seed), given, X, Y)
    assert flat_field_error(given, true) > 0.1
    assert flat_field_error(found, true) < 0.2 * flat_field_error(given, true)


@pytest.mark.parametrize("seed", range(5))
def test_right_lamps_are_left_alone(seed: int) -> None:
    true = off(given_lamps(), seed)
    images = photographed(true, seed) / true.power[:, :, None]
    assert fit_emission_on_artwork(images, true, X, Y) is true


def test_groups_of_lamps_are_mended_though_no_ideal_lobe_describes_them() -> None:
    random = np.random.default_rng(3)
    groups = lamp_groups(synthetic_stand(), random)
    x, y = np.meshgrid(X, Y)
    points = np.stack([x, y, SURFACE.height(x, y)]).astype(np.float32)
    normals = SURFACE.normals(x, y).astype(np.float32)
    images = np.stack([shine(group, points, normals, None)[0] for group in groups])
    given = given_lamps()
    found = fit_emission_on_artwork(images * painted(random), given, X, Y)
    flat = np.stack([*np.meshgrid(X, Y), np.zeros(GRID.shape)]).astype(np.float32)
    upright = np.broadcast_to(np.array([0, 0, 1], np.float32), normals.shape)
    true = np.log(np.stack([shine(group, flat, upright, None)[0] for group in groups]))
    errors = [
        float(np.std(np.log(lights.vectors(flat)[..., 2] * lights.power[:, :, None]) - true))
        for lights in (given, found)
    ]
    assert errors[1] < 0.3 * errors[0]


def test_blocks_that_are_not_known_are_left_out() -> None:
    given = given_lamps()
    true = off(given, 1)
    images = photographed(true, 1)
    images[:3, 5:12, 5:15] = np.nan
    images[4, 20:24] = 0
    found = fit_emission_on_artwork(images, given, X, Y)
    assert flat_field_error(found, true) < 0.2 * flat_field_error(given, true)


def test_an_artwork_in_the_dark_is_refused() -> None:
    images = photographed(given_lamps(), 0)
    images[2, :, 3:] = np.nan
    with pytest.raises(TileError, match="only 90 blocks"):
        fit_emission_on_artwork(images, given_lamps(), X, Y)
