"""Stands: the paper's tables, their axes, and what is refused."""

import csv
from pathlib import Path

import numpy as np
import pytest

from nlights_core.configurations import load_stand, shipped, shipped_names
from nlights_core.errors import StandError

TABLES = Path(__file__).parents[3] / "shared" / "data" / "tables"


def table(name: str) -> dict[str, np.ndarray]:
    path = TABLES / name
    if not path.exists():
        pytest.skip(f"{name} of the paper is not beside the project")
    with path.open() as file:
        return {
            row["poi"]: np.array([float(v) for k, v in row.items() if k != "poi"])
            for row in csv.DictReader(file)
        }


@pytest.mark.parametrize(
    ("stand", "name"),
    [
        ("horizontal", "table12_horizontal_poi.csv"),
        ("vertical-dark", "table18_vertical_dark_poi.csv"),
        ("vertical-open", "table19_vertical_open_poi.csv"),
    ],
)
def test_the_shipped_stands_are_the_papers_tables(stand, name):
    measured, ours = table(name), load_stand(stand)
    assert list(ours.lamps) == [poi for poi in measured if poi.startswith("Relio")]
    for lamp, position in ours.lamps.items():
        np.testing.assert_array_equal(position, measured[lamp])
    np.testing.assert_array_equal(ours.camera, measured["Camera"])


def test_table_20_is_the_open_stand_minus_the_dark_one():
    change = table("table20_vertical_poi_change.csv")
    dark, opened = load_stand("vertical-dark"), load_stand("vertical-open")
    for lamp in dark.lamps:
        difference = np.subtract(opened.lamps[lamp], dark.lamps[lamp])
        np.testing.assert_allclose(difference, change[lamp][:3], atol=1.01e-4)
        assert np.linalg.norm(difference) == pytest.approx(change[lamp][3], abs=1e-3)
    # A rotation to the plane frame changes no distance.
    moved = np.linalg.norm(opened.lamp_positions() - dark.lamp_positions(), axis=1)
    np.testing.assert_allclose(moved, [change[lamp][3] for lamp in dark.lamps], atol=1e-3)


def test_the_vertical_stand_maps_to_the_plane_frame():
    stand = load_stand("vertical-dark")
    top = stand.lamp_positions(("Relio_1",))[0]
    np.testing.assert_allclose(top, [10.7631, 601.7119, 225.7121])
    assert stand.camera_position[2] == pytest.approx(1543.8149)


@pytest.mark.parametrize("name", shipped_names("stands"))
def test_every_lamp_stands_where_its_group_says(name):
    positions = load_stand(name).lamp_positions()
    elevation = np.degrees(np.arctan2(positions[:, 2], np.hypot(positions[:, 0], positions[:, 1])))
    assert np.all(np.abs(elevation[:4] - 15) < 7)
    assert np.all(np.abs(elevation[4:] - 45) < 7)


def altered(tmp_path: Path, old: str, new: str) -> Path:
    text = (shipped("stands") / "horizontal.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "stand.yaml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("emitter_size_mm: 60", "emitter_size_mm: 200", ["Relio_1", "five times", "1000 mm"]),
        ("z: Z", "z: -Z", ["not a rotation"]),
        ("x: X", "x: Y", ["not a rotation"]),
        ("z: Z}", "z: W}", ["axes.z", "'Z'"]),
        ("field_mm: [500, 375]", "field_mm: [500, 0]", ["field_mm", "more than 0"]),
        ("uncertainty_mm: 0.77", "uncertainty: 0.77", ["uncertainty", "unknown field"]),
        (
            "Relio_1: [-646.79, 3.0601, 171.98]",
            "Relio_1: [-646.79, 3.0601, -171.98]",
            ["Relio_1", "positive z"],
        ),
        ("half_angle_deg: 12.5", "half_angle_deg: 90", ["half_angle_deg", "less than 90"]),
    ],
)
def test_an_impossible_stand_is_refused_with_the_reason(tmp_path, old, new, words):
    with pytest.raises(StandError) as fault:
        load_stand(str(altered(tmp_path, old, new)))
    for word in words:
        assert word in str(fault.value)


def test_the_lens_of_25_degrees_has_the_known_exponent():
    assert load_stand("horizontal").lamp.exponent == pytest.approx(28.9, abs=0.05)


def test_a_stand_is_read_again_when_its_file_was_changed(tmp_path):
    path = tmp_path / "own.yaml"
    text = (shipped("stands") / "horizontal.yaml").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    first = load_stand(str(path))
    assert load_stand(str(path)) is first
    path.write_text(text.replace("name: horizontal", "name: crosswise"), encoding="utf-8")
    assert (first.name, load_stand(str(path)).name) == ("horizontal", "crosswise")
