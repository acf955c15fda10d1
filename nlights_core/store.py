"""The store: artefacts in folders that are named by what made them.

The store is the cache.  An artefact's key is the digest of its stage, its algorithm with every
option, the code that it rests on and the keys of its inputs: a Merkle chain that is known before
anything runs.  A folder is written as a draft and renamed whole; two runs that
race make the same thing, so there is no lock.  Deleting any folder is safe.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xxhash import xxh3_128

from nlights_core import __version__
from nlights_core.algorithms import Algorithm
from nlights_core.errors import CaptureError, TileError
from nlights_core.machine.progress import Progress
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.machine.sources import EVERYTHING_RESTS_ON, digests_of_places
from nlights_core.names.artworks import folder_of
from nlights_core.names.photographs import did_you_mean
from nlights_core.registry import code_digest, installed, is_bundled

RECORD = "artefact.json"

CHUNK = 1 << 20
"""Bytes that are read and hashed at a time: they fit into a core's cache, and seldom ask for Python's lock."""

_reading: dict[Path, threading.Lock] = {}
"""Of files whose digest somebody of this process asked for: who asks meanwhile waits instead of reading too."""


@dataclass(frozen=True)
class ArtefactRef:
    """Name of an artefact: all that a flow ever passes on.

    Attributes
    ----------
    stage, artwork, tile : str
        Where it belongs.
    key : str
        sha256 of everything that determines its content, 64 hexadecimal digits.
    """

    stage: str
    artwork: str
    tile: str
    key: str

    @property
    def folder(self) -> str:
        """Path of the folder, relative to the store."""
        return f"{folder_of(self.artwork)}/{self.tile}/{self.stage}-{self.key[:12]}"


@dataclass(frozen=True)
class Work:
    """Plan of a stage: the artefact's name, why it would exist, and how to make it.

    Attributes
    ----------
    ref : ArtefactRef
        Known before anything runs.
    record : dict
        Why the artefact exists, in full: stage, algorithm, code, core, inputs.
    make : callable
        Fills an empty folder; nothing else is written.
    """

    ref: ArtefactRef
    record: dict[str, Any]
    make: Callable[[Path, Progress], None]


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
        """Test whether an artefact is there, whole, and truly of this key."""
        try:
            record = json.loads((self.path(ref) / RECORD).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        if record.get("key") != ref.key:
            return False
        sizes = {path.name: path.stat().st_size for path in self.path(ref).iterdir()}
        return all(sizes.get(name) == size for name, size in record.get("files", {}).items())

    def ensure(self, work: Work, progress: Progress = lambda share: None) -> bool:
        """Make an artefact unless it is there; appear whole or not at all.

        Returns
        -------
        bool
            Whether it was there already.

        Raises
        ------
        TileError
            As the stage raises it; no half artefact is left.
        OSError
            For a full disk and the like; no half artefact is left.
        """
        if self.has(work.ref):
            return True
        target = self.path(work.ref)
        target.parent.mkdir(parents=True, exist_ok=True)
        sweep(target.parent)
        draft = target.parent / draft_name()
        started = time.monotonic()
        try:
            draft.mkdir()
            work.make(draft, progress)
            record = {
                **work.record,
                "files": {path.name: path.stat().st_size for path in sorted(draft.iterdir())},
                "seconds": round(time.monotonic() - started, 3),
            }
            (draft / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            self._publish(draft, target, work.ref)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
        return False

    def _publish(self, draft: Path, target: Path, ref: ArtefactRef) -> None:
        for path in (*draft.iterdir(), draft):
            _flush(path)
        try:
            draft.rename(target)
        except OSError:
            if self.has(ref):  # another run was faster and made the same
                return
            if not target.exists():
                raise
            shutil.rmtree(target)  # damaged, or twelve digits of another key
            draft.rename(target)
        _flush(target.parent)

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder for temporary files, gone afterwards."""
        folder = self.root / ".scratch"
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder)
        own = folder / draft_name()
        own.mkdir()
        try:
            yield own
        finally:
            shutil.rmtree(own, ignore_errors=True)

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
        with _reading.setdefault(path, threading.Lock()):
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
        status = path.stat()
        memory = self.root / ".digests" / hashlib.sha256(str(path).encode()).hexdigest()[:32]
        stamp = f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"
        with suppress(OSError):
            known, _, digest = memory.read_text().partition("\n")
            if known == stamp and len(digest) == 32:
                return digest
        digest = _digest_of_content(path, stopped)
        if self.root.is_dir():
            write_whole(memory, f"{stamp}\n{digest}")
        return digest

    def prepare(self) -> None:
        """Make the store's folder, or say why it cannot be written.

        Raises
        ------
        CaptureError
            Naming the folder and the reason.
        """
        make_writable(self.root, "--store")


def _digest_of_content(path: Path, stopped: Callable[[], bool]) -> str:
    content, chunk = xxh3_128(), memoryview(bytearray(CHUNK))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(chunk):
            content.update(chunk[:count])
            if stopped():
                raise InterruptedError(errno.EINTR, "no longer asked for", str(path))
    return content.hexdigest()


def make_writable(folder: Path, option: str) -> None:
    """Make a folder and prove that it can be written.

    Raises
    ------
    CaptureError
        Naming the folder, the reason and the option that chooses another.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe-{uuid.uuid4().hex[:8]}"
        probe.touch()
        probe.unlink()
    except OSError as fault:
        raise CaptureError(
            f"{folder}: cannot be written ({fault.strerror}); choose another folder with {option} or "
            "change its permissions"
        ) from fault


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, so that it takes no second place; copy it where the file system cannot.

    Raises
    ------
    OSError
        Naming the target, for a full disk and the like.
    """
    try:
        os.link(source, target)
    except OSError:
        try:
            shutil.copyfile(source, target)
        except OSError as fault:  # it names the source, which is not at fault
            raise OSError(fault.errno, fault.strerror, str(target)) from fault


def write_whole(path: Path, text: str) -> None:
    """Write a small text file so that it appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.parent / f".{path.name[:40]}-{uuid.uuid4().hex[:8]}"
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def describe(
    stage: str,
    artwork: str,
    tile: str,
    *,
    rests_on: Iterable[str] = (),
    algorithm: Algorithm | None = None,
    inputs: Mapping[str, ArtefactRef | None] | None = None,
    facts: Mapping[str, Any] | None = None,
) -> tuple[ArtefactRef, dict[str, Any]]:
    """Name an artefact by everything that determines its content.

    Parameters
    ----------
    stage, artwork, tile : str
        Where it belongs.
    rests_on : iterable of str
        Departments of the core whose code decides its content, beside that of the stage itself and
        `nlights_core.machine.sources.EVERYTHING_RESTS_ON`.
    algorithm : Algorithm, optional
        Its name, options and code enter the key.
    inputs : mapping of names to artefacts, optional
        Their keys enter the key.
    facts : mapping, optional
        JSON values that enter the key: digests of files, settings of the capture.

    Returns
    -------
    ref : ArtefactRef
    record : dict
        The same in full, for ``artefact.json``.
    """
    given = {name: ref for name, ref in (inputs or {}).items() if ref is not None}
    origin = installed().origin(algorithm) if algorithm else None
    places = (*EVERYTHING_RESTS_ON, f"stages.{stage}", *rests_on)
    cause: dict[str, Any] = {
        "stage": stage,
        "code": digests_of_places(places),
        "algorithm": None
        if algorithm is None
        else {
            "use": algorithm.name,
            "options": algorithm.model_dump(mode="json"),
            "code": code_digest(type(algorithm)),
            # Its authors may ship more than code; what nLights ships with a version is in the code already.
            "version": None if is_bundled(type(algorithm)) else origin,
        },
        "inputs": {name: ref.key for name, ref in given.items()},
        "facts": dict(facts or {}),
    }
    key = hashlib.sha256(json.dumps(cause, sort_keys=True).encode()).hexdigest()
    # What follows the cause says more, but decides nothing: another version with the same code makes the same.
    record = {
        "artwork": artwork,
        "tile": tile,
        "key": key,
        **cause,
        "nlights": __version__,
        "origin": origin,
        "input_folders": {name: ref.folder for name, ref in given.items()},
    }
    return ArtefactRef(stage, artwork, tile, key), record


def draft_name() -> str:
    """Name the machine and the process, so that only dead ones' drafts are ever swept."""
    return f".draft-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


def sweep(folder: Path) -> None:
    """Clear drafts that a killed process of this machine left in a folder."""
    for draft in folder.glob(f".draft-{socket.gethostname()}-*"):
        if not _alive(int(draft.name.rsplit("-", 2)[1])):
            shutil.rmtree(draft, ignore_errors=True)


def _flush(path: Path) -> None:
    """Bring a file or folder to the disk, so that a rename is never ahead of the content."""
    windows = os.name == "nt"
    if windows and path.is_dir():
        return  # its folders cannot be opened
    handle = os.open(path, os.O_RDWR if windows else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _alive(process: int) -> bool:
    if os.name == "nt":
        return True  # there, signal 0 is Ctrl-C; a draft of the dead then stays until somebody deletes it
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
