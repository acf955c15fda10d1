"""Lamps that did not fire."""

import dataclasses

import numpy as np
import pytest

from nlights_core.agreement.comparisons import compare_photographs


@pytest.mark.parametrize("room", [0.001, 0.01])
@pytest.mark.parametrize("kind", ["frame", "flat", "both"])
def test_a_lamp_that_did_not_fire_in_a_lit_room(capture, spoil, compared, room, kind):
    names = {
        "frame": ["light_5.tif"],
        "flat": ["flat/light_5.tif"],
        "both": ["light_5.tif", "flat/light_5.tif"],
    }

    def unlit(numbers):
        # The room lights the artwork as the lamps do on the average.
        return 256 + room * (numbers - 256) + np.random.default_rng(1).normal(0, 5, numbers.shape)

    for name in names[kind]:
        spoil(capture / name, unlit)
    comparison = compared(capture)
    found = [(warning.code, warning.lamps) for warning in comparison.warnings]
    assert found == [("not-fired", ("Relio_5",))] * len(names[kind])
    assert "Relio_5" in comparison.lamps
    assert not comparison.final
    for name, warning in zip(reversed(names[kind]), comparison.warnings, strict=True):
        assert name in warning.sentence
        assert "did not fire" in warning.sentence


def test_two_lamps_that_did_not_fire(sampled, found):
    frames = sampled[0].frames.copy()
    frames[[1, 6]] *= 0.01
    assert found(frames=frames) == [("not-fired", ("Relio_2",)), ("not-fired", ("Relio_7",))]


def test_a_photograph_without_flats(sampled):
    samples, tile = sampled
    frames = samples.frames.copy()
    frames[3] *= 0.01
    alone = dataclasses.replace(samples, frames=frames, flats=None)
    found = compare_photographs(alone, tile.model_copy(update={"flats": None}), None)
    assert [(warning.code, warning.lamps) for warning in found.warnings] == [("not-fired", ("Relio_4",))]


def test_weak_lamps_and_lamps_of_unequal_strength_fired(sampled):
    samples, tile = sampled
    strength = np.array([0.3, 1, 1, 0.4, 2, 1, 1, 0.5], np.float32)[:, None, None]
    assert samples.flats is not None
    uneven = dataclasses.replace(samples, frames=samples.frames * strength, flats=samples.flats * strength)
    assert compare_photographs(uneven, tile, None).warnings == []
    alone = dataclasses.replace(uneven, flats=None)
    assert compare_photographs(alone, tile.model_copy(update={"flats": None}), None).warnings == []
