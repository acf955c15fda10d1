"""Mappers: digests of large files are found in children, which a file that is truncated may kill."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

from nlights_core.files.digests import by_reading

WORTH = 64 << 20
"""Bytes of a file for which a child is asked: eight such files save what starting the children costs."""

ANSWER = re.compile(rb"[0-9a-f]{32}\n")


class Mapper:
    """Finds one digest at a time, in a child that is started when it is first needed.

    Where the child cannot answer, as when the file was truncated or the memory is full, the file is read in this
    process instead, which says what is wrong with it.
    """

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        self._stopped = False
        self._starting, self._asking = threading.Lock(), threading.Lock()

    def digest(self, path: Path) -> str:
        """Digest of a file's content, 32 hexadecimal digits.

        Raises
        ------
        OSError
            When the file cannot be read, or the mapper was stopped.
        """
        if path.stat().st_size >= WORTH:
            with self._asking:
                if found := self._ask(path):
                    return found
        if self._stopped:
            raise InterruptedError(f"{path}: its digest is no longer asked for")
        return by_reading(path)

    def stop(self) -> None:
        """End the child, whatever it does, also while another thread asks; there will be no other."""
        with self._starting:
            self._stopped = True
            if child := self._child:  # it may be ended meanwhile by who asked
                child.kill()
        with self._asking:  # who asked has heard of it
            self._end()

    def _ask(self, path: Path) -> str | None:
        """What the child answers; None when it could not, and is gone."""
        try:
            child = self._started()
            assert child.stdin
            assert child.stdout
            child.stdin.write(os.fsencode(path.absolute()).hex().encode() + b"\n")
            if ANSWER.fullmatch(answer := child.stdout.read(33)):
                return answer.decode().strip()
        except OSError:
            pass
        self._end()
        return None

    def _started(self) -> subprocess.Popen[bytes]:
        with self._starting:
            if self._stopped:
                raise InterruptedError
            if self._child is None:
                self._child = subprocess.Popen(
                    [sys.executable, "-P", "-m", "nlights_core.files.digests"],
                    bufsize=0,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # what stops a run in a terminal has nothing to say to it
                )
            return self._child

    def _end(self) -> None:
        child, self._child = self._child, None
        if child:
            with child:  # closes its pipes and waits for it
                child.kill()
