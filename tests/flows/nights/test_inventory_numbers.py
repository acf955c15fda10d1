"""A number as museums write it, through nights: its folder, its links, and what it stood for before."""

import json
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate
from nlights_flows.commands.cli import app
from nlights_flows.nights.inbox import scan
from nlights_flows.nights.order import Order
from nlights_flows.nights.running import run_here, run_night
from nlights_flows.tiles.run_options import RunOptions

NUMBER = "MS. Bodl. 264/3 [fol. 7]"
FOLDER = "MS. Bodl. 264%2F3 %5Bfol. 7%5D"


def upload(inbox: Path, name: str, number: str, seed: int) -> Path:
    folder = inbox / name
    simulate(folder, load_stand("horizontal"), scene="painting", width=64, seed=seed)
    manifest = folder / "artwork.yaml"
    lines = manifest.read_text(encoding="utf-8").splitlines()
    kept = "\n".join(
        line for line in lines if "id:" not in line and "title:" not in line and "artwork:" not in line
    )
    manifest.write_text(f"artwork: {{id: {json.dumps(number)}}}\n{kept}\n", encoding="utf-8")
    (folder / "upload-complete").touch()
    return folder


def night(place: Path) -> dict:
    options = RunOptions(recipe="psbox", out=place / "out")
    return run_night(Order(place / "inbox", options), run_here).as_json()


@pytest.fixture(scope="module")
def nights(tmp_path_factory) -> tuple[Path, dict, dict]:
    """Two nights; before the second the number was given to other photographs."""
    place = tmp_path_factory.mktemp("nights")
    first = upload(place / "inbox", "a", NUMBER, 1)
    before = night(place)
    shutil.rmtree(first)
    upload(place / "inbox", "b", NUMBER, 2)
    return place, before, night(place)


def test_the_folder_has_the_numbers_name_and_the_record_the_number(nights):
    place, before, _ = nights
    (artwork,) = before["artworks"]
    assert (artwork["artwork"], artwork["state"]) == (NUMBER, "done")
    assert artwork["tiles"][0]["products"] == f"{FOLDER}/r0c0"
    assert unquote(FOLDER) == NUMBER
    made = json.loads((place / "out" / FOLDER / "r0c0" / "provenance.json").read_text(encoding="utf-8"))
    assert made["artwork"] == NUMBER
    assert {stage["artwork"] for stage in made["stages"]} == {NUMBER}
    assert (place / "out" / ".store" / FOLDER / "r0c0").is_dir()
    assert NUMBER in (place / "out" / FOLDER / "r0c0" / "report.html").read_text(encoding="utf-8")


def test_the_products_it_stood_for_are_kept_and_the_page_says_so(nights):
    place, before, after = nights
    assert before["artworks"][0]["tiles"][0]["notes"] == []
    (tile,) = after["artworks"][0]["tiles"]
    (kept,) = (place / "out" / FOLDER / ".former").glob("*/r0c0")
    assert (kept / "report.html").is_file()
    assert str(kept) in tile["notes"][0]
    page = (place / "out" / "night.html").read_text(encoding="utf-8")
    assert "stood for other photographs before" in page
    assert f'href="{"MS.%20Bodl.%20264%252F3%20%255Bfol.%207%255D"}/r0c0/report.html"' in page


def test_the_next_night_has_nothing_to_say(nights):
    place, _, _ = nights
    again = night(place)
    assert again["artworks"][0]["state"] == "unchanged"
    assert again["artworks"][0]["tiles"][0]["notes"] == []
    assert len(list((place / "out" / FOLDER / ".former").glob("*/*"))) == 1


def test_commands_know_the_products_by_the_number(nights, capsys):
    place, _, _ = nights
    for words in (
        ["report", place / "out"],
        ["plan", place / "inbox" / "b", "--out", place / "out", "--recipe", "psbox"],
        ["digitise", place / "inbox" / "b", "--out", place / "out", "--recipe", "psbox"],
    ):
        app([str(word) for word in words], standalone_mode=False)
    said = capsys.readouterr().out
    assert f"{place / 'out' / FOLDER / 'r0c0'}/report.html" in said
    assert ".former" not in said
    assert NUMBER in said


def test_a_number_that_differs_by_capitals_from_a_folder_of_the_products_is_failed(nights):
    place, _, _ = nights
    upload(place / "inbox", "c", NUMBER.upper(), 3)
    (passed,) = scan(place / "inbox", 0.0).passed_by
    assert passed.folder.name == "c"
    assert "is also the id of" in passed.message
    shutil.rmtree(place / "inbox" / "b")
    record = night(place)
    (artwork,) = record["artworks"]
    assert artwork["state"] == "failed"
    assert "differ by capitals only" in artwork["tiles"][0]["message"]
    assert not (place / "out" / FOLDER.upper()).exists()
