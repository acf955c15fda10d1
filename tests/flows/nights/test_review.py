"""Decisions of people: what waits for one, what is recorded, and what counts."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nlights_flows.nights.decisions import read_decisions

COMMAND = Path(sys.executable).parent / "nlights"
STRICT = """limits:
  - {name: "Uncertainty of the normals, mean", unit: "°", warn: 0.001, fail: 5, source: a test}
  - {name: Saturated, unit: "% of pixels", warn: 50, fail: 90, source: a test}
"""
WHO = ("--by", "M. Rossi", "--why", "good enough for the catalogue")


@pytest.fixture(scope="module")
def spent(upload, nlights, tmp_path_factory) -> tuple[Path, Path]:
    """A night after which both tiles wait for a word: inbox and limits; never written to."""
    folder = tmp_path_factory.mktemp("review")
    for name in ("inv-1", "MS 264/3"):
        upload(folder / "inbox" / name.replace("/", "-"), "capture", id=name)
    (folder / "limits.yaml").write_text(STRICT, encoding="utf-8")
    nlights("nightly", folder / "inbox", "--out", folder / "out", "--limits", folder / "limits.yaml")
    return folder / "out", folder / "limits.yaml"


@pytest.fixture
def out(spent, tmp_path) -> Path:
    """A copy of the night's products that a test may add to."""
    ignored = shutil.ignore_patterns(".store")
    return Path(shutil.copytree(spent[0], tmp_path / "out", ignore=ignored))


@pytest.fixture
def review(spent, out, nlights):
    def run(*words, code=0):
        return nlights("review", out, *words, "--limits", spent[1], code=code)

    return run


def states(done) -> dict[str, str]:
    return {f"{one['artwork']}/{one['tile']}": one["state"] for one in json.loads(done.stdout)["tiles"]}


def page(out: Path) -> str:
    return (out / "night.html").read_text(encoding="utf-8")


def test_tiles_outside_limits_are_open_until_somebody_decides(review, out):
    assert states(review("--json")) == {"inv-1/r0c0": "open", "MS 264/3/r0c0": "open"}
    assert "2 tiles to be watched" in page(out)
    said = review("inv-1/r0c0", "--accept", *WHO).stdout
    assert "inv-1/r0c0: accepted by M. Rossi (20" in said
    review("MS 264/3/r0c0", "--repeat", "--by", "Käthe", "--why", "lamp 3 was moved")
    assert states(review("--json")) == {"inv-1/r0c0": "accepted", "MS 264/3/r0c0": "repeat"}
    listed = review().stdout
    assert "Uncertainty of the normals, mean is 0.1" in listed
    assert "0 of 2 tiles open, 1 accepted, 1 to be photographed again" in listed
    # The page is drawn anew: nothing is open any more, and it says who and why.
    for path in (out / "night.html", *(out / "nights").glob("2*/night.html")):
        text = path.read_text(encoding="utf-8")
        assert "to be watched</h1>" not in text
        assert "1 tile to be photographed again</h1>" in text
        assert "accepted by M. Rossi" in text
        assert "good enough for the catalogue" in text
        assert "Käthe" in text
        assert "Measured, but not within the limits" not in text


def test_the_list_of_what_to_photograph_again_holds_nothing_else(review):
    review("inv-1/r0c0", "--accept", *WHO)
    assert review("--todo").stdout == "0 of 2 tiles to be photographed again\n"
    review("MS 264/3/r0c0", "--repeat", "--by", "Käthe", "--why", "lamp 3\nwas moved")
    first, last = review("--todo").stdout.splitlines()
    assert first.startswith("MS 264/3/r0c0: to be photographed again, says Käthe (20")
    assert first.endswith("): lamp 3 was moved")
    assert last == "1 of 2 tiles to be photographed again"
    assert states(review("--todo", "--json")) == {"MS 264/3/r0c0": "repeat"}


def test_the_newest_decision_counts_and_the_others_are_kept(review, out):
    for choice, why in (("--repeat", "dark"), ("--accept", "not so dark"), ("--repeat", "dark indeed")):
        review("inv-1/r0c0", choice, "--by", "A", "--why", why)
    kept = read_decisions(out / "inv-1" / "r0c0")
    assert [one.why for one in kept] == ["dark", "not so dark", "dark indeed"]
    listed = review().stdout
    assert "dark indeed" in listed.splitlines()[2]
    assert "not so dark (since decided anew)" in listed
    assert page(out).count("since decided anew") == 2


def test_a_decision_about_former_products_is_shown_and_counts_no_longer(spent, upload, nlights, tmp_path):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    upload(inbox, "inv-1")
    words = ("nightly", inbox, "--out", out, "--limits", spent[1])
    nlights(*words)
    review = ("review", out, "--limits", spent[1])
    nlights(*review, "inv-1/r0c0", "--accept", *WHO)
    # Another recipe makes other products of the same photographs, in the same place.
    nlights(*words, "--recipe", "paper")
    record = json.loads((out / "night.json").read_text())
    (tile,) = record["artworks"][0]["tiles"]
    assert tile["state"] == "done"
    assert [(one["counts"], one["of_former"]) for one in tile["review"]] == [(False, True)]
    assert "1 tile to be watched" in record["verdict"]
    assert "it no longer counts" in page(out)
    assert states(nlights(*review, "--json")) == {"inv-1/r0c0": "open"}
    nlights(*words)  # the former products come back, and with them what was said of them
    assert states(nlights(*review, "--json")) == {"inv-1/r0c0": "accepted"}
    assert "Measured, but not within the limits" not in page(out)
    assert "accepted by M. Rossi" in page(out)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("inv-1/r0c1", "--accept", *WHO), "did you mean 'inv-1/r0c0'?"),
        (("inv-1", "--accept", *WHO), "write ARTWORK/TILE"),
        (("../out/inv-1/r0c0", "--accept", *WHO), "holds no tile"),
        (("inv-1/.", "--accept", *WHO), "holds no tile"),
        (("inv-1/r0c0", "--accept", "--repeat", *WHO), "exclude each other"),
        (("inv-1/r0c0", *WHO), "--accept or --repeat"),
        (("inv-1/r0c0", "--accept", "--by", " \t", "--why", "x"), "--by: is empty"),
        (("inv-1/r0c0", "--accept", "--by", "A", "--why", ""), "--why: is empty"),
        (("inv-1/r0c0", "--accept", "--by", "a\x1b[2J", "--why", "x"), r"'a\x1b[2J' holds a control"),
        (("inv-1/r0c0", "--accept", "--by", b"a\xff", "--why", "x"), r"'a\xff' holds a control"),
        (("inv-1/r0c0", "--accept", "--by", "a" * 201, "--why", "x"), "has 201 letters; 200 are allowed"),
        (("inv-1/r0c0", "--accept", "--by", "A"), "--why TEXT is missing"),
        (("inv-1/r0c0", "--accept", "--why", "A"), "--by NAME is missing"),
        (("--accept", *WHO), "name the tile"),
        (("--by", "A"), "name the tile"),
        (("--todo", "inv-1/r0c0"), "leave out the tile"),
    ],
    ids=str,
)
def test_what_is_no_decision_is_refused_and_nothing_is_written(spent, words, said):
    out = spent[0]
    done = subprocess.run([COMMAND, "review", out, *words], capture_output=True, check=False)
    assert done.returncode == 2
    assert said in done.stderr.decode()
    assert len(done.stderr.splitlines()) == 1
    assert b"\x1b" not in done.stderr
    assert not list(out.rglob("review.json"))


def test_a_folder_without_products_is_told(nlights, tmp_path):
    for place in (tmp_path, tmp_path / "nowhere"):
        assert "holds no products" in nlights("review", place, code=2).stderr
        assert "holds no products" in nlights("review", place, "a/b", "--accept", *WHO, code=2).stderr


def test_people_who_decide_at_once_lose_nothing(spent, out):
    words = [COMMAND, "review", out, "inv-1/r0c0", "--limits", spent[1], "--why", "seen", "--accept", "--by"]
    runs = [
        subprocess.Popen([*map(str, words), f"person {i}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for i in range(6)
    ]
    said = [run.communicate(timeout=120) for run in runs]
    assert [run.returncode for run in runs] == [0] * 6, said
    kept = read_decisions(out / "inv-1" / "r0c0")
    assert sorted(one.by for one in kept) == [f"person {i}" for i in range(6)]
    assert kept[-1].by in page(out)


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"decisions": [{}]}', '{"decisions": [{"decision": "burn"}]}', "[" * 9999]
)
def test_a_damaged_record_of_decisions_is_told_and_left_alone(review, out, text):
    path = out / "inv-1" / "r0c0" / "review.json"
    path.write_text(text)
    assert "review.json: is damaged" in review("inv-1/r0c0", "--accept", *WHO, code=2).stderr
    assert path.read_text() == text
    assert states(review("--json"))["inv-1/r0c0"] == "open"
    assert "review.json: is damaged" in review().stdout


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_told(review, out):
    folder = out / "inv-1" / "r0c0"
    folder.chmod(0o555)
    try:
        said = review("inv-1/r0c0", "--accept", *WHO, code=2).stderr
    finally:
        folder.chmod(0o755)
    assert "whoever decides must be allowed to write there" in said


@pytest.mark.parametrize("text", ["{", "[]", '{"artworks": [{"tiles": 3}]}', '{"artworks": []}'])
def test_a_damaged_record_of_the_night_costs_the_page_and_not_the_decision(review, out, text):
    (out / "night.json").write_text(text)
    assert "the decision is recorded" in review("inv-1/r0c0", "--accept", *WHO).stderr
    assert states(review("--json"))["inv-1/r0c0"] == "accepted"
