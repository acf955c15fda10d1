"""Warnings come back from their file as they were, and are plain values for other programs."""

import json

from nlights_core.capture_warnings import FILE, CaptureWarning, read_warnings, write_warnings

MOVED = CaptureWarning("moved", "light_2.tif: frames.N45 lies 2.1 px lower.", ("N45",), 2.1, "px")


def test_warnings_come_back_as_they_were(tmp_path):
    write_warnings(tmp_path, [MOVED, CaptureWarning("odd", "Something.")])
    assert read_warnings(tmp_path) == [MOVED, CaptureWarning("odd", "Something.")]


def test_a_program_reads_lists_and_numbers(tmp_path):
    write_warnings(tmp_path, [MOVED])
    (record,) = json.loads((tmp_path / FILE).read_text())
    assert record == {
        "code": "moved",
        "sentence": MOVED.sentence,
        "lamps": ["N45"],
        "value": 2.1,
        "unit": "px",
    }


def test_a_folder_without_the_file_has_no_warnings(tmp_path):
    assert read_warnings(tmp_path) == []
