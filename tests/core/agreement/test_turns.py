"""Photographs that were turned or mirrored."""

import dataclasses

import numpy as np
import pytest

from nlights_core.agreement.comparisons import compare_photographs
from nlights_core.agreement.turns import WAYS, likeliest_way


@pytest.mark.parametrize("lamp", range(8))
def test_one_photograph_turned_by_180_degrees(sampled, found, lamp):
    samples = sampled[0]
    frames = samples.frames.copy()
    frames[lamp] = frames[lamp, ::-1, ::-1]
    assert found(frames=frames) == [("turned", (samples.lamps[lamp],))]


def test_the_turned_file_is_named(capture, spoil, compared):
    spoil(capture / "light_4.tif", lambda numbers: numbers[::-1, ::-1])
    comparison = compared(capture)
    assert [(warning.code, warning.lamps) for warning in comparison.warnings] == [("turned", ("Relio_4",))]
    sentence = comparison.warnings[0].sentence
    assert sentence.startswith("light_4.tif (lamp Relio_4) is turned by 180 degrees")
    assert "export it again" in sentence
    assert comparison.lamps == {"Relio_4"}


@pytest.mark.parametrize("way", [way for way in WAYS if way.startswith("mirrored")])
def test_a_mirrored_photograph(sampled, way):
    samples, tile = sampled
    frames = samples.frames.copy()
    frames[6] = frames[(6, *WAYS[way])]
    found = compare_photographs(dataclasses.replace(samples, frames=frames), tile, None).warnings
    assert [warning.lamps for warning in found] == [("Relio_7",)]
    assert f"is {way}" in found[0].sentence


def test_a_flat_turned_by_180_degrees(sampled):
    samples, tile = sampled
    flats = samples.flats.copy()
    flats[2] = flats[2, ::-1, ::-1]
    found = compare_photographs(dataclasses.replace(samples, flats=flats), tile, None).warnings
    assert [(warning.code, warning.lamps) for warning in found] == [("turned", ("Relio_3",))]
    assert found[0].sentence.startswith("flat/light_3.tif (lamp Relio_3)")


def test_two_turned_photographs_and_an_exchanged_pair(sampled, found):
    frames = sampled[0].frames[[0, 1, 2, 3, 6, 5, 4, 7]]
    frames[0] = frames[0, ::-1, ::-1]
    assert sorted(found(frames=frames)) == [("exchanged", ("Relio_5", "Relio_7")), ("turned", ("Relio_1",))]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("kind", "words"), [("frames", "photographs of the artwork"), ("flats", "flats")])
def test_a_whole_set_turned_against_the_other(sampled, kind, words, way):
    samples, tile = sampled
    turned = getattr(samples, kind)[(slice(None), *WAYS[way])]
    found = compare_photographs(dataclasses.replace(samples, **{kind: turned}), tile, None)
    assert [(warning.code, warning.lamps) for warning in found.warnings] == [("turned", samples.lamps)]
    assert f"all {words} are {way}" in found.warnings[0].sentence
    assert found.final


def test_photographs_and_flats_turned_against_the_stand(sampled):
    samples, tile = sampled
    both = {"frames": samples.frames[:, ::-1, ::-1], "flats": samples.flats[:, ::-1, ::-1]}
    found = compare_photographs(dataclasses.replace(samples, **both), tile, None)
    assert [warning.code for warning in found.warnings] == ["turned"]
    assert "against the stand" in found.warnings[0].sentence
    # On this stand the lamps' opposites explain it as well, and that is said.
    assert "lamps are listed in another order" in found.warnings[0].sentence


def test_without_flats_the_pattern_of_the_artwork_tells(sampled):
    samples, tile = sampled
    tile = tile.model_copy(update={"flats": None, "stand": None})
    alone = dataclasses.replace(samples, flats=None)
    assert compare_photographs(alone, tile, None).warnings == []
    frames = samples.frames.copy()
    frames[1] = frames[1, ::-1, ::-1]
    found = compare_photographs(dataclasses.replace(alone, frames=frames), tile, None).warnings
    assert [(warning.code, warning.lamps) for warning in found] == [("turned", ("Relio_2",))]


def test_a_sphere_has_no_pattern_that_could_be_turned(sampled):
    samples, tile = sampled
    y, x = np.mgrid[1:-1:120j, -1.3:1.3:160j]
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    azimuth = np.radians([0, 30, 60, 90, 120, 200, 250, 300])
    lit = np.stack([0.5 * (x * np.cos(a) + y * np.sin(a)) + 0.87 * z for a in azimuth])
    noise = np.random.default_rng(2).normal(1, 0.003, lit.shape)
    frames = np.where((z > 0.3) & (lit > 0.02), 0.6 * lit * noise, np.nan).astype(np.float32)
    sphere = dataclasses.replace(samples, frames=frames, flats=None)
    tile = tile.model_copy(update={"flats": None, "stand": None})
    assert compare_photographs(sphere, tile, None).warnings == []


def test_a_half_turn_is_likelier_than_a_mirror():
    half, left, top = WAYS
    assert likeliest_way({half: 0.2, left: 0.17, top: 1}) == half
    assert likeliest_way({half: 0.2, left: 0.1, top: 1}) == left
    assert likeliest_way({half: np.nan, left: np.nan, top: 0.1}) == top
