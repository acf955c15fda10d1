"""Dark frames that light reached."""

import numpy as np
import pytest
import tifffile


def codes(comparison):
    return [(warning.code, warning.lamps) for warning in comparison.warnings]


@pytest.mark.parametrize("share", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("picture", ["light_2.tif", "flat/light_7.tif"])
def test_a_dark_frame_that_shows_a_picture(capture, spoil, compared, picture, share):
    light = tifffile.imread(capture / picture).astype(float) - 256
    spoil(capture / "dark.tif", lambda numbers: numbers + share * light)
    comparison = compared(capture)
    assert codes(comparison) == [("dark-lit", ())]
    assert comparison.final
    assert "dark.tif: the dark frame shows a picture" in comparison.warnings[0].sentence
    assert "lens covered" in comparison.warnings[0].sentence


def test_a_dark_frame_of_a_dark_artwork_under_one_percent_of_a_lamp(capture, spoil, compared):
    for n in range(1, 9):
        spoil(capture / f"light_{n}.tif", lambda numbers: 256 + 0.1 * (numbers - 256))
    light = tifffile.imread(capture / "light_5.tif").astype(float) - 256
    spoil(capture / "dark.tif", lambda numbers: numbers + 0.02 * light)
    assert codes(compared(capture)) == [("dark-lit", ())]


def test_a_dark_frame_that_is_brighter_than_a_photograph_anywhere(capture, spoil, compared):
    def shade(numbers):
        numbers[30:60, 40:70] = 256
        return numbers

    spoil(capture / "light_4.tif", shade)
    spoil(capture / "dark.tif", lambda numbers: numbers + 655)
    warnings = compared(capture).warnings
    assert [warning.code for warning in warnings] == ["dark-lit"]
    assert "brighter than light_4.tif (lamp Relio_4)" in warnings[0].sentence
    assert warnings[0].unit == "% of the field"


def test_a_warm_sensor_is_no_picture(capture, spoil, compared):
    def glow(numbers):
        rows, columns = np.mgrid[: numbers.shape[0], : numbers.shape[1]]
        corner = np.exp(-np.hypot(rows, columns) / 30)
        hot = np.random.default_rng(3).uniform(size=corner.shape) > 0.999
        return numbers + 60 * corner[..., None] + 3000.0 * hot[..., None]

    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, glow)
    assert codes(compared(capture)) == []


def test_a_shadow_that_is_as_dark_as_the_dark_frame(capture, spoil, compared):
    def shade(numbers):
        numbers[30:60, 40:70] = 256 + np.random.default_rng(1).normal(0, 6, (30, 30, 3))
        return numbers

    spoil(capture / "light_4.tif", shade)
    assert codes(compared(capture)) == []


def test_a_dark_frame_of_eight_bits_that_is_now_0_and_now_1(capture, spoil, compared):
    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, lambda numbers: np.round(numbers / 257) * 257)
    dark = tifffile.imread(capture / "dark.tif")
    noise = np.random.default_rng(2).uniform(size=dark.shape) < 0.4
    tifffile.imwrite(capture / "dark.tif", noise.astype(np.uint16) * 257, photometric="rgb")
    assert codes(compared(capture)) == []
