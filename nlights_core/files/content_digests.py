"""Digests of files: XXH3-128, found while a file is written, or by reading it once.

What this process has written or read is remembered by inode, size and time of writing: a file that was renamed, or
has a second name, is not read again.
"""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from xxhash import xxh3_128

from nlights_core.machine.band_threads import in_order

CHUNK = 1 << 20
"""Bytes that are read and hashed at a time: they fit into a core's cache, and seldom ask for Python's lock."""

REMEMBERED = 4096
"""Files, at most: those of some forty tiles."""

_known: dict[tuple[int, int], tuple[int, int, str]] = {}
"""By device and inode: size, time of writing (ns) and digest."""

_lock = threading.Lock()


def digest_of_content(path: Path, stopped: Callable[[], bool] = lambda: False) -> str:
    """XXH3 digest of a file, 32 hexadecimal digits; reads it whole.

    Parameters
    ----------
    path : Path
        Of a regular file.
    stopped : callable
        Asked now and then whether the digest is no longer wanted.

    Raises
    ------
    OSError
        When the file cannot be read, or reading was stopped (`InterruptedError`).
    """
    content, chunk = xxh3_128(), memoryview(bytearray(CHUNK))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(chunk):
            content.update(chunk[:count])
            if stopped():
                raise InterruptedError(errno.EINTR, "no longer asked for", str(path))
    return content.hexdigest()


def digest_of_file(path: Path) -> str:
    """XXH3 digest of a file, 32 hexadecimal digits; read only where this process does not know it.

    Raises
    ------
    OSError
        When the file cannot be read.
    """
    before = path.stat()
    known = _known.get((before.st_dev, before.st_ino))
    if known is not None and known[:2] == (before.st_size, before.st_mtime_ns):
        return known[2]
    digest = digest_of_content(path)
    remember_digest(before, digest)
    return digest


def digests_of_files(paths: Iterable[Path]) -> dict[str, str]:
    """Digests of files by their names, as `digest_of_file`, several at a time."""
    files = list(paths)
    return {path.name: digest for path, digest in zip(files, in_order(digest_of_file, files), strict=True)}


def remember_digest(status: os.stat_result, digest: str) -> None:
    """Remember the digest of the file that a status is of."""
    with _lock:
        _known[status.st_dev, status.st_ino] = status.st_size, status.st_mtime_ns, digest
        if len(_known) > REMEMBERED:
            del _known[next(iter(_known))]  # the oldest
