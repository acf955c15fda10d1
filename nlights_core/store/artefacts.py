"""Artefacts: made once, whole or not at all, and looked at before anything is built on them."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from weakref import WeakValueDictionary

from nlights_core.errors import TileError
from nlights_core.files.content_digests import digest_of_content, remember_digest
from nlights_core.machine.progress import Progress
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.names.photographs import did_you_mean
from nlights_core.store.drafts import discard, draft, sweep
from nlights_core.store.records import (
    RECORD,
    described_files,
    faults_of_files,
    have_sizes,
    read_sealed,
    sealed,
)
from nlights_core.store.references import ArtefactRef, Work, folders_read
from nlights_core.store.whole_files import flush, make_folder, make_writable, write_whole

_reading: WeakValueDictionary[Path, threading.Lock] = WeakValueDictionary()
"""Of files whose digest somebody of this process asks for: who asks meanwhile waits instead of reading too."""

_one_by_one = threading.Lock()


class RottenArtefactError(TileError):
    """An artefact was not what had been written, and was removed: run again, and it is made anew."""


class Store:
    """A folder of artefacts.

    Parameters
    ----------
    root : Path
        Made when it is first written to.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, ref: ArtefactRef) -> Path:
        """Folder of an artefact, whether it exists or not."""
        return self.root / ref.folder

    def has(self, ref: ArtefactRef) -> bool:
        """Test whether an artefact is there, each file of its size, and truly of this key; its bytes are not read."""
        folder = self.path(ref)
        try:
            record = read_sealed(folder / RECORD)
        except (OSError, ValueError):
            return False
        return record.get("key") == ref.key and have_sizes(folder, record.get("files", {}))

    def ensure(
        self, work: Work, progress: Progress = lambda share: None, *, inputs_are_whole: bool = False
    ) -> bool:
        """Make an artefact unless it is there; appear whole or not at all.

        Parameters
        ----------
        work : Work
            What to make.
        progress : callable
            Told the share done.
        inputs_are_whole : bool
            Whether somebody has called `require_whole_inputs` already.

        Returns
        -------
        bool
            Whether it was there already.

        Raises
        ------
        TileError
            As the stage raises it; no half artefact is left.
        RottenArtefactError
            As `require_whole_inputs` raises it.
        OSError
            For a full disk and the like; no half artefact is left.
        """
        target = self.path(work.ref)
        if self.has(work.ref):
            with suppress(OSError):
                os.utime(target)  # it is still needed
            return True
        if not inputs_are_whole:
            self.require_whole_inputs(work)
        make_folder(target.parent)
        sweep(target.parent)
        started = time.monotonic()
        with draft(target.parent) as place:
            place.mkdir()
            work.make(place, progress)
            record = {
                **work.record,
                "files": described_files(place.iterdir()),
                "seconds": round(time.monotonic() - started, 3),
            }
            (place / RECORD).write_text(sealed(record), encoding="utf-8")
            self._publish(place, target, work.ref)
        return False

    def _publish(self, place: Path, target: Path, ref: ArtefactRef) -> None:
        for path in (*place.iterdir(), place):
            flush(path)
        try:
            place.rename(target)
        except OSError:
            if self.has(ref):  # another run was faster and made the same
                return
            if not os.path.lexists(target):
                raise
            discard(target)  # damaged, or twelve digits of another key
            place.rename(target)
        flush(target.parent)

    def require_whole_inputs(self, work: Work) -> None:
        """See that what a stage is about to read is what was written, byte by byte.

        Each file is read once in a process, unless this process has written it.

        Raises
        ------
        RottenArtefactError
            Naming the artefact; it is gone from the store, so that the chain can begin anew.
        """
        for folder, key in folders_read(work.record):
            self.require_whole(self.root / folder, key)

    def require_whole(self, folder: Path, key: str) -> None:
        """See that an artefact is what was written, as `require_whole_inputs`.

        ``key`` is its key, or how that begins.
        """
        try:
            record = read_sealed(folder / RECORD)
            wrong = faults_of_files(folder, record["files"])
            if not record["key"].startswith(key):
                wrong = {RECORD: "is of another artefact"}
        except FileNotFoundError:
            wrong = {RECORD: "is missing"}
        except (OSError, ValueError) as fault:
            wrong = {RECORD: str(fault)}
        if wrong:
            discard(folder)
            what = "; ".join(f"{name}: {fault}" for name, fault in wrong.items())
            raise RottenArtefactError(
                f"{folder}: was damaged on the disk ({what}); it was removed, and is made again by whoever needs it; "
                "see that the disk is well, and whether `nlights verify` finds more"
            )

    def trust(self, ref: ArtefactRef) -> None:
        """Take the record of an artefact for true that a child of this process has just made."""
        folder = self.path(ref)
        with suppress(OSError, ValueError):  # else whoever builds on it finds out
            for name, said in read_sealed(folder / RECORD)["files"].items():
                remember_digest((folder / name).stat(), said["xxh3"])

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder for temporary files, gone afterwards."""
        folder = self.root / ".scratch"
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder)
        with draft(folder) as own:
            own.mkdir()
            yield own

    def digest(self, path: Path, stopped: Callable[[], bool] = lambda: False) -> str:
        """XXH3 digest of a file's content, 32 hexadecimal digits; remembered by path, size and time of change.

        Parameters
        ----------
        path : Path
            Of the file.
        stopped : callable
            Asked now and then whether the digest is no longer wanted.

        Raises
        ------
        TileError
            When the file cannot be read, or reading was stopped.
        """
        with _one_by_one:
            reading = _reading.setdefault(path, threading.Lock())
        with reading:
            try:
                return self._digest(path, stopped)
            except OSError as fault:
                missing = isinstance(fault, FileNotFoundError)
                reason = "there is no such file" if missing else fault.strerror
                raise TileError(
                    f"{path}: cannot be read ({reason}); put the photograph there or correct its name"
                    + (did_you_mean(path) if missing else "")
                ) from fault

    def _digest(self, path: Path, stopped: Callable[[], bool]) -> str:
        if kind := irregular_kind(path):
            raise TileError(
                f"{path}: {kind}, where a file is expected; put the file itself there or correct its name"
            )
        memory, stamp = self._memory(path)
        with suppress(OSError, ValueError):
            known, digest, _ = memory.read_text(encoding="utf-8").split("\n", 2)
            if known == stamp and len(digest) == 32:
                return digest
        digest = digest_of_content(path, stopped)
        self._remember(path, memory, stamp, digest)
        return digest

    def remember_digest(self, path: Path, digest: str) -> None:
        """Remember what the digest of a file is that somebody has just written."""
        self._remember(path, *self._memory(path), digest)

    def _memory(self, path: Path) -> tuple[Path, str]:
        """Place in which a file's digest is remembered, and a stamp by which the file is known to be the same."""
        status = path.stat()
        memory = self.root / ".digests" / hashlib.sha256(os.fsencode(path)).hexdigest()[:32]
        return memory, f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"

    def _remember(self, path: Path, memory: Path, stamp: str, digest: str) -> None:
        if self.root.is_dir():
            named = os.fsencode(path.absolute()).decode("utf-8", "backslashreplace")
            with suppress(OSError):  # else it is read again
                write_whole(memory, f"{stamp}\n{digest}\n{named}", flushed=False)

    def prepare(self) -> None:
        """Make the store's folder, or say why it cannot be written.

        Raises
        ------
        CaptureError
            Naming the folder and the reason.
        """
        make_writable(self.root, "--store")
