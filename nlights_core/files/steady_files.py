"""Large files that reach the disk while they are written, and do not crowd the memory."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

from xxhash import xxh3_128

from nlights_core.files.content_digests import remember_digest

STEP = 64 << 20
"""Bytes that are written between two flushes."""


class SteadyFile:
    """Writer of a file from its beginning to its end, and flushes it behind the writer's back.

    Nobody then waits for the disk at the end, when the artefact has to be safe before it is renamed, and
    what waits to be written never takes more than two steps of memory.  The file's digest is found on the way
    (`nlights_core.files.content_digests`), so that nobody has to read it again for that.

    Parameters
    ----------
    path : Path
        The file.
    mode : {"xb", "wb", "r+b"}
        As for `open`.
    start : int
        Where writing begins.
    read_soon : bool
        Whether the next stages read the file.  The system's copy of one that they do not read is let go: it
        would take the place of the photographs.

    Raises
    ------
    OSError
        When the file cannot be written, by whichever call is the next.
    """

    def __init__(self, path: Path, mode: str = "xb", *, start: int = 0, read_soon: bool = False) -> None:
        self._file: Any = path.open(mode)
        # What stands before the beginning, such as a header, belongs to the content.
        self._digest = xxh3_128((self._file.read(start) if start else b"").ljust(start, b"\0"))
        self._file.seek(start)
        self._read_soon = read_soon
        self._written = self._flushed = start
        self._pool: ThreadPoolExecutor | None = None
        self._flush: Future[None] | None = None

    def write(self, data: Any) -> None:
        """Append bytes, or anything that holds them in one piece."""
        view = memoryview(data)
        self._file.write(view)
        self._digest.update(view)
        self._written += view.nbytes
        if self._written - self._flushed >= STEP:
            self._flush_behind()

    def _flush_behind(self) -> None:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1)
        if self._flush is not None:
            self._flush.result()
        self._flush = self._pool.submit(self._to_disk, self._written)
        self._flushed = self._written

    def _to_disk(self, size: int) -> None:
        os.fsync(self._file.fileno())
        if not self._read_soon and hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file.fileno(), 0, size, os.POSIX_FADV_DONTNEED)

    def close(self) -> None:
        """Wait for what is being flushed; small files, and the end of large ones, are not flushed."""
        try:
            if self._flush is not None:
                self._flush.result()
        finally:
            if self._pool is not None:
                self._pool.shutdown()
            with self._file as file:
                file.flush()
                status = os.fstat(file.fileno())
        if status.st_size == self._written:
            remember_digest(status, self._digest.hexdigest())

    def __enter__(self) -> SteadyFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
