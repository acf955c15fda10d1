"""Children: work in a process of its own, which may hang, crash or fill the memory alone.

A child is ``python -m MODULE``, whose main calls `answer`.  It reads one job, a line of JSON, and
answers with lines of JSON; the parent holds it as a `Child`.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from nlights_core.memory import GIB, allowed, budget

ROOM = 2 * GIB
"""What a child may take above the memory budget: Python, its libraries, the stacks of threads."""

LAST_WORDS = 0.5
"""Seconds in which a child that is stopped writes down where it was."""

ASKED: signal.Signals | None = getattr(signal, "SIGUSR1", None)
"""By which a child is asked to write down where it is; Windows has no such signal."""

KILLED = -9
"""Exit code of a child that the system killed (SIGKILL)."""

SECRET = re.compile(
    r"PASSWORD|PASSWD|PASSPHRASE|SECRET|TOKEN|CREDENTIAL|APIKEY|^PREFECT|DATABASE_URL|CONNECTION_(URL|STRING)"
    r"|(^|_)(KEYS?|PASS|AUTH|DSN|COOKIE|SESSION|PAT)(_|$)|_PWD$|^PG(PASS|SERVICE)"
)
"""Names of variables that no child is told."""

PASSWORD_IN_ADDRESS = re.compile(r"://[^/@\s]*:[^/@\s]*@")

FRAME = re.compile(r'File "(?P<file>.*)", line (?P<line>\d+) in (?P<function>\S+)')


class Child:
    """A child at work: what it says, and when it is stopped.

    Parameters
    ----------
    process : Popen
        Leads a session of its own.
    trace : Path
        Where it writes down where it was, when it crashes or is stopped.
    timeout : float or None
        Seconds from `start_clock` on after which it is stopped; None: never.
    """

    def __init__(self, process: subprocess.Popen[str], trace: Path, timeout: float | None) -> None:
        self._process, self._trace, self._timeout = process, trace, timeout
        self._stopped = threading.Event()
        self._clock: threading.Timer | None = None

    def start_clock(self) -> None:
        """Count the time-out from now on."""
        self.stop_clock()
        if self._timeout is not None:
            self._clock = threading.Timer(self._timeout, self._stop)
            self._clock.daemon = True
            self._clock.start()

    def stop_clock(self) -> None:
        """Count no more."""
        if self._clock:
            self._clock.cancel()

    def words(self) -> Iterator[dict[str, Any]]:
        """Messages of the child, until it ends."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            yield json.loads(line)

    def frames(self) -> list[dict[str, str]]:
        """Frames in which it was, innermost first: "file", "line" and "function" of each frame of each thread."""
        if not self._trace.exists():
            return []
        seen = self._trace.read_text(encoding="utf-8", errors="replace")
        return [match.groupdict() for match in FRAME.finditer(seen)]

    def ending(self, place: str, remedy: str) -> str:
        """Clause on how it ended without its last word, and what to do: what a sentence says after its subject."""
        code = self._process.returncode
        if self._stopped.is_set():
            return f"was stopped after {self._timeout:g} s{place}; allow more with --timeout, {remedy}"
        if code == KILLED:
            return (
                f"was killed by the system{place}, most often because the memory was full; close other "
                f"programs, {remedy}"
            )
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        return f"crashed ({how}){place}; {remedy}"

    def _stop(self) -> None:
        self._stopped.set()
        if ASKED is not None:
            _signal(self._process, ASKED)
            time.sleep(LAST_WORDS)
        _kill(self._process)


@contextlib.contextmanager
def child(
    module: str,
    job: Mapping[str, Any],
    scratch: Path,
    timeout: float | None = None,
    environment: Mapping[str, str] | None = None,
) -> Iterator[Child]:
    """Start a child; it has ended, by itself or not, when the block ends.

    Parameters
    ----------
    module : str
        Its main calls `answer`.
    job : mapping
        JSON values: what it has to do.
    scratch : Path
        A folder of the parent's, for the child's last words.
    timeout : float, optional
        Seconds after which it is stopped once `Child.start_clock` was called.
    environment : mapping, optional
        Variables that it gets beside this process's own, of which it gets no secrets (`without_secrets`).
    """
    trace = scratch / "trace.txt"
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", module],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        env={**without_secrets(os.environ), **(environment or {})},
        start_new_session=True,  # so that what it starts is stopped along with it
    )
    started = Child(process, trace, timeout)
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it may have died already
            process.stdin.write(json.dumps({**job, "trace": str(trace), "memory": budget()}) + "\n")
            process.stdin.flush()
        yield started
    finally:
        started.stop_clock()
        _finish(process)


def without_secrets(variables: Mapping[str, str]) -> dict[str, str]:
    """Variables of the environment, but for those that hold a secret, or lead to where one is, by their names.

    Nothing in a child needs any: it opens no connection.  Prefect's own are left out whatever they hold.

    Examples
    --------
    >>> without_secrets({"PATH": "/bin", "DB_PASSWORD": "x", "PREFECT_API_URL": "x", "A": "http://me:pw@host/"})
    {'PATH': '/bin'}
    """
    return {
        name: value
        for name, value in variables.items()
        if not SECRET.search(name.upper()) and not PASSWORD_IN_ADDRESS.search(value)
    }


def _finish(process: subprocess.Popen[str]) -> None:
    """End a child: one that has answered goes when its input closes, any other is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
    try:
        process.wait(LAST_WORDS)
    except subprocess.TimeoutExpired:
        pass
    finally:
        _kill(process)
        process.wait()


def _signal(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal to a child and to all that it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def _kill(process: subprocess.Popen[str]) -> None:
    """End a child and, where that can be told, all that it started."""
    if hasattr(signal, "SIGKILL"):
        _signal(process, signal.SIGKILL)
    else:
        process.kill()


def answer(work: Callable[[dict[str, Any], Callable[..., None]], None]) -> None:
    """Do the job that stands on the standard input; this is a child's whole main.

    Parameters
    ----------
    work : callable
        ``work(job, say)``; each ``say(name=value, ...)`` is a line that the parent reads.
    """
    # What a plugin prints must not be taken for an answer.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    job = json.loads(sys.stdin.readline())
    with allowed(job["memory"]), Path(job["trace"]).open("w") as trace:
        faulthandler.enable(trace)
        if ASKED is not None:
            faulthandler.register(ASKED, trace)
        threading.Thread(target=_end_with_parent, daemon=True).start()

        def say(**words: Any) -> None:
            answers.write(json.dumps(words) + "\n")
            answers.flush()

        work(job, say)
        faulthandler.disable()
        if ASKED is not None:
            faulthandler.unregister(ASKED)
    os._exit(0)  # threads that a plugin left behind must not keep the process


def _end_with_parent() -> None:
    """Wait until whoever asked for the work is gone; nobody would stop this process then."""
    sys.stdin.read()
    os._exit(1)


def limit_memory(size: int) -> None:
    """Let an allocation fail in this process rather than exhaust the machine.

    Parameters
    ----------
    size : int
        What a tile may take, bytes; `ROOM` is added.  Windows has no such limit.
    """
    if os.name == "nt":
        return
    import resource

    size += ROOM
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limit = size if hard == resource.RLIM_INFINITY else min(size, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
