"""Power that fails: what a disk holds of some folders when only what was flushed has reached it.

A file is as it was when it was last flushed; a folder has the names that it had when it was last flushed.
What is flushed is looked at right before the flush happens, and stays open, so that its number (inode) goes
to no other file.
"""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fault_calls import Call

WAYS = ("nothing", "empty", "zeros", "half")
"""What becomes of what was not flushed: the names are lost too; or the names are kept, and the files are empty,
zeros of the right length, or broken off in the middle."""

Content = bytes | dict[str, int]
"""Of a file; or names in a folder, with their numbers."""


@dataclass
class Disk:
    """What has reached the disk of some folders.

    Parameters
    ----------
    folders : sequence of Path
        What lies in them at the beginning is on the disk.
    """

    folders: Sequence[Path]
    flushed: dict[int, Content] = field(default_factory=dict)
    modes: dict[int, int] = field(default_factory=dict)
    kept_open: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        for folder in self.folders:
            for path in (folder, *folder.rglob("*")):
                self._flush(path)

    def told(self, call: Call) -> None:
        """Take note of a call: only flushes mean anything."""
        if call.kind == "flush":
            self._flush(call.opened)

    def close(self) -> None:
        """Let go of everything that was kept open."""
        while self.kept_open:
            os.close(self.kept_open.pop())

    def lose(self, way: str) -> None:
        """Make the folders what they are when the power has failed, in one of `WAYS`, a day ago."""
        trees = {folder: self._left(folder, way) for folder in self.folders}
        for folder, tree in trees.items():
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            made: dict[int, Path] = {}
            for name, (number, content, mode) in tree.items():
                _make(folder / name, number, content, mode, made)
            yesterday = time.time() - 86400
            for path in (folder, *folder.rglob("*")):
                os.utime(path, (yesterday, yesterday), follow_symlinks=False)

    def _flush(self, path: Path) -> None:
        handle = os.open(path, os.O_RDONLY)
        self.kept_open.append(handle)
        status = os.fstat(handle)
        self.modes[status.st_ino] = status.st_mode & 0o777
        self.flushed[status.st_ino] = self._names(handle) if path.is_dir() else _read(handle)

    def _names(self, handle: int) -> dict[str, int]:
        found = {}
        for name in os.listdir(handle):
            kept = os.open(name, os.O_PATH | os.O_NOFOLLOW, dir_fd=handle)
            self.kept_open.append(kept)
            status = os.fstat(kept)
            found[name] = status.st_ino
            if stat.S_ISDIR(status.st_mode):  # it is known to be a folder, but not what is in it
                self.flushed.setdefault(status.st_ino, {})
                self.modes.setdefault(status.st_ino, status.st_mode & 0o777)
        return found

    def _left(self, folder: Path, way: str) -> dict[str, tuple[int, bytes | None, int]]:
        """By path: number, content (None: a folder) and mode."""
        if way == "nothing":
            return dict(self._flushed_below(folder.stat().st_ino, ""))
        found: dict[str, tuple[int, bytes | None, int]] = {}
        for path in sorted(folder.rglob("*")):
            status = path.stat()
            content = None
            if path.is_file():
                content = path.read_bytes()
                if self.flushed.get(status.st_ino) != content:
                    content = _SPOILT[way](content)
            found[path.relative_to(folder).as_posix()] = (status.st_ino, content, status.st_mode & 0o777)
        return found

    def _flushed_below(self, number: int, name: str) -> Iterator[tuple[str, tuple[int, bytes | None, int]]]:
        names = self.flushed.get(number, {})
        assert isinstance(names, dict)
        for inside, other in sorted(names.items()):
            content = self.flushed.get(other)
            path = f"{name}{inside}"
            if isinstance(content, dict):
                yield path, (other, None, self.modes[other])
                yield from self._flushed_below(other, f"{path}/")
            else:
                yield path, (other, content or b"", self.modes.get(other, 0o644))


_SPOILT: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "zeros": lambda content: bytes(len(content)),
    "half": lambda content: content[: len(content) // 2],
}


def _read(handle: int) -> bytes:
    parts = []
    while part := os.read(handle, 1 << 20):
        parts.append(part)
    return b"".join(parts)


def _make(path: Path, number: int, content: bytes | None, mode: int, made: dict[int, Path]) -> None:
    """Make a file or folder as it was; one that has two names gets both."""
    if content is None:
        path.mkdir()
    elif number in made:
        os.link(made[number], path)
    else:
        path.write_bytes(content)
        path.chmod(mode)
        made[number] = path
