"""Drafts: a mark dies with its writer; the living keep what they write, whatever their machines are called."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nlights_core.store import draft, drafts, sweep, sweep_below
from nlights_core.store.drafts import OLD, discard

WRITER = """
import socket, sys, time
from pathlib import Path
socket.gethostname = lambda: sys.argv[2]
from nlights_core.store import draft
with draft(Path(sys.argv[1])) as place:
    place.mkdir()
    (place / "half.npy").write_bytes(b"half")
    print(place.name, flush=True)
    sys.stdin.read()
    place.rename(place.with_name("finished-" + sys.argv[2]))
"""


def writer(folder: Path, host: str) -> tuple[subprocess.Popen[str], Path]:
    """A process that is at a draft until its input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    return process, folder / process.stdout.readline().strip()


def ended(process: subprocess.Popen[str], number: int | None = None) -> None:
    if number is not None:
        process.send_signal(number)
    process.communicate()


def test_a_draft_is_gone_at_the_end_and_what_was_renamed_is_not(tmp_path):
    with draft(tmp_path) as place:
        place.mkdir()
        (place / "x").write_text("x")
        place.rename(tmp_path / "finished")
    with draft(tmp_path) as place:
        place.mkdir()
    with draft(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["finished"]


def test_drafts_of_the_living_are_kept_and_those_of_the_dead_are_swept(tmp_path):
    living, kept = writer(tmp_path, "lab")
    dead, left = writer(tmp_path, "lab")
    ended(dead, signal.SIGKILL)
    assert left.is_dir()
    assert sweep(tmp_path) == 1
    assert (kept / "half.npy").read_bytes() == b"half"
    assert sorted(path.name for path in tmp_path.iterdir()) == [kept.name, f"{kept.name}.lock"]
    ended(living)
    assert [path.name for path in tmp_path.iterdir()] == ["finished-lab"]


def test_one_thread_does_not_sweep_what_another_writes(tmp_path):
    with draft(tmp_path) as place:
        place.mkdir()
        assert sweep(tmp_path) == 0
        assert place.is_dir()


def test_machines_of_like_names_leave_each_others_drafts_alone(tmp_path, monkeypatch):
    hosts = ["lab", "lab-2"] * 10
    writers = [writer(tmp_path, f"{host}-{number}") for number, host in enumerate(hosts)]
    try:
        for sweeper in ("lab", "lab-2"):
            monkeypatch.setattr(socket, "gethostname", lambda sweeper=sweeper: sweeper)
            assert sweep(tmp_path) == 0
            assert all(place.is_dir() for _, place in writers)
    finally:
        for process, _ in writers:
            ended(process)
    assert len(list(tmp_path.glob("finished-lab*"))) == 20


def write_often(folder: Path, host: str, start) -> None:
    socket.gethostname = lambda: host
    start.wait()
    for number in range(200):
        with draft(folder) as place:
            place.mkdir()
            (place / "x").write_text(host)
            sweep(folder)
            place.rename(folder / f"{host}-{number}")


def test_whoever_sweeps_while_others_begin_and_end_drafts_takes_none(tmp_path):
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(3)
    runs = [context.Process(target=write_often, args=(tmp_path, host, start)) for host in ("a", "a-2", "a-")]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0, 0]
    assert len([path for path in tmp_path.iterdir() if (path / "x").is_file()]) == 600
    assert not list(tmp_path.glob(".draft-*"))


def test_a_sweep_between_making_and_locking_a_mark_costs_the_writer_nothing(tmp_path, monkeypatch):
    real, asked = drafts._lock, []

    def late(mark: int) -> bool:
        asked.append(mark)
        if len(asked) == 1:
            sweep(tmp_path)  # locks, and removes, the mark that nobody has locked yet
        return real(mark)

    monkeypatch.setattr(drafts, "_lock", late)
    with draft(tmp_path) as place:
        monkeypatch.setattr(drafts, "_lock", real)
        place.mkdir()
        assert sweep(tmp_path) == 0
        assert place.is_dir()
    assert len(asked) > 2
    assert list(tmp_path.iterdir()) == []


def aged(path: Path, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(path, (then, then))


def no_locks(*arguments: object) -> None:
    raise OSError(95, "Operation not supported")


def test_where_nothing_can_be_locked_only_what_is_old_is_swept(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", no_locks)
    with draft(tmp_path) as place:
        place.mkdir()
        (place / "x").write_text("x")
        assert sweep(tmp_path) == 0
        # Another machine may have locks where this one has none.
        monkeypatch.undo()
        assert sweep(tmp_path) == 0
        aged(place, 2 * OLD)
        aged(place.with_name(f"{place.name}.lock"), 2 * OLD)
        assert sweep(tmp_path) == 0  # its newest file is of now
        aged(place / "x", 2 * OLD)
        assert sweep(tmp_path) == 1
    assert list(tmp_path.iterdir()) == []


ODD = (
    ".draft-",
    ".draft-lab",
    ".draft-lab-2-4194399-abcdef01",
    ".draft-a-b-c",
    ".draft-\udce9",
    ".draft-.lock",
)


@pytest.mark.parametrize("name", ODD)
def test_an_odd_name_is_left_until_it_is_old_and_never_fails(tmp_path, name):
    odd = tmp_path / name
    odd.mkdir()
    (odd / "x").write_text("x")
    assert sweep(tmp_path) == 0
    assert (odd / "x").is_file()
    aged(odd / "x", 2 * OLD)
    aged(odd, 2 * OLD)
    sweep(tmp_path)
    assert not odd.exists() or name.endswith(".lock")


def test_what_cannot_be_looked_at_fails_nobody(tmp_path):
    assert sweep(tmp_path / "nothing") == 0
    (tmp_path / "file").write_text("")
    assert sweep(tmp_path / "file") == 0
    (tmp_path / ".draft-loop.lock").symlink_to(tmp_path / ".draft-loop.lock")
    os.mkfifo(tmp_path / ".draft-pipe")
    assert sweep(tmp_path) == 0


def test_a_whole_store_is_swept_at_once(tmp_path):
    places = [
        tmp_path / "inv-1" / "r0c0",
        tmp_path / "inv-1",
        tmp_path / ".scratch",
        tmp_path / "inv-2" / "_flats",
    ]
    for place in places:
        place.mkdir(parents=True, exist_ok=True)
        dead, left = writer(place, "gone-container")
        ended(dead, signal.SIGKILL)
        assert left.is_dir()
    (tmp_path / "odd \udce9").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path)
    assert sweep_below(tmp_path) == 4
    assert not list(tmp_path.rglob(".draft-*"))


def test_what_is_discarded_is_gone_whatever_it_is(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "x").write_text("x")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    for name in ("folder", "file", "link", "nothing", "none/none"):
        discard(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
