"""Damaged records among products, and of nights: a sentence, never a traceback, never taken for good."""

import json
import shutil
from pathlib import Path

import pytest

from nlights_core.capture_warnings import read_warnings
from nlights_core.errors import NlightsError
from nlights_flows.nights.limits import load_limits
from nlights_flows.nights.numbers import DAMAGED, look_at_products
from nlights_flows.nights.order import Order
from nlights_flows.nights.record import TileEntry
from nlights_flows.nights.review import review_tile
from nlights_flows.nights.running import run_here, run_night
from nlights_flows.tiles.records import read_provenance, read_quality
from nlights_flows.tiles.run_options import RunOptions

ROW = b'[{"group": "Light", "name": "Saturated", "unit": "%% of pixels", "value": %s}]'
DAMAGE = {
    "empty": b"",
    "zeros": b"\0" * 300,
    "cut": b'[{"code": "low-light", "sentence": "too da',
    "not UTF-8": b'["\xff\xfe"]',
    "nested": b"[" * 9999,
    "null": b"null",
    "a number": b"3",
    "other things": b"[3]",
    "no fields": b"[{}]",
}


@pytest.fixture(scope="module")
def spent(upload, nlights, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    for name in ("inv-1", "inv-2"):
        upload(folder / "inbox", name)
    nlights("nightly", folder / "inbox", "--out", folder / "out")
    return folder


@pytest.fixture
def folder(spent, tmp_path) -> Path:
    """A copy in which a test may damage things; products are copies, so the store stays whole."""
    return Path(shutil.copytree(spent, tmp_path / "copy"))


def damage(path: Path, text: bytes) -> None:
    path.unlink()
    path.write_bytes(text)


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("name", ["quality.json", "warnings.json", "provenance.json"])
def test_a_damaged_product_is_told_by_a_review_and_put_right_by_a_night(folder, name, kind):
    out = folder / "out"
    damage(out / "inv-1" / "r0c0" / name, DAMAGE[kind])
    found = review_tile(out / "inv-1" / "r0c0", load_limits())
    assert found.state == "open"
    assert found.entry.warnings[-1]["code"] == DAMAGED
    assert name in found.reasons[-1]
    record = run_night(Order(folder / "inbox", RunOptions(out=out)), run_here)
    assert [artwork.state for artwork in record.artworks] == ["unchanged", "unchanged"]
    (tile,) = record.artworks[0].tiles
    # The store is whole, so that they are published anew.
    assert tile.warnings == []
    assert read_provenance(out / "inv-1" / "r0c0")["artwork"] == "inv-1"
    there, sound = (
        json.loads((out / id / "r0c0" / name).read_text(encoding="utf-8")) for id in ("inv-1", "inv-2")
    )
    assert type(there) is type(sound)
    assert len(there) == len(sound)
    assert record.ended


@pytest.mark.parametrize("value", [b"NaN", b"Infinity", b"-Infinity", b"1e999", b"true", b'"0"', b"[]"])
def test_a_value_that_is_no_number_is_never_within_its_limits(tmp_path, value):
    (tmp_path / "quality.json").write_bytes(ROW % value)
    with pytest.raises(NlightsError, match=r"quality\.json: is damaged"):
        read_quality(tmp_path)
    found = review_tile(tmp_path, load_limits())
    assert found.entry.verdict is None
    assert found.state == "open"


def test_what_was_not_measured_is_no_damage(tmp_path):
    (tmp_path / "quality.json").write_bytes(ROW % b"null")
    assert read_quality(tmp_path)[0]["value"] is None
    assert read_warnings(tmp_path) == []


def test_numbers_are_shown_of_whole_tiles_and_the_others_are_named(folder, nlights):
    out = folder / "out"
    damage(out / "inv-1" / "r0c0" / "quality.json", b"{")
    done = nlights("report", out, code=1)
    assert "inv-1/r0c0/quality.json: is damaged" in done.stderr
    assert "inv-2/r0c0" in done.stdout
    damage(out / "inv-2" / "r0c0" / "quality.json", b"[[]]")
    done = nlights("report", out, code=2)
    assert done.stdout == ""
    assert "no numbers can be shown" in done.stderr


def test_a_damaged_product_that_stays_is_a_warning_of_its_tile(folder):
    out = folder / "out"
    damage(out / "inv-1" / "r0c0" / "warnings.json", b"[{")
    entry = TileEntry("r0c0")
    look_at_products(entry, out / "inv-1" / "r0c0", load_limits())
    assert [warning["code"] for warning in entry.warnings] == [DAMAGED]
    assert "warnings.json: is damaged" in entry.warnings[0]["sentence"]


def test_a_run_over_damaged_warnings_puts_them_right(folder, nlights):
    path = folder / "out" / "inv-1" / "r0c0" / "warnings.json"
    before = path.read_bytes()
    damage(path, b"[{")
    done = nlights("digitise", folder / "inbox" / "inv-1", "--out", folder / "out")
    assert "damaged" not in done.stderr
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_records_of_nights_do_not_end_the_next(folder, kind):
    out = folder / "out"
    for path in (out / "night.json", *out.glob("nights/2*/night.json")):
        path.write_bytes(DAMAGE[kind])
    record = run_night(Order(folder / "inbox", RunOptions(out=out)), run_here)
    assert [artwork.state for artwork in record.artworks] == ["unchanged", "unchanged"]
    assert json.loads((out / "night.json").read_text())["ended"]


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_limits_are_a_sentence(tmp_path, kind):
    (tmp_path / "limits.yaml").write_bytes(DAMAGE[kind])
    with pytest.raises(NlightsError, match=r"limits\.yaml"):
        load_limits(str(tmp_path / "limits.yaml"))
