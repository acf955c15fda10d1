"""A process of this machine that is started, waited for, stopped and killed, with all that it starts."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any


class ServiceError(Exception):
    """A service that did not start, with the end of its log."""


class Service:
    """One process, with all that it starts, and its log.

    Parameters
    ----------
    name : str
        What it is called in messages; its log is ``<folder>/<name>.log``.
    folder : Path
        Where it keeps its log.
    words : sequence of str
        The command.
    environment : mapping
        Its whole environment.
    ready : callable
        Whether it answers.
    user : str, optional
        As whom it runs, where this process is root's.
    gentle : signal
        What asks it to stop.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        words: Sequence[str | Path],
        environment: Mapping[str, str],
        ready: Callable[[], bool],
        user: str | None = None,
        gentle: signal.Signals = signal.SIGTERM,
    ) -> None:
        self.name, self.words, self.environment = name, list(map(str, words)), dict(environment)
        self.log = folder / f"{name}.log"
        self._ready, self._gentle = ready, gentle
        self._owner = as_user(user)
        self._said_before = 0
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def said(self) -> str:
        """What it has written to its log since it was started last."""
        return self.log.read_bytes()[self._said_before :].decode(errors="replace")

    @property
    def pid(self) -> int | None:
        """Number of its process, which may have ended; None before it was started."""
        return self._process and self._process.pid

    @property
    def running(self) -> bool:
        """Whether its process is there."""
        return self._process is not None and self._process.poll() is None

    def start(self, patience: float = 180.0) -> None:
        """Start it and wait until it answers.

        Raises
        ------
        ServiceError
            When it ends, or does not answer within ``patience`` seconds.
        """
        with self.log.open("ab") as log:
            self._said_before = log.tell()
            self._process = subprocess.Popen(
                self.words,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd="/" if self._owner else self.log.parent,
                start_new_session=True,  # so that ctrl-C reaches us first, and a kill reaches all of it
                **self._owner,
            )
        until = time.monotonic() + patience
        while not self._ready():
            if not self.running or time.monotonic() > until:
                self.kill()
                raise ServiceError(f"{self.name} did not start; the end of {self.log}:\n{self.said[-3000:]}")
            time.sleep(0.2)

    def stop(self, patience: float = 30.0) -> None:
        """Ask it to stop; after ``patience`` seconds it is killed.  Nothing of it stays."""
        if self.running:
            assert self._process is not None
            self._process.send_signal(self._gentle)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(patience)
        self.kill()

    def kill(self, alone: bool = False) -> None:
        """Kill it as a power cut would: at once, with all that it started, or ``alone``."""
        if self._process is None:
            return
        try:
            if alone:
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self._process.wait()


def as_user(name: str | None) -> dict[str, Any]:
    """What makes `subprocess` run a program as another user."""
    if name is None:
        return {}
    import pwd

    user = pwd.getpwnam(name)
    return {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}


def open_to_all(path: Path) -> bool:
    """Whether every user may go into a folder."""
    return all(stat.S_IMODE(part.stat().st_mode) & stat.S_IXOTH for part in (path, *path.parents))


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
