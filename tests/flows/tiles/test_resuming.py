"""Killing at any stage and starting again: nothing finished is redone, and the bytes are the same."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

NLIGHTS = Path(sys.executable).parent / "nlights"
STAGES = ("lights", "flat_field", "calibration", "normals", "height", "level", "maps", "mesh", "report")


def command(capture: Path, out: Path) -> list[str]:
    return [str(NLIGHTS), "digitise", str(capture), "--out", str(out)]


def artefacts(out: Path) -> dict[str, dict]:
    return {
        str(path.parent.relative_to(out)): json.loads(path.read_text())
        for path in (out / ".store").rglob("artefact.json")
        if not any(part.startswith(".draft") for part in path.parts)
    }


def contents(out: Path) -> dict[str, bytes]:
    folder = out / "simulated-painting" / "r0c0"
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(painting, tmp_path_factory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("whole")
    subprocess.run(command(painting, out), check=True, capture_output=True)
    return contents(out)


@pytest.mark.parametrize("stage", STAGES)
def test_a_killed_run_goes_on_where_it_stood_and_ends_with_the_same_bytes(painting, tmp_path, whole, stage):
    process = subprocess.Popen(command(painting, tmp_path), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:  # a line is printed when a stage has ended
        if f": {stage}:" in line:
            break
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stderr.close()
    before = artefacts(tmp_path)
    assert any(Path(name).name.startswith(stage) for name in before)

    started = time.time()
    subprocess.run(command(painting, tmp_path), check=True, capture_output=True)
    after = artefacts(tmp_path)
    assert before.items() <= after.items()  # with their times of making: none was made again
    assert contents(tmp_path) == whole
    assert not list(tmp_path.rglob(".draft-*"))
    assert not list(tmp_path.rglob(".former-*"))
    for name in before:
        assert (tmp_path / name / "artefact.json").stat().st_mtime < started


def test_two_runs_at_once_make_the_same_and_disturb_each_other_not(painting, tmp_path, whole):
    runs = [subprocess.Popen(command(painting, tmp_path), stderr=subprocess.PIPE) for _ in range(2)]
    assert [run.wait() for run in runs] == [0, 0], [run.stderr.read() for run in runs if run.stderr]
    for run in runs:
        run.stderr.close()
    assert contents(tmp_path) == whole


def test_a_damaged_artefact_is_made_again(painting, tmp_path, whole):
    subprocess.run(command(painting, tmp_path), check=True, capture_output=True)
    record = next((tmp_path / ".store").rglob("maps-*/artefact.json"))
    record.write_text("{")
    subprocess.run(command(painting, tmp_path), check=True, capture_output=True)
    assert json.loads(record.read_text())["stage"] == "maps"
    assert contents(tmp_path) == whole


def heed_interrupts() -> None:
    """Undo what a shell does to its background jobs, of which a test run may be one."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_an_interrupt_by_hand_is_answered_with_a_sentence(painting, tmp_path):
    process = subprocess.Popen(
        command(painting, tmp_path), stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
    )
    assert process.stderr is not None
    for line in process.stderr:
        if ": flat_field:" in line:
            break
    process.send_signal(signal.SIGINT)
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 130
    assert "what is finished is kept" in said
    assert not list(tmp_path.rglob(".draft-*"))


def test_a_run_killed_between_the_two_renames_of_publishing_loses_nothing(painting, tmp_path, whole):
    subprocess.run(command(painting, tmp_path), check=True, capture_output=True)
    target = tmp_path / "simulated-painting" / "r0c0"
    (target / "notes.txt").write_text("seen by M.")
    target.rename(target.parent / ".former-r0c0")
    left = target.parent / ".draft-0123456789abcdef"
    left.mkdir()
    left.with_name(f"{left.name}.lock").touch()
    subprocess.run(command(painting, tmp_path), check=True, capture_output=True)
    assert (target / "notes.txt").read_text() == "seen by M."
    assert {name: data for name, data in contents(tmp_path).items() if name != "notes.txt"} == whole
    assert sorted(path.name for path in target.parent.iterdir()) == ["r0c0"]
