"""What is kept of earlier nights: the newest numbers of each stand, and how long tiles took."""

import json
import tracemalloc

from nlights_flows.nights.earlier import TIMED, earlier_nights
from nlights_flows.nights.record import ArtworkEntry, NightRecord, TileEntry
from nlights_flows.nights.trends import CAPTURES


def write_night(out, number, tiles, stand="horizontal", recipe="default"):
    """The record of a night of so many artworks of one tile each, as the night itself writes it."""
    name = f"2026-03-{number:02d}"
    record = NightRecord(name, name, "", "", "", recipe, f"{name}T20:00:00+01:00")
    for i in range(tiles):
        numbers = {f"Flat level, {lamp}": {"value": 20.0 + lamp, "unit": "%"} for lamp in range(8)}
        rows = [
            {"name": f"number {row}", "value": row / 7, "unit": "%", "verdict": "ok"} for row in range(20)
        ]
        found = {"stand": stand, "flats": f"flats {number} {i}", "numbers": numbers}
        tile = TileEntry("r0c0", "done", "", float(number), 1.5, numbers=rows, measured=found)
        record.artworks.append(ArtworkEntry(f"inv-{i}", "", f"inv-{i}", "done", tiles=[tile]))
    folder = out / "nights" / name
    folder.mkdir(parents=True)
    (folder / "night.json").write_text(json.dumps(record.as_json()))


def test_the_newest_captures_of_each_stand_and_times_are_kept_in_their_order(tmp_path):
    write_night(tmp_path, 1, 3, stand="vertical")
    for number in range(2, 10):
        write_night(tmp_path, number, 8, recipe="default" if number % 2 else "other")
    kept = earlier_nights(tmp_path, "default", but="2026-03-09")
    assert [one["stand"] for one in kept.captures] == ["horizontal"] * CAPTURES + ["vertical"] * 3
    assert kept.captures[0] == {
        "stand": "horizontal",
        "flats": "flats 8 7",
        "numbers": {f"Flat level, {lamp}": {"value": 20.0 + lamp, "unit": "%"} for lamp in range(8)},
        "night": "2026-03-08",
        "artwork": "inv-7",
    }
    assert kept.timed == [(1.5, 7.0)] * 8 + [(1.5, 5.0)] * 8 + [(1.5, 3.0)] * 8 + [(1.5, 1.0)] * 3


def test_records_of_other_shapes_are_passed_by(tmp_path):
    write_night(tmp_path, 1, 1)
    for i, text in enumerate(
        ("", "[]", "null", '{"schema": 1}', '{"schema": 1, "artworks": 3, "started": 1}', "[" * 9999)
    ):
        (tmp_path / "nights" / f"2026-04-0{i + 1}").mkdir()
        (tmp_path / "nights" / f"2026-04-0{i + 1}" / "night.json").write_text(text)
    assert len(earlier_nights(tmp_path, "default").captures) == 1


def test_what_is_kept_does_not_grow_with_the_nights(tmp_path):
    for number in range(1, 7):
        write_night(tmp_path, number, 300)
    size = (tmp_path / "nights" / "2026-03-01" / "night.json").stat().st_size
    tracemalloc.start()
    kept = earlier_nights(tmp_path, "default")
    left, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(kept.timed) == TIMED
    # Six nights hold 1800 tiles; less is kept than a single one's file takes.
    assert left < size / 2
