"""What flats say about the lamps, where the lamps are known."""

import numpy as np
import pytest

from nlights_core.configurations import load_stand
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.lamps.emission import Emission, computed_flat_field, fit_emission, flat_fit
from nlights_core.simulation.illumination import lamp_groups, shine
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.stands import Stand

STANDS = ("horizontal", "vertical-open", "vertical-dark")
GRID = PixelGrid(90, 120, 500 / 120)
X, Y = GRID.x(), GRID.y()


def photographed(stand: Stand, seed: int) -> Array:
    """Flats of groups of four unequal lamps, with a lens of cos^4 and 0.1 % noise."""
    random = np.random.default_rng(seed)
    upright = np.broadcast_to(np.array([0, 0, 1], np.float32), (*GRID.shape, 3))
    cx, cy, cz = stand.camera_position
    lens = 1 / (1 + ((X - cx) ** 2 + (Y[:, None] - cy) ** 2) / cz**2) ** 2
    flats = [shine(g, GRID.points(0, 90), upright, None)[0] * lens for g in lamp_groups(stand, random)]
    noise = random.normal(1, 0.001, (len(flats), *GRID.shape))
    return np.asarray((np.stack(flats) * noise)[..., None], np.float32)


def fitted(reading: Array, stand: Stand) -> Emission:
    return fit_emission(reading, stand, tuple(stand.lamps), X, Y)


def degrees_between(first: LightField, second: LightField) -> Array:
    assert first.axes is not None
    assert second.axes is not None
    return np.asarray(np.degrees(np.linalg.norm(first.axes - second.axes, axis=1)))


@pytest.fixture(scope="module")
def ideal() -> tuple[Stand, LightField, Array]:
    """Lamps with ideal lobes, off in aim, exponent and power, behind a lens that is not quite cos^4."""
    stand = synthetic_stand()
    random = np.random.default_rng(7)
    positions = stand.lamp_positions()
    axes = -positions / np.linalg.norm(positions, axis=1, keepdims=True) + random.normal(0, 0.02, (8, 3))
    lights = LightField(
        tuple(stand.lamps),
        positions=positions,
        axes=axes / np.linalg.norm(axes, axis=1, keepdims=True),
        exponents=stand.lamp.exponent * random.uniform(0.8, 1.2, 8),
        power=random.uniform(0.8, 1.2, (8, 1)),
    )
    nothing = np.zeros((8, 3))
    emission = Emission(lights, np.array([-0.04, 0.03]), 0.0, nothing, nothing, 0.0, 0.0, 0.0, (), True)
    return stand, lights, computed_flat_field(emission, stand, X, Y)


def test_ideal_lamps_are_found_as_they_are(ideal: tuple[Stand, LightField, Array]) -> None:
    stand, lights, reading = ideal
    found = fitted(reading, stand)
    assert degrees_between(found.lights, lights).max() < 0.02
    assert lights.exponents is not None
    assert found.lights.exponents == pytest.approx(lights.exponents, rel=2e-3)
    np.testing.assert_allclose(found.lights.power, lights.power / lights.power.mean(), rtol=2e-3)
    np.testing.assert_allclose(found.vignetting, [-0.04, 0.03], atol=3e-3)
    assert found.residual < 1e-3
    assert found.fits


def test_a_flat_measured_with_ideal_lamps_comes_out_flat(ideal: tuple[Stand, LightField, Array]) -> None:
    stand, _, reading = ideal
    peak_to_valley, rms = flat_fit(reading, fitted(reading, stand), stand, X, Y)
    assert rms < peak_to_valley < 20


def test_the_bow_of_a_flat_is_measured(ideal: tuple[Stand, LightField, Array]) -> None:
    """To first order a slope (p, q) changes the reading of a lamp at L by -(p Lx + q Ly) / Lz."""
    stand, _, reading = ideal
    emission = fitted(reading, stand)
    curvature = 1e-5
    slope = curvature * np.stack(np.meshgrid(X, Y))
    rays = stand.lamp_positions()[:, :2, None, None] - np.stack(np.meshgrid(X, Y))
    shading = 1 - np.sum(rays * slope, axis=1) / stand.lamp_positions()[:, 2, None, None]
    peak_to_valley, _ = flat_fit(reading * shading[..., None], emission, stand, X, Y)
    expected = 1000 * curvature / 2 * (250**2 + 187.5**2)
    assert peak_to_valley == pytest.approx(expected, rel=0.1)


def test_dirt_and_saturation_do_not_move_the_axes(ideal: tuple[Stand, LightField, Array]) -> None:
    stand, lights, reading = ideal
    dirty = reading.copy()
    random = np.random.default_rng(0)
    for row, column in zip(random.integers(0, 80, 12), random.integers(0, 110, 12), strict=True):
        dirty[:, row : row + 6, column : column + 6] *= 0.8
    dirty[2, :10, :40] = np.nan
    found = fitted(dirty, stand).lights
    assert degrees_between(found, lights).max() < 0.2


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", STANDS)
def test_the_right_stand_is_believed(name: str, seed: int) -> None:
    stand = load_stand(name)
    found = fitted(photographed(stand, seed), stand)
    assert found.fits
    assert not found.suspects
    assert found.likely_mm == pytest.approx(stand.uncertainty_mm)


@pytest.mark.parametrize("seed", range(3))
def test_the_shift_of_the_darkening_fabric_is_noticed(seed: int) -> None:
    reading, wrong = photographed(load_stand("vertical-dark"), seed), load_stand("vertical-open")
    found = fitted(reading, wrong)
    assert not found.fits
    assert 3 < found.likely_mm < 10  # the lamps are 6.6 mm off per axis


def test_swapped_lamps_are_named() -> None:
    stand = load_stand("horizontal")
    names = list(stand.lamps)
    swapped = {**stand.lamps, names[0]: stand.lamps[names[2]], names[2]: stand.lamps[names[0]]}
    found = fitted(photographed(stand, 1), stand.model_copy(update={"lamps": swapped}))
    assert not found.fits
    assert set(found.suspects) == {names[0], names[2]}


def test_a_flat_that_is_mostly_unknown_is_refused() -> None:
    stand = load_stand("horizontal")
    reading = photographed(stand, 0)
    reading[3, :, :70] = np.nan
    with pytest.raises(TileError, match=r"Relio_4.*42 %|Relio_4.*42%"):
        fitted(reading, stand)
