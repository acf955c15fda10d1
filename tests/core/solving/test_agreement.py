"""Agreement of the photographs with the model: noise, gloss, a lamp that is wrong."""

import numpy as np
import pytest

from nlights_core.algorithms import PHOTONS, NormalSolver, Solution
from nlights_core.frames import Array, PixelGrid
from nlights_core.photographs.development import Band
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.solving.agreement import AgreementMeter, read_agreement, write_agreement
from nlights_core.solving.least_squares import fit, solution

GRID = PixelGrid(60, 80, 1.0)


class Plain(NormalSolver):
    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        return solution(images, lights, weights, fit(images, lights, weights, 100.0))


def solve(band: Band) -> Solution:
    return Plain.solve(None, band.grey, band.lights, band.weights)


def band(images: np.ndarray, lights: np.ndarray, start: int = 0) -> Band:
    grey = images.astype(np.float32)
    nothing = np.zeros(grey.shape, bool)
    return Band(
        start, start + grey.shape[1], grey[..., None], np.ones_like(grey), nothing, lights, None, grey
    )


def scene(noise: float) -> tuple[np.ndarray, np.ndarray]:
    positions = synthetic_stand().lamp_positions()
    lights = (positions / positions[:, 2:]).astype(np.float32)[:, None, None, :]
    random = np.random.default_rng(1)
    normals = np.stack([*random.normal(0, 0.03, (2, *GRID.shape)), np.ones(GRID.shape)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    images = 0.5 * np.einsum("lhwk,hwk->lhw", np.broadcast_to(lights, (8, *GRID.shape, 3)), normals)
    return images + noise * random.standard_normal(images.shape) * np.sqrt(images / PHOTONS), lights


def found(images, lights):
    meter = AgreementMeter(GRID, solve)
    meter.add(band(images[:, :25], lights))
    meter.add(band(images[:, 25:], lights, 25))
    return meter.found()


def test_noise_that_was_foreseen_is_1_and_twice_of_it_2():
    assert found(*scene(1.0)).surprise == pytest.approx(1, abs=0.03)
    assert found(*scene(2.0)).surprise == pytest.approx(2, abs=0.06)


def test_without_noise_every_lamp_is_predicted():
    agreement = found(*scene(0.0))
    assert agreement.surprise < 0.01
    assert max(agreement.held_out) < 1e-5


def test_a_lamp_that_is_3_percent_too_bright_is_named():
    images, lights = scene(0.0)
    images[2] *= 1.03
    held_out = found(images, lights).held_out
    assert int(np.argmax(held_out)) == 2
    # The others know nothing of its error, so all of it shows: 3 % of a reading of about 1.
    assert held_out[2] == pytest.approx(0.03, rel=0.1)


def test_highlights_at_a_few_pixels_are_in_the_rms_and_not_in_the_typical_difference():
    images, lights = scene(0.0)
    images[4, ::10, ::10] *= 30
    agreement = found(images, lights)
    assert agreement.held_out[4] > 1
    assert agreement.typical[4] < 0.01
    images[4] *= 1.5
    assert found(images, lights).typical[4] == pytest.approx(0.5, rel=0.2)


def test_three_lights_leave_nothing_to_compare(tmp_path):
    images, lights = scene(1.0)
    meter = AgreementMeter(GRID, solve)
    meter.add(band(images[[0, 1, 2]], lights[[0, 1, 2]]))
    agreement = meter.found()
    assert agreement.surprise is None
    assert agreement.held_out == agreement.typical == (None, None, None)
    write_agreement(tmp_path, agreement)
    assert read_agreement(tmp_path) == agreement
