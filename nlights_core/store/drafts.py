"""Drafts: folders in the making, each with a mark that dies with its writer.

The mark is a file beside the draft, ``.draft-<name>.lock``, which the writer holds locked.  The operating system
takes the lock back when the writer's process ends, however it ends and on whatever machine: a lock that can be had
tells that nobody writes any more.  Nobody ever waits for one.
"""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = ".draft-"

LOCK = ".lock"

UNLOCKED = b"unlocked"
"""What a mark holds whose writer could not lock it: then only its age tells."""

OLD = 7 * 86400.0
"""Seconds without a change after which a draft that nobody could lock counts as left behind."""


@contextmanager
def draft(folder: Path) -> Iterator[Path]:
    """A name in a folder for what is in the making; what is there when the block ends is removed.

    Parameters
    ----------
    folder : Path
        Where the finished thing will be; it exists.

    Yields
    ------
    Path
        Nothing is there yet.  While the block lasts, `sweep` leaves it alone, on every machine whose
        file system knows of this one's locks.
    """
    place, mark = _marked(folder)
    try:
        yield place
    finally:
        gone = _remove(place)  # else a sweep finds it by its mark
        with suppress(OSError):
            if gone:
                _lock_of(place).unlink()
        os.close(mark)
        with suppress(OSError):  # Windows removes no file that is open
            if gone:
                _lock_of(place).unlink()


def discard(path: Path) -> None:
    """Remove a file or a folder so that nobody ever sees half of it."""
    with suppress(FileNotFoundError), draft(path.parent) as aside:
        path.rename(aside)


def sweep(folder: Path, *, dry: bool = False) -> int:
    """Clear the drafts of a folder that have no writer; returns how many.  ``dry``: only count them.

    Nothing is raised for what cannot be looked at or removed: another sweep may be at it.
    """
    places = {
        path.with_name(path.name.removesuffix(LOCK))
        for path in _entries(folder)
        if path.name.startswith(PREFIX)
    }
    return sum(_sweep(place, dry) for place in places)


def sweep_below(root: Path, *, dry: bool = False) -> int:
    """Clear the drafts without a writer of a whole store, or of all products, as `sweep`; returns how many."""
    folders = [root, root / ".scratch"]
    for artwork in _folders(root):
        folders += [artwork, *_folders(artwork)]
    return sum(sweep(folder, dry=dry) for folder in folders)


def _folders(folder: Path) -> list[Path]:
    found = []
    for path in _entries(folder):
        with suppress(OSError):
            if not path.name.startswith(".") and path.is_dir() and not path.is_symlink():
                found.append(path)
    return found


def _entries(folder: Path) -> list[Path]:
    with suppress(OSError):
        return list(folder.iterdir())
    return []


def _lock_of(place: Path) -> Path:
    return place.with_name(place.name + LOCK)


def _marked(folder: Path) -> tuple[Path, int]:
    """A new draft's name, and its mark, open and locked where that can be."""
    while True:
        place = folder / f"{PREFIX}{uuid.uuid4().hex[:16]}"
        mark = os.open(_lock_of(place), os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            held = _lock(mark)
            if not held:
                os.write(mark, UNLOCKED)
            # Between the two lines above a sweep may have had the lock, and removed the mark.
            if not held or _is_open(_lock_of(place), mark):
                return place, mark
        except BlockingIOError:
            pass
        except BaseException:
            os.close(mark)
            raise
        os.close(mark)


def _lock(mark: int) -> bool:
    """Lock a mark; False where the file system has no locks.

    Raises
    ------
    BlockingIOError
        When somebody holds it.
    """
    try:
        import fcntl

        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except (ImportError, OSError):  # Windows; or a file system without locks
        return False
    return True


def _is_open(path: Path, handle: int) -> bool:
    """Test whether a path still leads to the file that is open."""
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _sweep(place: Path, dry: bool) -> bool:
    """Clear a draft if it has no writer."""
    lock = _lock_of(place)
    try:
        mark = os.open(lock, os.O_RDWR)
    except FileNotFoundError:  # its writer ends just now, or it is of an earlier version
        return _is_old(place, lock) and (dry or _remove(place))
    except OSError:
        return False
    try:
        if (not _lock(mark) or os.read(mark, len(UNLOCKED)) == UNLOCKED) and not _is_old(place, lock):
            return False
        if not _is_open(lock, mark):
            return False
        if dry:
            return True
        if not _remove(place):
            return False
        lock.unlink(missing_ok=True)
    except OSError:  # BlockingIOError above all: its writer lives
        return False
    finally:
        os.close(mark)
    return True


def _is_old(place: Path, lock: Path) -> bool:
    """Test whether nothing of a draft changed for long."""
    newest = 0.0
    for path in (lock, place, *_entries(place)):
        with suppress(OSError):
            newest = max(newest, path.lstat().st_mtime)
    return newest > 0 and time.time() - newest > OLD


def _remove(path: Path) -> bool:
    """Remove a file or a folder; returns whether nothing is left."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
    return not os.path.lexists(path)
