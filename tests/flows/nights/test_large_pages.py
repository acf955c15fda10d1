"""A page stays readable, and of a bounded size, whatever became of very many tiles."""

import re

import pytest

from nlights_flows.nights.page import MOST, write_pages
from nlights_flows.nights.record import ArtworkEntry, NightRecord, TileEntry

WARNING = {"code": "x", "sentence": "The dark frame is bright."}
ROW = {
    "name": "Mean normal",
    "value": 9.0,
    "unit": "degrees",
    "limit": "Mean normal",
    "verdict": "fail",
    "smallest": False,
    "warn": 5.0,
    "fail": 8.0,
}


def page_of(tmp_path, tiles, state):
    """The page of a night of artworks of ten tiles each; every list of it is as long as it can be."""
    record = NightRecord(
        "2026-03-02", "2026-03-02", "in", "out", "store", "default", "2026-03-02T20:00:00+01:00"
    )
    for i in range(tiles // 10):
        entries = [
            TileEntry(f"t{j}", state, "why", 1.0, 1.5, [ROW], "fail", [WARNING], notes=["kept"])
            for j in range(10)
        ]
        record.artworks.append(ArtworkEntry(f"inv-{i}", "", f"inv-{i}", state, tiles=entries))
        record.artworks.append(ArtworkEntry("", "", f"up-{i}", "waiting", "the upload may not be finished"))
    folder = tmp_path / "nights" / "2026-03-02"
    folder.mkdir(parents=True, exist_ok=True)
    write_pages(record, folder, tmp_path)
    return (tmp_path / "night.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("state", ["done", "failed", "left", "unchanged"])
def test_a_page_grows_no_more_from_300_tiles_on(tmp_path, state):
    small, large = (len(page_of(tmp_path, tiles, state)) for tiles in (MOST, 5000))
    # Five lists say how many more there are, numbers have more digits, and 200 folders more wait.
    assert large < 1.15 * small + 270 * 200


def test_what_is_left_out_is_counted(tmp_path):
    text = page_of(tmp_path, 1000, "done")
    assert len(re.findall('<section class="tile">', text)) == MOST
    assert f"And {1000 - MOST} tiles more; night.json" in text
    assert f"And {1000 - MOST} more; night.json" in text
    assert "more; night.json" not in page_of(tmp_path, MOST, "done")
    assert "100 artworks finished before" in page_of(tmp_path, 1000, "unchanged")
