"""Noise measured in photographs: against the noise that was put in."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.capture import Encoding, Sensor
from nlights_core.photographs.images import Photograph
from nlights_core.photographs.masks import Mask
from nlights_core.photographs.noise import (
    Noise,
    block_statistics,
    fit_noise,
    measure_noise,
    measure_noise_between_lamps,
    read_noise,
    write_noise,
)

ELECTRONS = 20_000.0
READOUT = 6.0


def photographed(light: np.ndarray, seed: int) -> np.ndarray:
    """16-bit numbers of a camera with photon and readout noise and a black level of 500."""
    random = np.random.default_rng(seed)
    electrons = light * ELECTRONS
    electrons = electrons + random.standard_normal(light.shape) * np.sqrt(electrons + READOUT**2)
    return np.clip(np.rint(500 + electrons * (65535 / ELECTRONS)), 0, 65535).astype(np.uint16)


def opened(folder: Path, name: str, light: np.ndarray, seed: int) -> Photograph:
    tifffile.imwrite(folder / name, photographed(light, seed), photometric="rgb")
    return Photograph(folder / name, Encoding())


def ramp(brightest: float) -> np.ndarray:
    across = np.linspace(0.15, brightest, 640)
    return np.repeat(np.tile(across, (320, 1))[..., None], 3, axis=2) * [1.0, 0.8, 0.5]


@pytest.fixture
def dark(tmp_path):
    with opened(tmp_path, "dark.tif", np.zeros((320, 640, 3)), 9) as photograph:
        yield photograph


def test_gain_and_readout_of_a_flat_are_those_of_the_camera(tmp_path, dark):
    with opened(tmp_path, "flat.tif", ramp(0.8), 1) as flat:
        found = measure_noise([flat], dark, smooth=True)
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.03)
    # Once for the frame, once for the dark frame that is subtracted.
    np.testing.assert_allclose(found.readout, 2 * (READOUT / ELECTRONS) ** 2, rtol=0.1)


def test_an_artwork_that_is_textured_nearly_everywhere_still_shows_the_noise(tmp_path, dark):
    light = ramp(0.8)
    texture = 1 + 0.2 * np.random.default_rng(3).standard_normal((320, 640, 1))
    texture[:, 100:250] = 1
    with opened(tmp_path, "frame.tif", np.clip(light * texture, 0, 0.95), 2) as frame:
        found = measure_noise([frame], dark, smooth=False)
    # The smoothest tenth of all blocks is here the quieter half of the plain ones: 1 / 0.89 too much.
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.15)


@pytest.fixture
def textured(tmp_path):
    """An artwork of paint and relief in every pixel, under lamps around it."""
    random = np.random.default_rng(5)
    albedo = np.exp(0.3 * random.standard_normal((320, 640, 1)))
    normals = np.stack([*0.1 * random.standard_normal((2, 320, 640)), np.ones((320, 640))], axis=-1)
    with ExitStack() as stack:

        def photographs(lamps: int, **more) -> list[Photograph]:
            found = []
            for i in range(lamps):
                angle = 2 * np.pi * i / lamps
                lamp = np.array([np.cos(angle), np.sin(angle), 0.7 + 0.1 * (i % 2)])
                light = 0.35 * ramp(0.8) * albedo * (normals @ lamp)[..., None]
                path = opened(
                    tmp_path, f"{len(list(tmp_path.iterdir()))}.tif", np.clip(light, 0, 0.95), 20 + i
                )
                found.append(stack.enter_context(path))
            return found

        yield photographs


@pytest.mark.parametrize("lamps", [5, 8])
def test_what_lamps_do_not_share_is_noise_however_textured_the_artwork(textured, dark, lamps):
    found = measure_noise_between_lamps(textured(lamps), dark, None)
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.1)
    # That the smoothest tenth of such an artwork is not noise:
    assert measure_noise(textured(2), dark, smooth=False).gain.mean() > 10 / ELECTRONS


def test_fewer_than_five_lamps_have_nothing_left_over(textured, dark):
    assert measure_noise_between_lamps(textured(4), dark, None) is None


def test_a_clean_background_outside_the_mask_says_nothing_of_noise(tmp_path, dark):
    light = ramp(0.8)
    with opened(tmp_path, "frame.tif", light, 1) as frame:
        pass
    image = tifffile.imread(tmp_path / "frame.tif")
    image[:, 200:] = 20_000  # retouched
    tifffile.imwrite(tmp_path / "frame.tif", image, photometric="rgb")
    white = np.zeros((320, 640), np.uint8)
    white[:, :200] = 255
    tifffile.imwrite(tmp_path / "mask.tif", white)
    with Photograph(tmp_path / "frame.tif", Encoding()) as frame:
        unmasked = measure_noise([frame], dark, smooth=False)
        found = measure_noise([frame], dark, smooth=False, mask=Mask(tmp_path / "mask.tif"))
        between = measure_noise_between_lamps([frame] * 5, dark, Mask(tmp_path / "mask.tif"))
    assert unmasked.gain.mean() < 0.1 / ELECTRONS
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.1)
    assert between is not None


@pytest.mark.parametrize("exposures", [4, 16])
def test_flats_that_are_means_tell_the_noise_of_one_exposure(tmp_path, dark, exposures):
    mean = np.mean([photographed(ramp(0.8), 100 + i).astype(float) for i in range(exposures)], axis=0)
    tifffile.imwrite(tmp_path / "flat.tif", np.rint(mean).astype(np.uint16), photometric="rgb")
    with Photograph(tmp_path / "flat.tif", Encoding()) as flat:
        found = measure_noise([flat], dark, smooth=True, averaged=exposures)
        untold = measure_noise([flat], dark, smooth=True)
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.05)
    np.testing.assert_allclose(found.readout, 2 * (READOUT / ELECTRONS) ** 2, rtol=0.1)
    np.testing.assert_allclose(untold.gain * exposures, 1 / ELECTRONS, rtol=0.2)


def test_saturated_blocks_say_nothing_of_noise(tmp_path, dark):
    light = ramp(0.8)
    light[:, 320:] = 2.0
    with opened(tmp_path, "flat.tif", light, 1) as flat:
        found = measure_noise([flat], dark, smooth=True)
    np.testing.assert_allclose(found.gain, 1 / ELECTRONS, rtol=0.05)
    light[:] = 2.0
    with opened(tmp_path, "burnt.tif", light, 1) as flat:
        assert measure_noise([flat], dark, smooth=True) is None


def test_a_tilt_of_the_light_within_a_block_is_no_noise():
    row, column = np.meshgrid(np.arange(16.0), np.arange(160.0), indexing="ij")
    image = (0.3 + 0.01 * row + 0.002 * column)[..., None]
    means, variances = block_statistics(image, np.ones((16, 160), bool))
    assert len(means) == 10
    np.testing.assert_allclose(variances, 0, atol=1e-15)


def test_photographs_without_noise_are_not_taken_to_be_perfect():
    found = fit_noise(np.full((20, 1), 0.5), np.zeros((20, 1)), None, smooth=True)
    np.testing.assert_allclose(np.sqrt(found.gain * 0.5) / 0.5, 1e-4)


def test_weights_are_the_inverse_variance_of_a_reading():
    noise = Noise(np.full(3, 5e-5), np.full(3, 4e-7))
    shares = np.array([0.4, 0.35, 0.25], np.float32)
    light, albedo = 0.1 * shares / shares.mean(), np.array([0.05, 0.5])
    random = np.random.default_rng(0)
    signal = albedo[:, None, None] * light
    drawn = signal + random.standard_normal((2, 200_000, 3)) * np.sqrt(5e-5 * signal + 4e-7)
    variance = (drawn / light @ shares).var(axis=1)
    weights = np.full((8, 2, 1), 1 / noise.photons(light.astype(np.float32), shares), np.float32)
    noise.with_readout(weights, np.broadcast_to(albedo[:, None], (8, 2, 1)).astype(np.float32), shares)
    np.testing.assert_allclose(albedo / weights[0, :, 0], variance, rtol=0.03)


def test_black_pixels_get_no_weight_and_no_warning():
    noise = Noise(np.full(3, 5e-5), np.full(3, 4e-7))
    weights = np.ones((8, 2, 2), np.float32)
    weights[:, 1] = 0
    noise.with_readout(weights, np.zeros((8, 2, 2), np.float32), np.full(3, 1 / 3, np.float32))
    assert (weights == 0).all()


def test_a_stated_sensor_is_believed_and_noise_is_kept_exactly(tmp_path):
    sensor = Sensor(electrons_at_saturation=40_000, read_noise_electrons=3)
    stated = Noise.of_sensor(sensor, 3, dark=True)
    np.testing.assert_allclose(stated.gain, 2.5e-5)
    np.testing.assert_allclose(stated.readout, 2 * (3 / 40_000) ** 2)
    assert read_noise(tmp_path) is None
    write_noise(tmp_path, stated)
    again = read_noise(tmp_path)
    assert (again.gain == stated.gain).all()
    assert (again.readout == stated.readout).all()
