"""Exposures that the cameras noted, and albedos that no surface has."""

import dataclasses

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.albedos import brightest_albedo
from nlights_core.agreement.comparisons import compare_photographs


def note(path, seconds=(1, 50), f_number=(8, 1), iso=100, factor=1.0):
    """Write a photograph anew, ``factor`` times as bright, with a note of its exposure."""
    numbers = np.clip(256 + factor * (tifffile.imread(path).astype(float) - 256), 0, 65535).astype(np.uint16)
    tags = [(33434, 5, 1, seconds, True), (33437, 5, 1, f_number, True), (34855, 3, 1, iso, True)]
    tifffile.imwrite(path, numbers, photometric="rgb", extratags=tags)


@pytest.fixture
def noted(capture):
    """A capture whose files all note 1/50 s, f/8, ISO 100, of a dark artwork."""
    for path in capture.glob("light_*.tif"):
        note(path, factor=0.1)
    for path in [*capture.glob("flat/*.tif"), capture / "dark.tif"]:
        note(path)
    return capture


def found(comparison):
    return [(warning.code, warning.lamps) for warning in comparison.warnings]


def test_equal_exposures(noted, compared):
    assert found(compared(noted)) == []


@pytest.mark.parametrize(
    ("exposure", "words"),
    [
        ({"seconds": (1, 150)}, "1/150 s, f/8, ISO 100"),
        ({"f_number": (1386, 100)}, "1/50 s, f/13.86, ISO 100"),
        ({"iso": 33}, "1/50 s, f/8, ISO 33"),
    ],
)
def test_flats_at_a_third_of_the_exposure_of_a_dark_artwork(noted, compared, exposure, words):
    for path in noted.glob("flat/*.tif"):
        note(path, factor=1 / 3, **exposure)
    comparison = compared(noted)
    assert found(comparison) == [("exposure", ())]
    assert comparison.warnings[0].value == pytest.approx(3, rel=0.02)
    assert f"flat/light_1.tif says {words}" in comparison.warnings[0].sentence
    assert comparison.lamps == set()


def test_one_photograph_and_one_flat_of_another_exposure(noted, compared):
    note(noted / "light_3.tif", seconds=(1, 100), factor=0.5)
    note(noted / "flat/light_6.tif", seconds=(1, 25), factor=2)
    comparison = compared(noted)
    assert found(comparison) == [("exposure", ("Relio_3",)), ("exposure", ("Relio_6",))]
    assert comparison.warnings[0].value == pytest.approx(0.5)
    assert "light_3.tif (lamp Relio_3)" in comparison.warnings[0].sentence
    assert "1/100 s, f/8, ISO 100" in comparison.warnings[0].sentence


def test_a_lamp_may_have_an_exposure_of_its_own_if_its_flat_has_it_too(noted, compared):
    note(noted / "light_3.tif", seconds=(1, 100), factor=0.5)
    note(noted / "flat/light_3.tif", seconds=(1, 100), factor=0.5)
    assert found(compared(noted)) == []


def test_an_exposure_that_the_converter_evened_out(noted, compared):
    note(noted / "light_3.tif", seconds=(1, 100))
    assert found(compared(noted)) == []


def test_a_dark_frame_of_another_time(noted, compared):
    note(noted / "dark.tif", seconds=(2, 1), f_number=(22, 1))
    comparison = compared(noted)
    assert found(comparison) == [("exposure", ())]
    sentence = comparison.warnings[0].sentence
    assert sentence.startswith("dark.tif: the dark frame was exposed otherwise")
    assert "exposure time 2 against 0.02" in sentence


def test_flats_at_a_third_of_the_exposure_without_a_note(capture, spoil, compared):
    for path in capture.glob("flat/*.tif"):
        spoil(path, lambda numbers: 256 + (numbers - 256) / 3)
    comparison = compared(capture)
    assert found(comparison) == [("albedo-range", ())]
    assert comparison.warnings[0].value > 1.5
    assert "photograph flats and artwork with the same exposure" in comparison.warnings[0].sentence


def test_a_noted_exposure_explains_the_albedo(capture, compared):
    for path in capture.glob("light_*.tif"):
        note(path)
    for path in capture.glob("flat/*.tif"):
        note(path, seconds=(1, 150), factor=1 / 3)
    assert found(compared(capture)) == [("exposure", ())]


def test_the_albedo_counts_what_the_tile_reflects(sampled):
    samples, tile = sampled
    bright = brightest_albedo(samples, samples.lamps, tile)
    assert 0.4 < bright < 0.85
    dim = tile.model_copy(update={"white_reflectance": 0.45})
    assert brightest_albedo(samples, samples.lamps, dim) == pytest.approx(bright / 2)
    # A flat of 0.2 that was photographed three times as bright as it should be.
    grey = dataclasses.replace(samples, flats=samples.flats * 0.667)
    assert compare_photographs(grey, dim, None).warnings == []
    assert [w.code for w in compare_photographs(grey, tile, None).warnings] in ([], ["albedo-range"])
    black = dataclasses.replace(samples, frames=samples.frames * 0.005)
    assert [w.code for w in compare_photographs(black, tile, None).warnings] == ["albedo-range"]
