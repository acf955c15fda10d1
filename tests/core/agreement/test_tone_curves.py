"""Numbers that follow a tone curve that nobody stated."""

import dataclasses

import numpy as np
import pytest

from nlights_core.agreement.comparisons import compare_photographs
from nlights_core.agreement.tone_curves import readings_of_flats, slope_on_computed_light


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def lightness(light):
    return np.where(light <= 216 / 24389, light * 24389 / 2700, 1.16 * np.cbrt(light) - 0.16)


def gamma(power):
    return lambda light: light ** (1 / power)


CURVES = {"sRGB": srgb, "gamma 2.2": gamma(2.2), "gamma 1.8": gamma(1.8), "L*": lightness}


def curved(curve):
    return lambda numbers: 65535 * curve(numbers / 65535)


@pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES)
def test_a_curve_in_every_file(capture, spoil, compared, curve):
    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, curved(curve))
    comparison = compared(capture)
    assert [(warning.code, warning.lamps) for warning in comparison.warnings] == [("tone-curve", ())]
    assert comparison.warnings[0].value < 0.6
    assert "encoding.transfer" in comparison.warnings[0].sentence
    assert comparison.final


@pytest.mark.parametrize("curve", [srgb, gamma(2.2), lightness])
def test_a_curve_in_the_photographs_of_the_artwork_alone(sampled, found, curve):
    samples = sampled[0]
    frames = curve(samples.frames + samples.dark) - curve(samples.dark)
    assert found(frames=frames.astype(np.float32)) == [("tone-curve", ())]


@pytest.mark.parametrize(("albedo", "share"), [(0.1, 0.03), (0.07, 0.02), (0.15, 0.06), (0.2, 0.1)])
def test_light_that_is_half_of_a_dark_photograph_is_no_curve(sampled, albedo, share):
    samples, tile = sampled
    unit = np.median(samples.flats)
    frames = (albedo * samples.frames + share * unit).astype(np.float32)
    spoilt = dataclasses.replace(samples, frames=frames)
    (warning,) = compare_photographs(spoilt, tile, None).warnings
    assert (warning.code, warning.lamps) == ("additive-light", ())
    assert warning.value == pytest.approx(100 * share, rel=0.2)


def test_room_as_bright_as_the_lamps_is_no_curve(sampled):
    samples, tile = sampled
    unit = np.median(samples.flats)
    frames = (samples.frames * (1 + 0.8 * unit / samples.flats)).astype(np.float32)
    (warning,) = compare_photographs(dataclasses.replace(samples, frames=frames), tile, None).warnings
    assert (warning.code, warning.lamps) == ("additive-light", ())


@pytest.mark.parametrize("albedo", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("curve", [gamma(1.8), gamma(2.2)])
def test_a_curve_in_photographs_of_dark_paint_stays_one(sampled, found, curve, albedo):
    frames = curve(albedo * sampled[0].frames)
    assert found(frames=frames.astype(np.float32)) == [("tone-curve", ())]


@pytest.mark.parametrize("curve", [srgb, gamma(2.2), lightness])
def test_a_curve_in_every_file_of_a_dark_artwork(capture, spoil, compared, curve):
    for path in capture.glob("light_*.tif"):
        spoil(path, lambda numbers: 256 + 0.1 * (numbers - 256))
    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, curved(curve))
    assert [warning.code for warning in compared(capture).warnings] == ["tone-curve"]


def test_a_curve_that_was_undone_but_is_not_there(capture, spoil, compared):
    manifest = capture / "artwork.yaml"
    manifest.write_text(manifest.read_text() + "encoding: {transfer: srgb}\n")
    warnings = compared(capture).warnings
    assert [warning.code for warning in warnings] == ["tone-curve"]
    assert warnings[0].value > 1.5
    assert "encoding.transfer: linear" in warnings[0].sentence


def test_a_stated_curve_is_as_good_as_none(capture, spoil, compared):
    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, curved(srgb))
    manifest = capture / "artwork.yaml"
    manifest.write_text(manifest.read_text() + "encoding: {transfer: srgb}\n")
    assert compared(capture).warnings == []


def test_the_slope_of_linear_flats_and_of_a_power_of_them(sampled):
    samples, tile = sampled
    data = readings_of_flats(samples, samples.lamps, tile)
    assert data is not None
    slope, deviation = slope_on_computed_light(data)
    assert slope == pytest.approx(1, abs=0.07)
    assert deviation < 0.02
    for power in (0.5, 1.8):
        given = data.logarithm * power
        scaled, _ = slope_on_computed_light(type(data)(**{**vars(data), "logarithm": given}))
        # The priors of lens and aim know nothing of the power.
        assert scaled == pytest.approx(power * slope, rel=0.06)


def test_without_a_stand_nothing_is_said_of_flats(sampled):
    samples, tile = sampled
    assert readings_of_flats(samples, samples.lamps, tile.model_copy(update={"stand": None})) is None
    assert readings_of_flats(samples, samples.lamps[:2], tile) is None
