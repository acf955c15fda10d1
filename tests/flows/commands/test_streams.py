"""What is said, whatever stands in it and wherever it goes: hostile names, closed outputs, other encodings."""

import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

NLIGHTS = Path(sys.executable).parent / "nlights"
RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\u2028\u2029]")
EVIL = "\x1b]0;owned\x07\x9b2J\u202eevil\x7f"
"""Sets a terminal's title, clears it by a control character of one byte, and turns the direction of writing."""
SLY = "\u202eevil"
"""What of it a manifest may hold."""


def run(*words: object, **options: object) -> subprocess.CompletedProcess:
    done = subprocess.run([NLIGHTS, *map(str, words)], capture_output=True, check=False, **options)
    assert b"Traceback" not in done.stderr
    return done


def at_terminal(*words: object) -> str:
    """All that a terminal gets from a command."""
    here, there = pty.openpty()
    process = subprocess.Popen([NLIGHTS, *map(str, words)], stdin=there, stdout=there, stderr=there)
    os.close(there)
    said = bytearray()
    try:
        while part := os.read(here, 65536):
            said.extend(part)
    except OSError:  # how a terminal says that all have left
        pass
    process.wait()
    os.close(here)
    return said.decode(errors="replace")


@pytest.fixture
def hostile(capture) -> Path:
    """A capture in a folder with control characters, whose photographs and title turn the direction of writing."""
    folder = capture.rename(capture.parent / f"b{EVIL}")
    manifest = folder / "artwork.yaml"
    described = yaml.safe_load(manifest.read_text())
    for lamp, name in described["frames"].items():
        described["frames"][lamp] = name.replace(".tif", f"{SLY}.tif")
        (folder / name).rename(folder / described["frames"][lamp])
    described["artwork"] = {"id": "inv\u202e-1 Käthe 春", "title": SLY}
    manifest.write_text(yaml.safe_dump(described, allow_unicode=True), encoding="utf-8")
    return folder


def spoil(folder: Path) -> None:
    next(folder.glob("light_3*")).write_bytes(b"nothing")


@pytest.mark.parametrize("command", ["check", "plan", "digitise", "nightly"])
def test_no_control_character_of_a_capture_reaches_a_terminal(hostile, tmp_path, command):
    words = [command, hostile]
    if command == "nightly":
        words = [command, hostile.parent, "--settle", "0"]
    if command != "check":
        words += ["--out", tmp_path / f"out{EVIL}"]
    said = at_terminal(*words)  # with progress bars, whose own control sequences are no capture's
    assert "\x1b]0" not in said
    assert "\x9b" not in said
    assert "\u202e" not in said
    assert "\x07" not in said
    if command != "check":
        assert "Käthe 春" in said
        assert r"\u202e" in said
    spoil(hostile)
    done = run(*words)
    assert done.returncode in (0, 1, 2)
    for stream in (done.stdout, done.stderr):
        assert RAW.search(stream.decode()) is None
    if command in ("check", "digitise"):
        assert rb"light_3\u202eevil.tif" in done.stderr
    for page in tmp_path.glob("out*/night.html"):
        text = page.read_text(encoding="utf-8")
        assert RAW.search(text) is None
        assert r"\x1b]0;owned" in text
    for page in tmp_path.glob("out*/inv*/r0c0/report.html"):
        assert RAW.search(page.read_text(encoding="utf-8")) is None


MANIFESTS = {
    "a tag": "artwork: !<x\u202ey> {id: a}\n",
    "an unknown field": f'artwork: {{id: a}}\n"{json.dumps(EVIL)[1:-1]}": 1\n',
    "an id": f"artwork: {{id: {json.dumps('a' + EVIL)}}}\n",
    "a stand": f"artwork: {{id: a}}\nstand: {json.dumps(EVIL)}\nframes: x.tif\n",
    "raw control characters": f"artwork: {{id: a{EVIL}}}\n",
    "a direction": "artwork: {id: a}\n\u202efoo: 1\n\u2066: {\n",
}


@pytest.mark.parametrize("kind", MANIFESTS)
def test_an_excerpt_of_a_manifest_is_shown_escaped(tmp_path, kind):
    (tmp_path / "artwork.yaml").write_text(MANIFESTS[kind], encoding="utf-8")
    done = run("check", tmp_path)
    assert done.returncode == 2
    assert done.stderr
    assert RAW.search(done.stderr.decode()) is None


@pytest.mark.parametrize(
    "words",
    [
        f"nosuch{EVIL}",
        f"check {EVIL}",
        f"check a b{EVIL}",
        f"check --no{EVIL}",
        f"report {EVIL}",
        f"review {EVIL} a/b --accept --by c --why d",
        f"simulate x --width {EVIL}",
        f"simulate x --scene {EVIL}",
        f"plugins check {EVIL}",
    ],
    ids=lambda words: words.split()[0],
)
def test_a_word_of_the_command_itself_is_shown_escaped(tmp_path, words):
    done = run(*words.split(" "), cwd=tmp_path)
    assert done.returncode == 2
    assert RAW.search(done.stderr.decode()) is None
    assert "owned" in done.stderr.decode() or "integer" in done.stderr.decode()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-16"])
@pytest.mark.parametrize("command", ["check {}", "doctor", "--help", "plan {}"])
def test_an_output_that_lacks_letters_gets_escapes(hostile, command, encoding):
    environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    done = run(*(word.format(hostile) for word in command.split(" ")), env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.decode(encoding)


def test_a_system_without_a_language_is_no_hindrance(capture):
    manifest = capture / "artwork.yaml"
    named = manifest.read_text().replace("id: simulated-painting", "id: Käthe 春")
    manifest.write_text(named, encoding="utf-8")
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment.pop("PYTHONIOENCODING", None)
    done = run("plan", capture, env=environment)
    assert done.returncode == 0, done.stderr
    assert rb"K\xe4the \u6625/r0c0" in done.stdout


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_stream_that_was_closed_before_the_start_is_no_hindrance(painting, tmp_path, closed):
    out = tmp_path / "out"
    line = f'"{NLIGHTS}" digitise "{painting}" --out "{out}" {closed}'
    done = subprocess.run(["sh", "-c", line], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    # What would have been said is in none of the files.
    (folder,) = (out / "simulated-painting").iterdir()
    assert json.loads((folder / "warnings.json").read_text()) == []
    assert (folder / "report.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("words", [["doctor"], ["--version"], ["plugins", "--schema"]])
def test_an_output_on_a_full_disk_is_a_sentence(words):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([NLIGHTS, *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "No space left on device" in done.stderr


def test_a_night_outlives_whoever_listened(painting, tmp_path):
    words = [NLIGHTS, "nightly", painting.parent, "--out", tmp_path / "out", "--settle", "0"]
    process = subprocess.Popen(
        list(map(str, words)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "simulated-painting: 1 of its tiles to run\n"
    process.stderr.close()
    assert process.stdout is not None
    said = process.stdout.read()
    process.stdout.close()
    assert process.wait() == 0
    assert said.startswith("1 of 1 artwork done")
    assert json.loads((tmp_path / "out" / "night.json").read_text())["ended"]
