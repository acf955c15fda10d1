"""Numbers of a calibration: what was found, what was not measured, and what is warned of."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.record import Known
from nlights_core.calibration.unknowns import nothing
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.report.figures import Number
from nlights_core.report.writing import doubting_only_unexplained

UNCERTAINTY = np.array([np.full((3, 4), 0.02), np.full((3, 4), 0.001)], np.float32)
SOUND_CAPTURE = Known(replace(nothing(3), level=0.5), 0.04, (), 0.0002, False, 0.0, 0.0)


def changed(**values):
    """A sound capture with other values, of what is shared or of the rest."""
    shared = {name: value for name, value in values.items() if hasattr(SOUND_CAPTURE.shared, name)}
    rest = {name: value for name, value in values.items() if name not in shared}
    return replace(SOUND_CAPTURE, shared=replace(SOUND_CAPTURE.shared, **shared), **rest)


def numbers(known, uncertainty=UNCERTAINTY):
    return {number.name: number for number in of_calibration(known, uncertainty)}


def test_a_sound_capture_has_its_level_and_no_warning():
    found = numbers(SOUND_CAPTURE)
    assert (found["Mean level"].value, found["Uncertainty of the level"].value) == (0.5, 0.04)
    assert found["Uncertainty of the height"].value == pytest.approx(0.02)
    assert {name: n.value for name, n in found.items() if n.group in ("Light", "Surface")} == {
        "Drift of the lamps since the flats": 0,
        "Light that the dark frame lacks": 0,
        "Light of the room": 0,
        "Lamps' distance from the stand's file, per axis": None,
        "Gloss": 0,
        "Roughness of the gloss": None,
        "Departure from Lambert's law": 0,
        "Gloss of the flat": 0,
        "Smooth residual": pytest.approx(0.02),
        "Other material": 0,
        "Rays that miss the flat": 0,
    }
    assert not any(number.warning for number in found.values())


def test_a_residual_that_noise_explains_is_no_misfit():
    assert not any(number.warning for number in numbers(changed(residual=0.0012)).values())


def test_the_numbers_are_the_same_without_a_calibration_and_none_is_measured():
    without = of_calibration(None, None)
    assert [n.name for n in without] == list(numbers(SOUND_CAPTURE))
    assert {(n.value, n.missing, n.warning) for n in without} == {(None, "not measured", "")}


def test_a_level_that_was_not_measured_is_no_number():
    found = numbers(changed(level_uncertainty=None))
    assert found["Mean level"].value is None
    assert found["Uncertainty of the level"].value is None


def test_what_was_found_is_stated_in_units_that_people_know():
    gloss = np.zeros_like(nothing(3).gloss)
    gloss[[2, 4]] = 0.5, 0.25
    found = numbers(
        changed(
            strengths=np.log([1.01, 0.99, 1.0]), gloss=gloss, departure=0.3, additive=0.001, room=0.002,
            strange=0.2,
        )
    )  # fmt: skip
    values = {name: number.value for name, number in found.items()}
    assert values["Drift of the lamps since the flats"] == pytest.approx(2.0)
    assert values["Gloss"] == pytest.approx(3.0)
    assert values["Roughness of the gloss"] == pytest.approx(0.15 ** (2 / 3) * 0.4 ** (1 / 3))
    assert values["Departure from Lambert's law"] == 0.3
    assert values["Light that the dark frame lacks"] == pytest.approx(0.1)
    assert values["Light of the room"] == pytest.approx(0.2)
    assert values["Other material"] == pytest.approx(20)


FLAT_GLOSS = np.zeros_like(nothing(3).flat_gloss)
FLAT_GLOSS[1] = 0.5


@pytest.mark.parametrize(
    ("values", "code", "words"),
    [
        ({"strengths": np.log([1.02, 0.99, 1.0])}, "drift", "changed by 3.0 %"),
        ({"additive": 0.01}, "additive-light", "1.0 % of light that the dark frame lacks"),
        ({"flat_gloss": FLAT_GLOSS}, "flat-gloss", "highlights of 2.0 %"),
        ({"residual": 0.0012, "misfit": True}, "model-misfit", "0.12 % in patches"),
        ({"unreached": 0.004}, "flat-reach", "0.4 % of the lamps' rays"),
    ],
)
def test_what_is_wrong_with_a_capture_is_told_with_its_code(values, code, words):
    told = [number for number in numbers(changed(**values)).values() if number.warning]
    assert [number.code for number in told] == [code]
    assert words in told[0].warning


def test_lamps_that_stand_elsewhere_are_warned_of_with_their_distance():
    number = numbers(changed(positions=3.94))["Lamps' distance from the stand's file, per axis"]
    assert (number.value, number.unit, number.code) == (3.94, "mm", "lamp-positions")
    assert "stand some 3.9 mm (per axis)" in number.warning
    # Photographs that moved look like it too; there the model does not fit.
    assert not numbers(changed(positions=3.94, misfit=True))[number.name].warning


@pytest.mark.parametrize(
    ("seen", "measured", "left"),
    [
        ((), (), {"stand", "lamp-positions"}),
        (("exchanged",), (), set()),
        ((), ("drift",), {"drift", "lamp-positions"}),
        (("moved",), (), {"stand", "lamp-positions"}),
    ],
)
def test_the_stand_is_doubted_only_where_nothing_else_explains_it(seen, measured, left):
    warned = [
        Number("Light", code, 1.0, "mm", "", warning="is wrong", code=code)
        for code in ("stand", "lamp-positions", *measured)
    ]
    photographs = [CaptureWarning(code, "is wrong") for code in seen]
    kept = doubting_only_unexplained(warned, photographs)
    assert {number.code for number in kept if number.warning} == left
    assert len(kept) == len(warned)
