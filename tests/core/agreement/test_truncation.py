"""Files that end before the picture does."""

import shutil

import numpy as np
import pytest
import yaml

from nlights_core.agreement.truncation import zero_share


def without_end(share):
    def change(numbers):
        numbers[round(len(numbers) * (1 - share)) :] = 0
        return numbers

    return change


@pytest.mark.parametrize(
    ("name", "lamps", "words"),
    [
        ("light_3.tif", ("Relio_3",), "light_3.tif (lamp Relio_3): its last 5.0% of rows are zero"),
        ("flat/light_6.tif", ("Relio_6",), "light_6.tif (lamp Relio_6)"),
        ("dark.tif", (), "dark.tif (the dark frame)"),
    ],
)
def test_the_last_5_percent_of_a_file_are_zero(capture, spoil, compared, name, lamps, words):
    spoil(capture / name, without_end(0.05))
    warnings = compared(capture).warnings
    assert [(warning.code, warning.lamps) for warning in warnings] == [("truncated", lamps)]
    assert words in warnings[0].sentence
    assert "copy the file again" in warnings[0].sentence
    assert warnings[0].value == pytest.approx(5, abs=0.5)


def test_a_dark_frame_of_which_half_is_missing_ends_the_search(capture, spoil, compared):
    spoil(capture / "dark.tif", without_end(0.5))
    comparison = compared(capture)
    assert [(warning.code, warning.lamps) for warning in comparison.warnings] == [("truncated", ())]
    assert comparison.final


def test_two_truncated_files_and_one_half_of_a_file(capture, spoil, compared):
    spoil(capture / "light_1.tif", without_end(0.4))
    spoil(capture / "light_8.tif", without_end(0.02))
    warnings = compared(capture).warnings
    assert [(warning.code, warning.lamps[0]) for warning in warnings] == [
        ("truncated", "Relio_1"),
        ("truncated", "Relio_8"),
    ]


def test_the_end_is_seen_where_the_mask_is_not(capture, spoil, compared):
    shutil.copy(capture / "dark.tif", capture / "mask.tif")
    spoil(capture / "mask.tif", without_end(0.5))
    spoil(capture / "mask.tif", lambda numbers: 65535 * (numbers > 0))
    manifest = yaml.safe_load((capture / "artwork.yaml").read_text()) | {"mask": "mask.tif"}
    (capture / "artwork.yaml").write_text(yaml.safe_dump(manifest))
    spoil(capture / "light_3.tif", without_end(0.1))
    assert [warning.code for warning in compared(capture).warnings] == ["truncated"]


def test_rows_that_are_black_in_every_file_are_a_border(capture, spoil, compared):
    for path in [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]:
        spoil(path, without_end(0.05))
    assert compared(capture).warnings == []


def test_a_shadow_fades_but_a_file_ends():
    rows, lit = np.full(100, 0.3), np.full(100, 0.3)
    rows[70:90] = 0.3 * 0.7 ** np.arange(1, 21)
    rows[90:] = 0
    assert zero_share(rows, lit, lit) == 0
    rows[70:90] = 0.3
    assert zero_share(rows, lit, lit) == pytest.approx(0.1)
    assert zero_share(lit, lit, lit) == 0
    assert zero_share(np.zeros(100), lit, lit) == 0
