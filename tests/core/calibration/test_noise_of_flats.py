"""Flats that are means of exposures: the noise is that of the photographs, and is said to be another."""

import numpy as np
import pytest
import tifffile

from nlights_core.calibration.record import read_calibration
from nlights_core.manifest import load_capture
from nlights_core.photographs.noise import read_noise
from nlights_core.recipe import load_recipe
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.stages import calibration, flat_field, lights
from nlights_core.store import Store

FULL_WELL = 50_000
"""Electrons, of the simulator."""


def average_flats(capture, exposures):
    """Flats as quiet as the means of so many: smooth light, and what is left of the noise."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(2)
    for path in (capture / "flat").glob("*.tif"):
        image = gaussian_filter(tifffile.imread(path).astype(float), (4, 4, 0))
        spread = np.sqrt(np.maximum(image - 256, 1) * 65535 / FULL_WELL / exposures)
        quiet = image + spread * random.standard_normal(image.shape)
        tifffile.imwrite(path, np.rint(quiet).astype(np.uint16), photometric="rgb")


def calibrated(capture, place, stated=""):
    manifest = capture / "artwork.yaml"
    manifest.write_text(manifest.read_text() + stated)
    tile, recipe, store = load_capture(capture)[0], load_recipe("default"), Store(place / "store")
    lamps = lights(store, tile, recipe.light_model)
    store.ensure(lamps)
    white = flat_field(store, tile, recipe.detrend.images, lamps.ref)
    store.ensure(white)
    work = calibration(store, tile, lamps.ref, white.ref, ())
    store.ensure(work)
    folder = store.path(work.ref)
    known = read_calibration(folder)
    (said,) = [number for number in of_calibration(known, None) if number.code == "flats-averaged"]
    return known, said, read_noise(folder), read_noise(store.path(white.ref))


def test_single_flats_are_as_noisy_as_the_artwork(capture, tmp_path):
    known, said, noise, flats = calibrated(capture, tmp_path)
    assert known.noisier == pytest.approx(1, abs=0.2)
    assert said.warning == ""
    np.testing.assert_array_equal(noise.gain, flats.gain)


def test_flats_averaged_untold_are_named_with_what_to_write(capture, tmp_path):
    average_flats(capture, 16)
    known, said, noise, flats = calibrated(capture, tmp_path)
    assert known.noisier == pytest.approx(16, rel=0.15)
    assert f"flats_averaged: {round(known.noisier)}" in said.warning
    np.testing.assert_allclose(noise.gain, 1 / FULL_WELL, rtol=0.2)
    np.testing.assert_allclose(flats.gain, 1 / FULL_WELL / 16, rtol=0.1)


@pytest.mark.parametrize(
    "stated", ["flats_averaged: 16\n", "sensor: {electrons_at_saturation: 50000, read_noise_electrons: 4}\n"]
)
def test_what_is_stated_is_believed(capture, tmp_path, stated):
    average_flats(capture, 16)
    known, said, noise, _ = calibrated(capture, tmp_path, stated)
    assert known.noisier is None
    assert said.warning == ""
    np.testing.assert_allclose(noise.gain, 1 / FULL_WELL, rtol=0.1)


def test_photographs_that_are_means_keep_the_larger_noise(capture, tmp_path):
    """The flats are noisier: nothing is claimed to be better than they say."""
    from scipy.ndimage import gaussian_filter

    for path in capture.glob("light_*.tif"):
        image = gaussian_filter(tifffile.imread(path).astype(float), (1.5, 1.5, 0))
        tifffile.imwrite(path, np.rint(image).astype(np.uint16), photometric="rgb")
    known, said, noise, flats = calibrated(capture, tmp_path)
    assert known.noisier < 0.4
    assert "ISO" in said.warning
    np.testing.assert_array_equal(noise.gain, flats.gain)
