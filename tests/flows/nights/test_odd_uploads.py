"""Uploads that are odd in every way that was met: each costs its own folder, with a sentence."""

import html
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import yaml

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate
from nlights_flows.nights.inbox import scan
from nlights_flows.nights.order import Order
from nlights_flows.nights.record import night_exit_code
from nlights_flows.nights.running import run_here, run_night
from nlights_flows.tiles.run_options import RunOptions

COMMAND = Path(sys.executable).parent / "nlights"
NOBODY = 65534

TAGS = {
    "object": "priority: !!python/object:os.system {}",
    "name": "priority: !!python/name:os.system ''",
    "timestamp": "priority: !!timestamp soon",
    "binary": "priority: !!binary é",
    "set": "priority: !!set {a, b}",
    "omap": "priority: !!omap 3",
    "int": "priority: !!int ''",
    "float": "priority: !!float x",
    "bool": "priority: !!bool perhaps",
    "own": "priority: !priority 3",
    "null": "stand: ! null",
    "merge": "<<: {priority: 3}",
}
PATTERNS = {
    "nul": 'dark: "\\0dark.tif"',
    "half": 'dark: "\\ud800.tif"',
    "long name": f"dark: {'d' * 300}.tif",
    f"long path {'p' * 150}": f"dark: {'dark/' * 799}.tif",
    "stars": "flats: '**/**/{n}{n}.tif'",
    "absolute": "dark: /etc/passwd",
    "circle": "dark: circle.tif",
    "braces": "flats: '{{lamp}}{n:9999}{}.tif'",
}
MANIFESTS = {
    "aliases": "artwork: &a {id: x}\ntiles: [*a, *a]\n",
    "laughs": 'a: &a ["x"]\n'
    + "".join(f"{k}: &{k} [{', '.join([f'*{j}'] * 9)}]\n" for j, k in ("ab", "bc", "cd")),
    "twice": "artwork: {id: a, id: b}\n",
    "deep": "a: " + "[" * 100_000,
    "many faults": "artwork: {id: a}\n" + "".join(f"f{i}: 1\n" for i in range(9000)),
    "megabyte": "artwork: {id: a}\nframes:\n" + "- a\n" * 262_144,
    "many nodes": "artwork: {id: a}\nframes:\n" + "- a\n" * 130_000,
    "one text": "artwork: {id: a}\ntitle: " + "a " * 260_000,
    "comments": "artwork: {id: a}\n" + "#\n" * 260_000,
    "many files": f"artwork: {{id: a}}\nframes: [{', '.join(f'f{i}' for i in range(3000))}]\ntiles:\n"
    + "".join(f"- {{name: t{i}}}\n" for i in range(5000)),
    "latin": "artwork: {id: é}\n",
    "nothing": "",
    "text": "artwork",
    "reserved": "artwork: {id: Nights}\nframes: 'light_{n}.tif'\n",
}


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "good"
    simulate(folder, load_stand("horizontal"), scene="painting", width=64, seed=1)
    (folder / "upload-complete").touch()
    return folder


def odd(inbox: Path, name: str | bytes, manifest: str | bytes) -> Path:
    """Upload a manifest alone."""
    folder = inbox / os.fsdecode(name)
    folder.mkdir()
    (folder / "artwork.yaml").write_bytes(manifest if isinstance(manifest, bytes) else manifest.encode())
    (folder / "upload-complete").touch()
    return folder


def fill(inbox: Path, good: Path) -> dict[str, str]:
    """Upload everything odd; by folder, what must be said of it."""
    said = {}
    described = yaml.safe_load((good / "artwork.yaml").read_text(encoding="utf-8"))
    for name, line in TAGS.items():
        odd(inbox, f"tag {name}", yaml.safe_dump(described) + line + "\n")
        said[f"tag {name}"] = "unknown field" if name == "merge" else "is not allowed; remove it"
    for name, line in PATTERNS.items():
        field = line.partition(":")[0]
        kept = {key: value for key, value in described.items() if key != field}
        folder = odd(inbox, f"pattern {name}", yaml.safe_dump(kept | {"artwork": {"id": name}}) + line + "\n")
        (folder / "circle.tif").symlink_to("circle.tif")
        said[f"pattern {name}"] = f"{field}: "
    said |= {"pattern nul": "U+0000", "pattern half": "U+D800", "pattern circle": "leads in a circle"}
    said["pattern stars"] = "no such file"
    for name, text in MANIFESTS.items():
        odd(inbox, f"manifest {name}", text.encode("latin-1"))
        said[f"manifest {name}"] = "artwork.yaml"
    said |= {"manifest many faults": "more; mend these first", "manifest many files": "files in all"}
    said |= {
        "manifest megabyte": "larger than 512 KiB",
        "manifest many nodes": "names and values",
        "manifest reserved": "of nLights' own",
    }
    latin = Path(shutil.copytree(good, inbox / os.fsdecode(b"inv-\xe9")))
    said["inv-\\xe9"] = "is not UTF-8; rename it"
    assert latin.is_dir()
    photographs = Path(shutil.copytree(good, inbox / "latin photographs"))
    for path in photographs.glob("light_*.tif"):
        path.rename(photographs / os.fsdecode(b"\xe9" + path.stem[-1:].encode() + b".tif"))
    (photographs / "artwork.yaml").write_text("artwork: {id: a}\nframes: '{lamp}.tif'\n")
    said["latin photographs"] = "is not UTF-8; rename the photograph"
    for name, what in (("pipe", "a named pipe"), ("socket", "a socket"), ("folder", "a folder")):
        (folder := inbox / name).mkdir()
        (folder / "upload-complete").touch()
        said[name] = what
    os.mkfifo(inbox / "pipe" / "artwork.yaml")
    (inbox / "folder" / "artwork.yaml").mkdir()
    bind(inbox / "socket" / "artwork.yaml")
    (inbox / "circle").mkdir()
    (inbox / "circle" / "artwork.yaml").symlink_to("artwork.yaml")
    (inbox / "circle" / "upload-complete").touch()
    (inbox / "round").symlink_to("round")
    (inbox / "nowhere").symlink_to("is not there")
    return said | {"circle": "leads in a circle", "round": "cannot be read", "nowhere": "leads nowhere"}


def bind(path: Path) -> None:
    """A socket; the path that is given to the system must be short."""
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        socket.socket(socket.AF_UNIX).bind(path.name)
    finally:
        os.chdir(before)


EARLIER = {
    "2020-01-01": {"schema": 1, "name": "2020-01-01", "recipe": "psbox", "artworks": [{"tiles": [{}]}]},
    "2020-01-02": {"schema": 1, "date": "2020-01-02"},
    "2020-01-03": {"schema": 1, "recipe": "psbox", "started": 3, "name": None, "artworks": "none"},
    "2020-01-04": [],
}


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of the socket, which nobody closes
def test_every_odd_upload_costs_its_own_folder_with_a_sentence(good, tmp_path):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    shutil.copytree(good, inbox / "good")
    said = fill(inbox, good)
    for name, record in EARLIER.items():
        (out / "nights" / name).mkdir(parents=True)
        (out / "nights" / name / "night.json").write_text(json.dumps(record))
    (out / "nights" / "2020-01-05").mkdir()
    os.mkfifo(out / "nights" / "2020-01-05" / "night.json")
    record = run_night(Order(inbox, RunOptions(recipe="psbox", out=out)), run_here)
    assert night_exit_code(record) == 1
    written = json.loads((out / "night.json").read_bytes().decode("utf-8"))
    page = html.unescape((out / "night.html").read_bytes().decode("utf-8"))
    assert page.rstrip().endswith("</html>")
    found = {one["folder"]: one for one in written["artworks"]}
    assert found.pop("good")["state"] == "done"
    assert {name: one["state"] for name, one in found.items()} == dict.fromkeys(said, "failed")
    for name, words in said.items():
        message = "".join(one["message"] for one in (found[name], *found[name]["tiles"]))
        assert words in message, (name, message)
        assert "a defect" not in message, message
        assert len(message.splitlines()) <= 51
        assert name in page
    assert written["ended"]
    assert written["notes"] == []


def test_the_command_ends_with_1_and_no_traceback(good, tmp_path):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    shutil.copytree(good, inbox / "good")
    shutil.copytree(good, inbox / os.fsdecode(b"inv-\xe9"))
    words = [COMMAND, "nightly", inbox, "--out", out, "--recipe", "psbox"]
    done = subprocess.run(words, capture_output=True, timeout=300, check=False)
    assert done.returncode == 1, done.stderr
    assert b"Traceback" not in done.stderr
    assert rb"inv-\xe9" in done.stderr
    planned = subprocess.run([*words, "--plan"], capture_output=True, timeout=300, check=False)
    assert planned.returncode == 0, planned.stderr


def as_somebody_else() -> list[str]:
    """Words before a command that take from root the right to read what is closed to others."""
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        pytest.skip("needs root and setpriv, to make folders that are another user's")
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search"]


def test_folders_that_their_uploader_kept_to_himself_cost_themselves_alone(good, tmp_path):
    before, inbox, out = as_somebody_else(), tmp_path / "inbox", tmp_path / "out"
    shutil.copytree(good, inbox / "good")
    closed = {"closed": 0o700, "room/closed": 0o700, "only listed": 0o744, "only entered": 0o711}
    for name, mode in closed.items():
        folder = Path(shutil.copytree(good, inbox / name))
        folder.chmod(mode)
        os.chown(folder, NOBODY, NOBODY)
    for name, file in (("manifest", "artwork.yaml"), ("photograph", "light_3.tif")):
        folder = Path(shutil.copytree(good, inbox / name))
        described = yaml.safe_load((folder / "artwork.yaml").read_text(encoding="utf-8"))
        (folder / "artwork.yaml").write_text(yaml.safe_dump(described | {"artwork": {"id": name}}))
        (folder / file).chmod(0o600)
        os.chown(folder / file, NOBODY, NOBODY)
    words = [COMMAND, "nightly", inbox, "--out", out, "--recipe", "psbox"]
    done = subprocess.run([*before, *words], capture_output=True, timeout=300, check=False)
    assert done.returncode == 1, done.stderr
    assert b"Traceback" not in done.stderr
    assert (out / "night.html").read_text(encoding="utf-8").rstrip().endswith("</html>")
    found = {one["folder"]: one for one in json.loads((out / "night.json").read_bytes())["artworks"]}
    assert found.pop("good")["state"] == "done"
    assert set(found) == {*closed, "manifest", "photograph"}
    for name, one in found.items():
        assert one["state"] == "failed"
        message = "".join(said["message"] for said in (one, *one["tiles"]))
        assert "cannot be read (Permission denied)" in message, (name, message)


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="most disks cannot hold such dates; memory can")
@pytest.mark.parametrize("year", [12024, -5000, 300_000])
def test_a_marker_beyond_the_calendar_is_told(good, year):
    with tempfile.TemporaryDirectory(dir="/dev/shm") as place:
        inbox, out = Path(place) / "inbox", Path(place) / "out"
        for name in ("good", "far"):
            shutil.copytree(good, inbox / name)
        marker = inbox / "far" / "upload-complete"
        os.utime(marker, (0, (year - 1970) * 31_556_952))
        record = run_night(Order(inbox, RunOptions(recipe="psbox", out=out)), run_here)
        assert night_exit_code(record) == 1
        assert [one.state for one in record.artworks] == ["done", "failed"]
        assert str(marker) in record.artworks[1].message
        assert "which no calendar has" in record.artworks[1].message


def test_a_marker_from_before_1970_is_an_early_upload(good, tmp_path):
    shutil.copytree(good, tmp_path / "inbox" / "good")
    os.utime(tmp_path / "inbox" / "good" / "upload-complete", (0, -1e9))
    (ready,) = scan(tmp_path / "inbox", 0).ready
    assert ready.uploaded == -1e9


def test_folders_above_may_have_any_bytes_for_names(good, tmp_path):
    place = tmp_path / os.fsdecode(b"\xe9t\xe9")
    shutil.copytree(good, place / "inbox" / "good")
    for words in (
        ["digitise", place / "inbox" / "good", "--out", place / "out", "--recipe", "psbox"],
        ["nightly", place / "inbox", "--out", place / "out", "--recipe", "psbox"],
    ):
        done = subprocess.run([COMMAND, *words], capture_output=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert b"Traceback" not in done.stderr
    (made,) = (place / "out").glob("*/r0c0")
    for path in (
        *made.glob("*.json"),
        made / "report.html",
        place / "out" / "night.html",
        place / "out" / "night.json",
    ):
        path.read_bytes().decode("utf-8")
    assert json.loads((place / "out" / "night.json").read_text(encoding="utf-8"))["out"] == str(place / "out")
