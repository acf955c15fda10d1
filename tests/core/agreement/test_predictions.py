"""Faults of single photographs, and sound captures of which nothing may be said."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from nlights_core.agreement import examination
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField


def dim(share):
    return lambda light: share * light


@pytest.mark.parametrize(("scene", "number"), [("painting", 1), ("relief", 6), ("plane", 4)])
def test_one_photograph_at_another_exposure_is_told(photographs, scene, number):
    capture = photographs(scene)
    capture.change_frames(dim(0.8), number)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps, warning.unit) == ("exposure", (f"Relio_{number}",), "%")
    assert warning.value == pytest.approx(-20, abs=1.5)
    assert f"light_{number}.tif (lamp Relio_{number}): is 20 % darker" in warning.sentence


def test_a_flat_at_another_exposure_is_told_by_its_lamp(photographs):
    capture = photographs("drawing")
    capture.change("flat/light_3.tif", dim(0.5))
    (warning,) = capture.said()
    assert (warning.code, warning.lamps) == ("exposure", ("Relio_3",))
    assert warning.value == pytest.approx(100, abs=5)


def test_another_exposure_from_one_photograph_on_is_told_of_the_fewer(photographs):
    capture = photographs("painting")
    capture.change_frames(dim(0.7), 6, 7, 8)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps) == ("exposure", ("Relio_6", "Relio_7", "Relio_8"))
    assert warning.value == pytest.approx(-30, abs=3)


def test_without_flats_the_lamps_strengths_are_not_known(photographs):
    capture = photographs("painting")
    capture.change_frames(dim(0.8), 1)
    assert capture.said(capture.tile.model_copy(update={"flats": None})) == []


@pytest.mark.parametrize(
    ("scene", "stand", "varnish"),
    [("painting", "horizontal", False), ("relief", "vertical-open", False), ("drawing", "horizontal", True)],
)
def test_light_in_the_photographs_alone_is_told(photographs, scene, stand, varnish):
    capture = photographs(scene, stand, varnish)
    flats = [tifffile.imread(path) for path in (capture.folder / "flat").glob("*.tif")]
    albedo = tifffile.imread(capture.folder / "truth" / "albedo.tif")
    room = 0.03 * float(np.median(flats)) * albedo / 0.9
    capture.change_frames(lambda light: light + room)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps, warning.unit) == ("additive-light", (), "%")
    assert warning.value == pytest.approx(3, abs=0.8)


def test_light_in_all_photographs_is_told_once_exchanged_ones_are_mended(photographs, monkeypatch):
    """The lamps that an exchange leaves tell such light from gloss no more."""
    capture = photographs("painting")
    additive = CaptureWarning("additive-light", "light in all", value=3.0, unit="%")
    odd = CaptureWarning("odd", "agrees with no other", lamps=("Relio_1",))
    monkeypatch.setattr(examination, "compare_with_predictions", lambda *_: [additive, odd])
    stand, tile = capture.tile.stand, capture.tile
    lights = LightField(tile.lamps, positions=stand.lamp_positions())
    frames = tile.frames | {"Relio_2": tile.frames["Relio_5"], "Relio_5": tile.frames["Relio_2"]}
    for one, codes in (
        (tile, ["additive-light", "odd"]),
        (tile.model_copy(update={"frames": frames}), ["exchanged", "odd"]),
    ):
        found = examination.examine_photographs(one, lights, True, capture.folder)
        assert [warning.code for warning in found] == codes


@pytest.mark.parametrize(("scene", "number"), [("painting", 2), ("drawing", 7), ("painting", 5)])
def test_a_blurred_photograph_is_told(photographs, scene, number):
    capture = photographs(scene)
    capture.change_frames(lambda light: gaussian_filter(light, (2, 2, 0)), number)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps, warning.unit) == ("blur", (f"Relio_{number}",), "%")
    assert 20 < warning.value < 60


@pytest.mark.parametrize("scene", ["painting", "relief"])
def test_a_photograph_with_two_lamps_lit_is_odd(photographs, scene):
    capture = photographs(scene)
    other = tifffile.imread(capture.folder / "light_5.tif").astype(np.float32)
    capture.change_frames(lambda light: 0.5 * (light + other), 2)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps) == ("odd", ("Relio_2",))


@pytest.mark.parametrize("scene", ["painting", "drawing", "relief", "plane"])
@pytest.mark.parametrize(("stand", "varnish"), [("horizontal", True), ("vertical-dark", False)])
def test_nothing_is_said_of_sound_captures_with_drift_and_noise(photographs, scene, stand, varnish):
    capture, random = photographs(scene, stand, varnish), np.random.default_rng(8)
    assert capture.said() == []
    for n in range(1, 9):
        gain = 1 + 0.01 * random.standard_normal()
        noise = random.standard_normal((*tifffile.imread(capture.folder / "dark.tif").shape,)) * 300
        capture.change_frames(lambda light, gain=gain, noise=noise: gain * light + noise, n)
    assert capture.said() == []


def test_nothing_is_said_of_dust_on_the_flat_dark_paint_saturation_and_a_mask(photographs):
    capture, random = photographs("painting"), np.random.default_rng(4)
    rows, columns = np.mgrid[:180, :240]
    dust = np.ones((180, 240, 1))
    for y, x in zip(random.uniform(0, 180, 60), random.uniform(0, 240, 60), strict=True):
        dust[..., 0] *= 1 - 0.4 * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 4)
    for n in range(1, 9):
        capture.change(f"flat/light_{n}.tif", lambda light: light * dust)
    dark_paint = np.where(columns[..., None] < 120, 0.1, 1.0)
    capture.change_frames(lambda light: light * dark_paint)
    assert capture.said() == []

    def burnt(light):
        light[20:60, 150:200] = 1e6
        return light

    capture.change_frames(burnt, 2, 3)
    mask = np.zeros((180, 240), np.uint8)
    mask[:, 60:] = 255
    tifffile.imwrite(capture.folder / "mask.tif", mask)
    tile = capture.tile.model_copy(update={"mask": capture.folder / "mask.tif"})
    assert capture.said(tile) == []


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_few_lamps_say_nothing_wrong(photographs, count):
    capture = photographs("painting")
    tile = capture.tile
    few = {
        "frames": dict(list(tile.frames.items())[-count:]),
        "flats": dict(list(tile.flats.items())[-count:]),
    }
    assert capture.said(tile.model_copy(update=few)) == []


def test_many_lamps_are_compared_too(photographs):
    capture = photographs("relief")
    tile, positions = capture.tile, capture.tile.stand.lamp_positions()
    names = [f"{lamp}_{k}" for k in range(4) for lamp in tile.lamps]
    of = [lamp for _ in range(4) for lamp in tile.lamps]
    many = {
        "frames": {name: tile.frames[lamp] for name, lamp in zip(names, of, strict=True)},
        "flats": {name: tile.flats[lamp] for name, lamp in zip(names, of, strict=True)},
    }
    lights = LightField(tuple(names), positions=np.concatenate([positions] * 4))
    assert capture.said(tile.model_copy(update=many), lights) == []
