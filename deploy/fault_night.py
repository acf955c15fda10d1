"""Nights of a command of their own, for faults that need no server: started, watched, disturbed, compared."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import fault_evidence as evidence
from fault_evidence import require
from night_captures import fill

NLIGHTS = Path(sys.executable).parent / "nlights"
WATCH = Path(__file__).resolve().parent / "fault_watch"
PATIENCE = 150.0

OWN_PICKLES = ("/numba/", "/dask/tokenize.py", "/docket/execution.py")
"""Who reads pickles of its own: numba its cache of compiled code; dask what it pickled in memory just before;
the Prefect server's list of its own chores, which it keeps in memory."""


class SkippedError(Exception):
    """A fault that cannot be made here; the message says why."""


class Bench:
    """An inbox of small artworks, and what an undisturbed night makes of it.

    Parameters
    ----------
    folder : Path
        For everything.
    artworks, width : int
        How many, and px of the photographs.
    """

    def __init__(self, folder: Path, artworks: int = 2, width: int = 96) -> None:
        self.folder, self.inbox = folder, folder / "inbox"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        list(fill(self.inbox, artworks, width, faults=False))
        run_night(self.inbox, folder / "whole")
        self.products = evidence.digest_of_products(folder / "whole")

    def copy(self, name: str) -> Path:
        """A folder of its own with a copy of the inbox."""
        shutil.copytree(self.inbox, self.folder / name / "inbox")
        return self.folder / name

    def require_products(self, out: Path, store: Path) -> None:
        """See that a night ended with what the undisturbed one made, and left nothing else."""
        evidence.require_whole(store)
        evidence.require_same(self.products, evidence.digest_of_products(out), "products")
        left = evidence.left_about(out, store)
        require(not left, f"is left: {', '.join(left)}")


def environment(more: Mapping[str, str] | None = None) -> dict[str, str]:
    """That of a night without Prefect."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return {**own, **(more or {})}


def watched(log: Path) -> dict[str, str]:
    """What makes a process and its children tell what they publish and which pickles they read."""
    path = [str(WATCH), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(path), "NLIGHTS_WATCHED": str(log)}


def require_no_pickles(log: Path) -> None:
    """See that nothing was unpickled but what `OWN_PICKLES` says.

    Raises
    ------
    FaultError
        With what was, and by whom.
    """
    lines = log.read_text(encoding="utf-8").splitlines()
    read = {
        line for line in lines if line.startswith("pickle ") and not any(own in line for own in OWN_PICKLES)
    }
    require(not read, f"pickles were read: {'; '.join(sorted(read)[:5])}")


@contextlib.contextmanager
def started(
    inbox: Path, out: Path, *words: object, more: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Start a night; what is left of it at the end of the block is killed."""
    process = subprocess.Popen(
        [str(NLIGHTS), "nightly", str(inbox), "--out", str(out), "--settle", "0", *map(str, words)],
        env=environment(more),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def ended(process: subprocess.Popen[str], *codes: int) -> str:
    """Wait for a night's end; returns what it said.

    Raises
    ------
    FaultError
        When it ends with another exit code.
    """
    said, _ = process.communicate(timeout=PATIENCE)
    require(process.returncode in codes, f"the night ended with {process.returncode}: {said[-2000:]}")
    require("Traceback" not in said, said)
    return said


def run_night(
    inbox: Path,
    out: Path,
    *words: object,
    codes: tuple[int, ...] = (0,),
    more: Mapping[str, str] | None = None,
) -> str:
    """Run a night to its end; returns what it said."""
    with started(inbox, out, *words, more=more) as process:
        return ended(process, *codes)


def wait_for(process: subprocess.Popen[str], store: Path, artefacts: int) -> None:
    """Wait until a night has made so many artefacts."""
    until = time.monotonic() + PATIENCE
    while len(evidence.seen(store)) < artefacts:
        require(process.poll() is None and time.monotonic() < until, "the moment of the fault never came")
        time.sleep(0.005)


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """A file system of its own in memory.

    Raises
    ------
    SkippedError
        Where nobody may mount one.
    """
    folder.mkdir(parents=True)
    if os.geteuid() != 0 or not shutil.which("mount"):
        raise SkippedError("only root can mount a small disk")
    words = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SkippedError(f"a small disk cannot be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def remount(folder: Path, how: str, patience: float = 5.0) -> bool:
    """Mount a file system anew, ``ro`` or ``rw``; it is busy while a file is being written."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        words = ["mount", "-o", f"remount,{how}", str(folder)]
        if subprocess.run(words, capture_output=True, check=False).returncode == 0:
            return True
        time.sleep(0.02)
    return False
