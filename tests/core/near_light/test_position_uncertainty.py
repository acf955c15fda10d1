"""The lamps' positional uncertainty, against solving with lamps that are really moved."""

import numpy as np
import pytest

from nlights_core.fields import LightField, NormalField
from nlights_core.frames import PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.near_light.position_uncertainty import position_uncertainty
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.simulation.surfaces import bow, normal_field, plane
from nlights_core.solving.least_squares import fit

GRID = PixelGrid(24, 32, 15.0, camera=(0.0, 0.0, 1540.0))
NAMES = tuple(synthetic_stand().lamps)
POSITIONS = synthetic_stand().lamp_positions()
SURFACE = plane(0.1, -0.06) + bow(10.0, 250.0, 190.0)


def assumed(positions: np.ndarray, photographed: bool) -> np.ndarray:
    points = GRID.points(0, GRID.rows)
    rays = positions[:, None, None, :] - np.moveaxis(points, 0, -1)
    if photographed:
        return rays / rays[..., 2:]
    return LightField(NAMES, positions=positions).vectors(points).astype(float)


@pytest.mark.parametrize("photographed", [True, False])
def test_it_is_what_lamps_moved_at_random_do(photographed):
    truth = normal_field(SURFACE, GRID).normals.astype(float)
    images = np.einsum("lhwk,hwk->lhw", assumed(POSITIONS, photographed), truth)
    flat = simchony(*(g.astype(float) for g in NormalField(truth, GRID).gradient()))
    random, angles, heights = np.random.default_rng(0), [], []
    for _ in range(200):
        moved = POSITIONS + random.normal(0, 1.0, POSITIONS.shape)
        found = fit(images, assumed(moved, photographed), np.ones_like(images), np.inf).scaled
        found = np.moveaxis(found / np.linalg.norm(found, axis=0), 0, -1)
        angles.append(np.linalg.norm(np.cross(found, truth), axis=-1))
        heights.append(simchony(*(g.astype(float) for g in NormalField(found, GRID).gradient())) - flat)
    stated = position_uncertainty(
        truth,
        GRID,
        LightField(NAMES, positions=POSITIONS),
        1.0,
        photographed=photographed,
    )
    # The angle that covers 68 % is 1.51 / sqrt(2) of the root mean square of two components.
    rms = np.degrees(np.sqrt(np.mean(np.square(angles))))
    assert stated.normals == pytest.approx(1.51 / np.sqrt(2) * rms, rel=0.1)
    assert stated.height == pytest.approx(np.sqrt(np.mean(np.square(heights))), rel=0.1)


def test_a_photographed_flat_makes_lamps_harmless_on_a_level_surface():
    level = normal_field(plane(), GRID).normals
    field = LightField(NAMES, positions=POSITIONS)
    with_flat = position_uncertainty(level, GRID, field, 5.0, photographed=True)
    without = position_uncertainty(level, GRID, field, 5.0, photographed=False)
    assert with_flat.normals < 1e-9
    assert with_flat.height < 1e-9
    assert without.normals > 0.1


def test_distant_lamps_and_unknown_fields_have_none():
    level = normal_field(plane(), GRID).normals
    distant = LightField(NAMES, directions=POSITIONS / np.linalg.norm(POSITIONS, axis=1, keepdims=True))
    assert position_uncertainty(level, GRID, distant, 1.0, photographed=True) is None
    near = LightField(NAMES, positions=POSITIONS)
    assert position_uncertainty(np.full_like(level, np.nan), GRID, near, 1.0, photographed=True) is None
