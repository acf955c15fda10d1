"""Regular files: what may be opened and read to its end."""

from __future__ import annotations

import stat
from pathlib import Path

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def irregular_kind(path: Path) -> str:
    """Kind of what stands at a path, in words, where it is no regular file; empty where it is one.

    Ask before opening: a pipe would let its reader wait for ever, and a device may never end.
    Links are followed.

    Raises
    ------
    OSError
        When there is nothing, or it cannot be looked at.
    """
    mode = path.stat().st_mode
    if stat.S_ISREG(mode):
        return ""
    return next((words for test, words in _KINDS if test(mode)), "no regular file")
