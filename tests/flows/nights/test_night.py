"""Nights on a small inbox: what is done, what is told, and that nothing is done twice."""

import json
import os
import shutil
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate
from nlights_flows.nights import estimates as night_estimates
from nlights_flows.nights.claims import Claims
from nlights_flows.nights.estimates import Deadline
from nlights_flows.nights.limits import load_limits
from nlights_flows.nights.order import Order, check_order
from nlights_flows.nights.running import Night, run_here, run_night
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Outcome

COMMAND = Path(sys.executable).parent / "nlights"
HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="session")
def shot(tmp_path_factory) -> Path:
    """The smallest capture that is worth a picture."""
    folder = tmp_path_factory.mktemp("captures") / "shot"
    simulate(folder, load_stand("horizontal"), scene="painting", width=96, seed=1)
    return folder


def put(shot: Path, inbox: Path, name: str, title: str = "", marker: bool = True, extra: str = "") -> Path:
    """Upload a copy of the capture; its folder's name is its inventory number."""
    folder = inbox / name
    shutil.copytree(shot, folder, ignore=shutil.ignore_patterns("truth"))
    manifest = folder / "artwork.yaml"
    described = yaml.safe_load(manifest.read_text(encoding="utf-8"))
    described["artwork"] = {"id": folder.name, "title": title}
    manifest.write_text(yaml.safe_dump(described) + extra)
    if marker:
        (folder / "upload-complete").touch()
    return folder


def nightly(*words, code=0) -> subprocess.CompletedProcess:
    done = subprocess.run(
        [COMMAND, "nightly", *map(str, words)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def states(record: dict) -> dict[str, str]:
    return {entry["folder"]: entry["state"] for entry in record["artworks"]}


def read(out: Path) -> dict:
    return json.loads((out / "night.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def spent(shot, tmp_path_factory) -> tuple[Path, Path, subprocess.CompletedProcess]:
    """A night over two good artworks, a bad tile, a broken manifest and an unfinished upload."""
    inbox = tmp_path_factory.mktemp("night") / "inbox"
    put(shot, inbox, "inv-1", HOSTILE)
    put(shot, inbox, "room 2/inv-2", "Urgent", extra="priority: 5\n")
    bad = put(shot, inbox, "inv-3") / "light_3.tif"
    bad.write_bytes(bad.read_bytes()[:2000])
    (put(shot, inbox, "inv-4") / "artwork.yaml").write_text("artwork: {id: inv-4}\nfoo: 1\n")
    put(shot, inbox, "inv-5", marker=False)
    out = inbox.parent / "out"
    return inbox, out, nightly(inbox, "--out", out, code=1)


def test_a_night_does_what_can_be_done_and_tells_the_rest_with_remedies(spent):
    _, out, done = spent
    record = read(out)
    assert states(record) == {
        "room 2/inv-2": "done",
        "inv-1": "done",
        "inv-3": "failed",
        "inv-4": "failed",
        "inv-5": "waiting",
    }
    assert next(iter(states(record))) == "room 2/inv-2"  # the higher priority goes first
    assert record["verdict"].startswith("2 of 4 artworks done, 2 failed, 1 folder waiting")
    assert record["verdict"] in done.stdout
    assert "light_3.tif" in done.stderr
    assert "copy it again" in done.stderr
    assert "foo: unknown field" in done.stderr
    assert (out / "inv-1" / "r0c0" / "report.html").is_file()
    assert record["ended"]


def test_the_limits_that_are_shipped_are_of_numbers_that_the_report_makes(spent):
    _, out, _ = spent
    rows = json.loads((out / "inv-1" / "r0c0" / "quality.json").read_text())
    table = load_limits()
    for limit in table.limits:
        of_it = [row for row in rows if limit.covers(row["name"])]
        assert of_it, limit.name
        assert all(row["unit"] == limit.unit and row["value"] is not None for row in of_it)
    assert len([row for row in rows if row["name"].startswith("Flat level, ")]) == 8
    tile = read(out)["artworks"][0]["tiles"][0]
    assert tile["verdict"] == "ok"
    assert {row["verdict"] for row in tile["numbers"]} == {"ok"}


def test_the_flat_levels_and_the_noise_are_those_of_the_photographs(spent, shot):
    import tifffile

    _, out, _ = spent
    rows = {r["name"]: r["value"] for r in json.loads((out / "inv-1" / "r0c0" / "quality.json").read_text())}
    dark = tifffile.imread(shot / "dark.tif").astype(float)
    for number in (1, 5):
        flat = tifffile.imread(shot / "flat" / f"light_{number}.tif").astype(float)
        level = 100 * (flat - dark).mean() / (65535 - dark.mean())
        assert rows[f"Flat level, Relio_{number}"] == pytest.approx(level, rel=0.01)
    # The simulated camera holds 50 000 electrons at saturation.
    assert rows["Photon noise at saturation"] == pytest.approx(100 / 50_000**0.5, rel=0.05)


class _Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.links: list[str] = []
        self.pictures: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        found = dict(attrs)
        self.links += [found["href"]] if "href" in found else []
        self.pictures += [found["src"]] if "src" in found else []


def test_the_page_is_self_contained_and_a_hostile_title_stays_text(spent):
    _, out, _ = spent
    for path in (out / "night.html", *(out / "nights").glob("*/night.html")):
        text = path.read_text(encoding="utf-8")
        page = _Page(text)
        assert "script" not in page.tags
        assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
        assert "default-src 'none'" in text
        assert len(page.links) >= 2
        for link in page.links:
            assert (path.parent / unquote(link)).is_file(), link
        assert len(page.pictures) == 2
        assert all(p.startswith("data:image/jpeg") and len(p) <= 30_000 for p in page.pictures)
        assert "copy it again" in text
        assert "<svg" in text


def test_the_next_night_does_nothing_and_says_so_in_seconds(spent):
    inbox, out, _ = spent
    before = {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("artefact.json")}
    started = time.monotonic()
    record = run_night(Order(inbox, RunOptions(out=out)), run_here).as_json()
    assert time.monotonic() - started < 5
    assert {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("artefact.json")} == before
    assert states(record)["inv-1"] == states(record)["room 2/inv-2"] == "unchanged"
    nights = sorted(path.name for path in (out / "nights").glob("2*"))
    assert nights[-1] == f"{nights[0]}-{len(nights)}"


def test_a_plan_says_the_order_and_writes_nothing(spent, shot, tmp_path):
    inbox, out, _ = spent
    done = nightly(inbox, "--out", out, "--plan")
    rows = [line for line in done.stdout.splitlines() if line.startswith("inv-")]
    assert [row.split()[0] for row in rows] == ["inv-2", "inv-1", "inv-3"]
    assert "light_3.tif" in done.stderr
    nightly(inbox, "--out", tmp_path / "new", "--plan")
    assert not (tmp_path / "new").exists()


def test_two_nights_at_once_do_every_tile_once(shot, tmp_path):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    for i in range(2):
        put(shot, inbox, f"inv-{i}")
    both = [
        subprocess.Popen(
            [COMMAND, "nightly", inbox, "--out", out],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    said = [process.communicate(timeout=300) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    records = [json.loads(path.read_text()) for path in (out / "nights").glob("2*/night.json")]
    assert len(records) == 2
    for i in range(2):
        assert sorted(states(record)[f"inv-{i}"] for record in records) == ["done", "unchanged"]
    assert not [path for path in (out / ".store" / ".claims").rglob("*") if path.is_file()]


def pretended(night, run) -> dict:
    """Run a night whose tiles are only said to be done."""

    def run_artwork(batch, around):
        for tile in batch.tiles:
            around(tile, lambda tile=tile: run(tile))

    night.store.prepare()
    with Claims(night.store.root) as claims:
        return Night(night, run_artwork, claims).run().as_json()


def test_nothing_is_begun_that_cannot_end_in_time(shot, tmp_path, monkeypatch):
    for i in range(3):
        put(shot, tmp_path / "inbox", f"inv-{i}")
    now = 1000.0
    monkeypatch.setattr(night_estimates, "monotonic", lambda: now)

    def run(tile):
        nonlocal now
        now += 15.0
        return Outcome(tile.artwork, tile.name, "done", None, "", 15.0)

    order = Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out"), until="06:30")
    night = check_order(order)
    at = night.deadline.at
    object.__setattr__(night, "deadline", Deadline(at, now + 2 * 15.2))
    record = pretended(night, run)
    assert list(states(record).values()) == ["done", "done", "left"]
    assert "until 06:30" in record["artworks"][2]["tiles"][0]["message"]
    assert record["verdict"] == "2 of 3 artworks done, 1 tile left for the next night"
    assert record["until"][11:16] == "06:30"
    # The next night, without an end, takes up what is left; nobody had made anything, so it does all.
    record = pretended(check_order(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out"))), run)
    assert set(states(record).values()) == {"done"}


def test_a_night_that_is_killed_leaves_a_true_page(shot, tmp_path):
    for name in ("inv-1", "inv-2"):
        put(shot, tmp_path / "inbox", name)

    def run(tile):
        if tile.artwork == "inv-2":
            raise KeyboardInterrupt
        return Outcome(tile.artwork, tile.name, "done", None, "", 1.0)

    with pytest.raises(KeyboardInterrupt):
        pretended(check_order(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out"))), run)
    record = read(tmp_path / "out")
    assert states(record) == {"inv-1": "done", "inv-2": "left"}
    assert record["ended"] is None
    assert "while the night was at work" in (tmp_path / "out" / "night.html").read_text()


def test_a_way_of_running_that_breaks_costs_its_own_artwork(shot, tmp_path):
    for name in ("inv-1", "inv-2"):
        put(shot, tmp_path / "inbox", name)
    night = check_order(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out")))
    night.store.prepare()

    def run_artwork(batch, around):
        if batch.artwork == "inv-1":
            raise RuntimeError("the cluster is gone")
        around(batch.tiles[0], lambda: Outcome(batch.artwork, "r0c0", "done"))

    with Claims(night.store.root) as claims:
        record = Night(night, run_artwork, claims).run().as_json()
    assert states(record) == {"inv-1": "failed", "inv-2": "done"}
    assert "the cluster is gone" in record["artworks"][0]["tiles"][0]["message"]


def test_a_full_disk_is_told_before_a_tile_is_begun(shot, tmp_path, monkeypatch):
    put(shot, tmp_path / "inbox", "inv-1")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(night_estimates.shutil, "disk_usage", lambda path: usage._replace(free=1_000_000))
    record = pretended(
        check_order(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out"))),
        lambda tile: pytest.fail("begun"),
    )
    assert states(record) == {"inv-1": "failed"}
    assert "1 MB are free; free some space" in record["artworks"][0]["tiles"][0]["message"]


def test_an_empty_inbox_is_a_night_well_spent_and_none_is_a_fault(tmp_path):
    (tmp_path / "inbox").mkdir()
    assert (
        run_night(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out")), run_here).as_json()["verdict"]
        == "the inbox is empty"
    )
    done = nightly(tmp_path / "nowhere", "--out", tmp_path / "other", code=2)
    assert "there is no such folder" in done.stderr
    assert not (tmp_path / "other").exists()


def test_a_tile_claimed_by_a_run_that_died_is_taken_over(shot, tmp_path, monkeypatch):
    put(shot, tmp_path / "inbox", "inv-1")
    claim = tmp_path / "out" / ".store" / ".claims" / "inv-1" / "r0c0"
    claim.parent.mkdir(parents=True)
    claim.write_text("{}")
    monkeypatch.setattr("nlights_flows.nights.running.LOOK", 0.05)
    looks = 0
    busy = Night._busy

    def dies(self, tile):
        nonlocal looks
        looks += 1
        if looks == 4:  # its last touch was long ago
            os.utime(claim, (time.time() - 60, time.time() - 60))
        return busy(self, tile)

    monkeypatch.setattr(Night, "_busy", dies)
    night = check_order(Order(tmp_path / "inbox", RunOptions(out=tmp_path / "out")))
    record = pretended(night, lambda tile: Outcome(tile.artwork, tile.name, "done"))
    assert looks >= 4
    assert states(record) == {"inv-1": "done"}
    assert not claim.exists()
