"""Algorithms cannot write into what they are given, and what is wrong with their answers is seen and named."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from nlights_core.algorithms import (
    HeightDetrend,
    ImageDetrend,
    Integrator,
    LightModel,
    NormalDetrend,
    NormalSolver,
)
from nlights_core.capture import Tile
from nlights_core.contracts import verbs
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, LightField, NormalField
from nlights_core.frames import PixelGrid
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.simulation.surfaces import bow, height_map, normal_field, peaks, plane
from nlights_plugins.integrators import FrankotChellappa, Simchony
from nlights_plugins.least_squares import LeastSquares

GRID = PixelGrid(60, 80, 0.1)
HILLS = peaks(top=0.3, half_width=1.5)


def asked(kind, verb, answer):
    """An algorithm of a kind whose verb is a function."""
    body = {"name": "slip", "__annotations__": {"name": ClassVar[str]}, "__module__": __name__}
    return type("Slip", (kind,), body | {verb: lambda self, *given: answer(*given)})()


def integrator(answer) -> Integrator:
    return asked(Integrator, "integrate", answer)


def scaled(factor):
    return integrator(lambda normals: HeightMap(factor * height_map(HILLS, GRID).height, GRID))


def noisy(size=0.05) -> NormalField:
    """The normals of hills, each tilted by chance by `size` radians."""
    truth = normal_field(HILLS, GRID).normals
    tilt = np.random.default_rng(0).normal(0, size, truth.shape).astype(np.float32)
    tilted = truth + tilt * np.float32([1, 1, 0])
    return NormalField(tilted / np.linalg.norm(tilted, axis=-1, keepdims=True), GRID)


def tile() -> Tile:
    stand = synthetic_stand()
    frames = {lamp: Path(f"/{lamp}.tif") for lamp in stand.lamps}
    return Tile(artwork="a", name="t", stand=stand, frames=frames)


def lamps(**changes) -> LightField:
    stand = synthetic_stand()
    return replace(LightField(tuple(stand.lamps), positions=stand.lamp_positions()), **changes)


def written(array):
    array[0] = 0


@pytest.mark.parametrize(
    "ask",
    [
        lambda: verbs.solve(
            asked(NormalSolver, "solve", lambda images, lights, weights: written(images)),
            *(np.ones(shape, np.float32) for shape in ((4, 2, 3), (4, 2, 3, 3), (4, 2, 3))),
        ),
        lambda: verbs.solve(
            asked(NormalSolver, "solve", lambda images, lights, weights: np.multiply(weights, 2, out=weights)),
            *(np.ones(shape, np.float32) for shape in ((4, 2, 3), (4, 2, 3, 3), (4, 2, 3))),
        ),
        lambda: verbs.integrate(integrator(lambda n: written(n.normals)), normal_field(HILLS, GRID)),
        lambda: verbs.integrate(
            integrator(lambda n: written(n.confidence)),
            replace(normal_field(HILLS, GRID), confidence=np.ones(GRID.shape, np.float32)),
        ),
        lambda: verbs.bias(
            asked(NormalDetrend, "bias", lambda n: written(n.normals)), normal_field(HILLS, GRID)
        ),
        lambda: verbs.trend(asked(HeightDetrend, "trend", lambda z: z.height.sort()), height_map(HILLS, GRID)),
        lambda: verbs.flat_field(
            asked(ImageDetrend, "flat_field", lambda flats, lights, x, y: written(lights.positions)),
            None, lamps(), np.zeros(3), np.zeros(2), 1,
        ),
    ],
)  # fmt: skip
def test_an_algorithm_that_writes_into_its_input_is_named(ask):
    with pytest.raises(TileError, match=r"slip \(not installed\) changed its input \(test_verbs.py:\d+\)"):
        ask()


def test_what_was_lent_can_be_written_to_afterwards_and_was_not_copied():
    given = normal_field(HILLS, GRID)
    seen = []
    verbs.integrate(integrator(lambda n: (seen.append(n.normals), Simchony().integrate(n))[1]), given)
    assert np.shares_memory(seen[0], given.normals)
    given.normals[0] = 0


@pytest.mark.parametrize("fault", [ZeroDivisionError("by zero"), SystemExit(3), ValueError("shape")])
def test_an_algorithm_that_fails_is_named_with_the_line(fault):
    def fails(normals):
        raise fault

    words = (
        rf"integrator: slip \(not installed\) failed with {type(fault).__name__}: .* \(test_verbs.py:\d+\)"
    )
    with pytest.raises(TileError, match=words):
        verbs.integrate(integrator(fails), normal_field(HILLS, GRID))


@pytest.mark.parametrize("fault", [TileError("no sphere"), FileNotFoundError("gone"), MemoryError()])
def test_what_says_itself_what_to_do_passes(fault):
    def fails(normals):
        raise fault

    with pytest.raises(type(fault)) as caught:
        verbs.integrate(integrator(fails), normal_field(HILLS, GRID))
    assert caught.value is fault


@pytest.mark.parametrize(("factor", "said"), [(10.0, "10"), (1000.0, "1e+03"), (0.001, "0.001")])
def test_a_height_in_pixels_micrometres_or_metres_is_seen(factor, said):
    """0.1 mm pixels: a height in pixels is 10 times as high."""
    with pytest.raises(TileError) as fault:
        verbs.integrate(scaled(factor), normal_field(HILLS, GRID))
    assert "slip (not installed) should return height in mm" in str(fault.value)
    factor_said = float(str(fault.value).split("steps that are ")[1].split()[0])
    assert factor_said == pytest.approx(factor, rel=0.02)


def test_a_height_that_grows_away_from_the_camera_is_seen():
    with pytest.raises(TileError, match="falls where the normals say that the surface rises"):
        verbs.integrate(scaled(-1), normal_field(HILLS, GRID))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_poor_height_is_not_taken_for_another_unit(factor):
    assert np.isfinite(verbs.integrate(scaled(factor), normal_field(HILLS, GRID))).any()


@pytest.mark.parametrize("algorithm", [Simchony(), FrankotChellappa(), FrankotChellappa(periodic=True)])
@pytest.mark.parametrize("surface", [HILLS, plane(), plane(0.4, -0.2)], ids=["hills", "level", "tilted"])
def test_noise_is_not_taken_for_another_unit(algorithm, surface):
    """Most of what noise says of the slopes no surface can follow."""
    truth = normal_field(surface, GRID).normals
    tilted = truth + np.random.default_rng(1).normal(0, 0.1, truth.shape).astype(np.float32)
    tilted /= np.linalg.norm(tilted, axis=-1, keepdims=True)
    tilted[20:30, 10:40] = np.nan
    assert np.isfinite(verbs.integrate(algorithm, NormalField(tilted, GRID))).any()


def test_lines_that_gather_noise_are_not_taken_for_another_unit():
    """Integration along rows and along columns, averaged: poor, but in mm."""

    def lines(normals):
        across, down = (np.cumsum(step, axis=1 - i) for i, step in enumerate(normals.gradient()))
        return HeightMap((across - across[:, :1] + down[:, :1] + down - down[:1] + across[:1]) / 2, GRID)

    assert np.isfinite(verbs.integrate(integrator(lines), NormalField(noisy().normals, GRID))).any()


def test_a_level_height_says_nothing_of_its_unit():
    level = integrator(lambda n: HeightMap(np.zeros(GRID.shape, np.float32), GRID))
    assert not verbs.integrate(level, normal_field(plane(), GRID)).any()


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (lamps(positions=lamps().positions / 1000), "positions in mm; got lamps 0.001 times as far away"),
        (lamps(positions=lamps().positions * np.nan), "finite positions of the lamps; got nan"),
        (lamps(power=np.zeros((8, 1))), "positive power of every lamp; got 0"),
        (
            lamps(directions=np.full((8, 3), 1.0), positions=None),
            "directions as unit vectors; got a length of 1.732",
        ),
        (SimpleNamespace(), "should return a LightField; got SimpleNamespace"),
    ],
)
def test_lights_that_cannot_be_are_refused(field, words):
    with pytest.raises(TileError, match=words):
        verbs.locate(asked(LightModel, "locate", lambda tile, read: field), tile(), None)


def test_lights_of_other_lamps_are_refused():
    field = lamps(lamps=tuple(reversed(tile().lamps)))
    with pytest.raises(TileError, match="a/t: light_model: slip found lights for high_4, low_4"):
        verbs.locate(asked(LightModel, "locate", lambda tile, read: field), tile(), None)


@pytest.mark.parametrize("value", [-0.1, np.inf])
def test_a_flat_field_that_is_not_positive_is_refused(value):
    reading = np.ones((8, 2, 3, 1), np.float32)
    reading[3, 1, 1] = value
    detrend = asked(ImageDetrend, "flat_field", lambda *given: reading)
    with pytest.raises(TileError, match=r"slip .* should return a positive flat field; got"):
        verbs.flat_field(detrend, None, lamps(), np.zeros(3), np.zeros(2), 3)
    reading[3, 1, 1] = np.nan  # not known
    verbs.flat_field(detrend, None, lamps(), np.zeros(3), np.zeros(2), 3)


def test_a_trend_in_another_unit_or_with_holes_is_refused():
    height = height_map(bow(0.5, 4.0, 3.0), GRID)
    for factor, words in (
        (1000, "should return the trend in the height's unit"),
        (np.nan, "finite everywhere"),
    ):
        detrend = asked(HeightDetrend, "trend", lambda z, by=factor: np.float32(by) * z.height)
        with pytest.raises(TileError, match=words):
            verbs.trend(detrend, height)
    same = asked(HeightDetrend, "trend", lambda z: z.height.copy())
    np.testing.assert_array_equal(verbs.trend(same, height), height.height)


def test_a_bias_that_no_two_unit_vectors_have_between_them_is_refused():
    detrend = asked(NormalDetrend, "bias", lambda n: np.full((*GRID.shape, 3), 57.0, np.float32))
    with pytest.raises(TileError, match="a difference of unit vectors; got 57"):
        verbs.bias(detrend, normal_field(HILLS, GRID))


def test_a_bundled_solver_works_on_what_it_cannot_write_to():
    images, weights = np.full((2, 4, 2, 3), 0.5, np.float32)
    lights = np.zeros((4, 1, 1, 3), np.float32)
    lights[:, 0, 0] = [[0.5, 0, 1], [-0.5, 0, 1], [0, 0.5, 1], [0, -0.5, 1]]
    found = verbs.solve(LeastSquares(), images, lights, weights)
    np.testing.assert_allclose(found.normals[..., 2], 1, atol=1e-6)
