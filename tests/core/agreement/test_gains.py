"""Gains of photographs of artworks whose height above the flats' plane, or whose gloss, nobody has told."""

import dataclasses

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.gains import find_gains
from nlights_core.fields import LightField
from nlights_core.reduced_light.relative_light import relate_samples
from nlights_core.simulation.captures import BLACK_LEVEL


def raised(samples, tile, height, number):
    """Samples of an artwork so high above the plane: what a lamp gives there over what it gives on the plane."""
    grid = samples.grid
    lights = LightField(tile.lamps, positions=tile.stand.lamp_positions(tile.lamps))
    low, high = (
        lights.vectors(grid.points(0, grid.rows, np.full((grid.rows, grid.columns), z, np.float32)))[..., 2]
        for z in (0.0, height)
    )
    frames = samples.frames * high / low
    if number is not None:
        frames[number - 1] *= 0.8
    return dataclasses.replace(samples, frames=frames)


def gains_of(samples, tile):
    lights = LightField(tile.lamps, positions=tile.stand.lamp_positions(tile.lamps))
    relative = relate_samples(samples, tile.lamps, lights)
    return [(one.lamps, one.gain) for one in find_gains(relative)]


@pytest.mark.parametrize("height", [-12.0, 10.0, 20.0])
@pytest.mark.parametrize("number", [1, 5, 7])
def test_another_exposure_is_told_of_artworks_above_or_below_the_flats(sampled, height, number):
    samples, tile = sampled
    ((lamps, gain),) = gains_of(raised(samples, tile, height, number), tile)
    assert lamps == (number - 1,)
    assert gain == pytest.approx(0.8, abs=0.03)


@pytest.mark.parametrize("height", [-12.0, 5.0, 10.0])
def test_height_alone_is_no_exposure(sampled, height):
    samples, tile = sampled
    assert gains_of(raised(samples, tile, height, None), tile) == []


@pytest.fixture
def dark_and_glossy(simulated, photographs):
    """Varnish, perhaps stronger, on paint of a tenth of the albedo or another share of it, of a scene."""

    def made(scene, stand="horizontal", gloss=1.0, share=0.1):
        matt, capture = simulated(scene, stand), photographs(scene, stand, True)
        for n in range(1, 9):
            paint = tifffile.imread(matt / f"light_{n}.tif").astype(np.float32) - BLACK_LEVEL
            capture.change(
                f"light_{n}.tif", lambda light, paint=paint: gloss * light - (gloss - share) * paint
            )
        return capture

    return made


@pytest.mark.parametrize("scene", ["painting", "drawing", "plane"])
def test_varnish_on_dark_paint_is_no_exposure(dark_and_glossy, scene):
    assert [w.code for w in dark_and_glossy(scene).said() if w.code == "exposure"] == []


@pytest.mark.parametrize(
    ("scene", "stand", "number"),
    [
        ("painting", "horizontal", 5),
        ("relief", "vertical-dark", 6),
        ("drawing", "horizontal", 1),
        ("plane", "horizontal", 8),
    ],
)
def test_another_exposure_is_told_under_varnish_on_dark_paint(dark_and_glossy, scene, stand, number):
    capture = dark_and_glossy(scene, stand)
    capture.change_frames(lambda light: 0.8 * light, number)
    (warning,) = [w for w in capture.said() if w.code == "exposure"]
    assert warning.lamps == (f"Relio_{number}",)
    assert warning.value == pytest.approx(-20, abs=4)


@pytest.mark.parametrize("number", [None, 6])
def test_another_exposure_is_told_by_the_colour_of_paint_where_gloss_hides_it(dark_and_glossy, number):
    capture = dark_and_glossy("painting", "vertical-dark", gloss=2, share=0.15)
    if number is not None:
        capture.change_frames(lambda light: 0.8 * light, number)
    found = [(w.lamps, w.value) for w in capture.said() if w.code == "exposure"]
    expected = [] if number is None else [((f"Relio_{number}",), pytest.approx(-20, abs=4))]
    assert found == expected


@pytest.mark.parametrize("scene", ["painting", "plane"])
def test_two_photographs_at_another_exposure_are_not_told_as_one(photographs, scene):
    capture = photographs(scene)
    capture.change_frames(lambda light: 0.7 * light, 3, 7)
    named = {lamp for w in capture.said() if w.code == "exposure" for lamp in w.lamps}
    assert named in ({"Relio_3", "Relio_7"}, set())
