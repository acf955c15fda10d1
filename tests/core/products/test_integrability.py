"""Integrable normals: noise loses its curl, surfaces lose nothing."""

from itertools import pairwise

import numpy as np
import pytest

from nlights_core.frames import PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.integration.sight_lines import facing_rays, perspective_height, seen_gradient
from nlights_core.products.integrability import AROUND, OWN, integrable_normals, integrable_uncertainty
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.surfaces import bow, normal_field, plane, wave

FLAT = PixelGrid(120, 160, 1.0)
SEEN = PixelGrid(120, 160, 1.0, camera=(3.0, -2.0, 500.0))
SURFACE = bow(1.0, 80.0, 60.0) + wave(0.5, 14.0, angle_deg=30.0) + plane(0.05, -0.02)


def turned(normals: np.ndarray, degrees: float, seed: int = 0) -> np.ndarray:
    """Unit normals with white noise of so many degrees per component."""
    noise = np.random.default_rng(seed).normal(0, np.radians(degrees), normals.shape)
    noisy = normals + noise
    return (noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)).astype(np.float32)


def integrated(normals: np.ndarray, grid: PixelGrid) -> np.ndarray:
    slopes = seen_gradient(normals, facing_rays(normals, grid), grid, 70.0)
    return simchony(*slopes) if grid.camera is None else perspective_height(simchony(*slopes), grid.camera[2])


def corrected(normals: np.ndarray, grid: PixelGrid, start: int = 0, stop: int | None = None) -> np.ndarray:
    height = integrated(normals, grid)
    return integrable_normals(
        normals, height, grid, start, stop or grid.rows, perspective=grid.camera is not None
    )


@pytest.mark.parametrize("grid", [FLAT, SEEN])
def test_white_noise_keeps_557_thousandths_of_its_variance(grid):
    truth = normal_field(SURFACE, grid).normals
    noisy = turned(truth, 0.2)
    before = angles_between(noisy, truth)
    after = angles_between(corrected(noisy, grid), truth)
    assert np.mean(after**2) / np.mean(before**2) == pytest.approx(OWN + AROUND, abs=0.015)


@pytest.mark.parametrize("grid", [FLAT, SEEN])
def test_a_surface_keeps_its_normals(grid):
    truth = normal_field(SURFACE, grid).normals
    assert angles_between(corrected(truth, grid), truth).max() < 0.02


def test_the_finest_texture_stays():
    grid = PixelGrid(96, 96, 1.0)
    truth = normal_field(wave(0.05, 4.0, angle_deg=22.5), grid).normals
    slopes = np.hypot(*truth[..., :2].reshape(-1, 2).T)
    change = angles_between(corrected(truth, grid), truth)[8:-8, 8:-8]
    assert np.sqrt(np.mean(change**2)) < 0.012 * np.degrees(np.sqrt(np.mean(slopes**2)))


def test_unknown_stays_unknown_and_its_neighbours_are_sound():
    truth = normal_field(SURFACE, FLAT).normals
    noisy = turned(truth, 0.2)
    hole = np.zeros(FLAT.shape, bool)
    hole[40:60, 50:90] = True
    height = integrated(noisy, FLAT)
    noisy[hole] = np.nan
    height[hole] = np.nan
    found = integrable_normals(noisy, height, FLAT, 0, FLAT.rows, perspective=False)
    assert (np.isnan(found).all(axis=-1) == hole).all()
    rim = np.zeros(FLAT.shape, bool)
    rim[38:62, 48:92] = True
    errors = [angles_between(normals, truth)[rim & ~hole].mean() for normals in (noisy, found)]
    assert errors[1] < errors[0]


def test_bands_may_be_cut_anywhere():
    noisy = turned(normal_field(SURFACE, SEEN).normals, 0.3)
    whole = corrected(noisy, SEEN)
    cuts = [0, 7, 8, 50, 113, 120]
    parts = [corrected(noisy, SEEN, a, b) for a, b in pairwise(cuts)]
    assert np.array_equal(np.concatenate(parts), whole)


def test_very_steep_normals_are_left_alone():
    normals = normal_field(plane(), FLAT).normals.copy()
    normals[5, 5] = [np.sin(1.5), 0, np.cos(1.5)]
    height = np.zeros(FLAT.shape, np.float32)
    found = integrable_normals(normals, height, FLAT, 0, FLAT.rows, perspective=False)
    assert np.array_equal(found, normals)


def test_the_uncertainty_covers_68_percent_where_it_varies_from_place_to_place():
    truth = normal_field(SURFACE, FLAT).normals
    level = np.where(np.arange(160) % 40 < 20, 0.1, 0.4) * np.ones(FLAT.shape)
    noise = np.random.default_rng(4).normal(0, 1, truth.shape) * np.radians(level)[..., None]
    noisy = truth + noise
    noisy = (noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)).astype(np.float32)
    stated = integrable_uncertainty((1.51 * level).astype(np.float32), 0, FLAT.rows)
    errors = angles_between(corrected(noisy, FLAT), truth)
    assert np.mean(errors <= stated) == pytest.approx(0.68, abs=0.02)


def test_the_uncertainty_of_the_unknown_is_unknown():
    confidence = np.full((20, 30), 0.3, np.float32)
    confidence[4:9, 5] = np.nan
    found = integrable_uncertainty(confidence, 2, 15)
    assert (np.isnan(found) == np.isnan(confidence[2:15])).all()
    np.testing.assert_allclose(found[np.isfinite(found)], 0.3 * np.sqrt(OWN + AROUND), rtol=1e-6)
