"""Claims: advisory marks in the store by which two nights on one inbox seldom do the same work twice.

The store is safe without them: who makes the same artefact twice has lost time and nothing else.
A claim is a file ``STORE/.claims/<artwork>/<tile>``, made exclusively and touched every few
seconds while its tile runs; one that nobody touches any more is stale and may be taken.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import uuid
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from nlights_core.names.artworks import folder_of

TOUCHED = 5.0
"""Seconds after which a held claim is touched again."""

STALE = 30.0
"""Seconds without a touch after which its holder counts as dead."""


class Claims:
    """The claims of one run; a context, at whose end all that are still held are given back.

    Parameters
    ----------
    store : Path
        Root of the store.
    """

    def __init__(self, store: Path) -> None:
        self.folder = store / ".claims"
        self.run = uuid.uuid4().hex
        self._held: set[Path] = set()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._toucher = threading.Thread(target=self._keep_touching, name="claims", daemon=True)

    def __enter__(self) -> Claims:
        self._toucher.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._toucher.join()
        for path in list(self._held):
            self._give_back(path)

    def take(self, artwork: str, tile: str) -> bool:
        """Claim a tile; False when somebody else is at it."""
        path = self._path(artwork, tile)
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.taken(artwork, tile) or not (self._create(path)):
            return False
        with self._lock:
            self._held.add(path)
        return True

    def give_back(self, artwork: str, tile: str) -> None:
        """Give a claim back; nothing happens when it is not held."""
        self._give_back(self._path(artwork, tile))

    def taken(self, artwork: str, tile: str) -> bool:
        """Test whether somebody else is at a tile.  A stale claim is cleared away."""
        path = self._path(artwork, tile)
        try:
            claimed = path.stat()
            idle = self._now(path.parent) - claimed.st_mtime
        except OSError:  # there is no claim
            return False
        if path in self._held:
            return False
        if idle <= STALE:
            return True
        return not self._clear(path, claimed)

    def holder(self, artwork: str, tile: str) -> str:
        """Name who is at a tile, for people."""
        try:
            claim = json.loads(self._path(artwork, tile).read_text(encoding="utf-8"))
            return f"process {claim['process']} on {claim['machine']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "another run"

    def _path(self, artwork: str, tile: str) -> Path:
        return self.folder / folder_of(artwork) / tile

    def _create(self, path: Path) -> bool:
        claim = {"machine": socket.gethostname(), "process": os.getpid(), "run": self.run}
        try:
            with path.open("x", encoding="utf-8") as file:
                json.dump(claim, file)
        except FileExistsError:
            return False
        return True

    def _now(self, folder: Path) -> float:
        """Time by the clock that dates the claims: that of the file system, not of this machine."""
        probe = folder / f".now-{uuid.uuid4().hex}"  # several threads may ask at once
        probe.touch()
        try:
            return probe.stat().st_mtime
        finally:
            probe.unlink(missing_ok=True)

    def _clear(self, path: Path, judged: os.stat_result) -> bool:
        """Take a stale claim out of the way; of several who try, one succeeds."""
        aside = path.parent / f".stale-{uuid.uuid4().hex}"
        try:
            path.rename(aside)
            found = aside.stat()
            same = (found.st_ino, found.st_mtime_ns) == (judged.st_ino, judged.st_mtime_ns)
            if not same:  # somebody has claimed it anew in between: theirs goes back
                with suppress(FileExistsError):
                    os.link(aside, path)
            aside.unlink()
        except OSError:
            return False
        return same

    def _give_back(self, path: Path) -> None:
        with self._lock:
            if path not in self._held:
                return
            self._held.discard(path)
        with suppress(OSError, ValueError, AttributeError):
            if json.loads(path.read_text(encoding="utf-8")).get("run") == self.run:
                path.unlink()

    def _keep_touching(self) -> None:
        while not self._ended.wait(TOUCHED):
            with self._lock:
                held = list(self._held)
            for path in held:
                with suppress(OSError):  # cleared away by somebody who thought it stale
                    os.utime(path)
