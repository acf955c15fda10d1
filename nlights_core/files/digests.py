"""Digests of files: XXH3 of their content, 128 bits, by reading them or by mapping them into the memory.

``python -m nlights_core.files.digests`` is a child that maps: it reads the paths of files, each in hexadecimal
digits in a line of its own, and answers each with a line, the digest.  It starts for every
tile, so it imports little.
"""

from __future__ import annotations

import mmap
import os
import resource
import sys
import threading
from typing import TYPE_CHECKING

from xxhash import xxh3_128

if TYPE_CHECKING:  # it takes as long to import as all the rest
    from pathlib import Path

CHUNK = 1 << 20
"""Bytes that are read and hashed at a time: they fit into a core's cache, and seldom ask for Python's lock."""

PIECE = 16 << 20
"""Bytes that are mapped at a time: larger ones are not faster, and a child that is to end waits for one."""


def by_reading(path: Path) -> str:
    """Digest of a file that is copied out of the page cache, 32 hexadecimal digits.

    Raises
    ------
    OSError
        When it cannot be read.
    """
    content, chunk = xxh3_128(), memoryview(bytearray(CHUNK))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(chunk):
            content.update(chunk[:count])
    return content.hexdigest()


def by_mapping(path: str | Path) -> str:
    """Digest of a file that is hashed where the page cache has it: the same, in two thirds of the time.

    A file that is truncated meanwhile kills the process (SIGBUS), so this is for a child.

    Raises
    ------
    OSError, ValueError
        When it cannot be read, or became shorter between two pieces.
    """
    content = xxh3_128()
    # All pages of a piece at once are cheaper than a fault for every few of them; macOS cannot.
    flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
    file = os.open(path, os.O_RDONLY)
    try:
        size = os.fstat(file).st_size
        for start in range(0, size, PIECE):
            with mmap.mmap(file, min(PIECE, size - start), flags, mmap.PROT_READ, offset=start) as piece:
                content.update(piece)
    finally:
        os.close(file)
    return content.hexdigest()


def main() -> None:
    """Answer until nobody asks any more; a child that cannot answer ends."""
    # What a truncated file kills would leave a core file.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin:
        path = os.fsdecode(bytes.fromhex(line))
        # In another thread, so that the end of who asks is noticed while a large file is hashed.
        threading.Thread(target=_answer, args=(path,), daemon=True).start()
    os._exit(0)


def _answer(path: str) -> None:
    try:
        digest = by_mapping(path)
    except (OSError, ValueError, MemoryError):
        os._exit(1)
    os.write(1, digest.encode() + b"\n")


if __name__ == "__main__":
    main()
