"""Files that appear whole or not at all, and stay when the power fails."""

from __future__ import annotations

import os
import shutil
import stat
import uuid
from pathlib import Path

from nlights_core.errors import CaptureError

FICLONE = 0x40049409
"""Linux's request for a reflink (linux/fs.h)."""

WRITE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH


def write_whole(path: Path, text: str, *, flushed: bool = True) -> None:
    """Write a small text file so that it appears whole or not at all.

    Bytes of a file's name that are no UTF-8 become backslash escapes, which JSON reads back as what they were.
    ``flushed`` as false: without waiting for the disk, for what may be lost when the power fails.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.parent / f".{path.name[:40]}-{uuid.uuid4().hex[:8]}"
    try:
        draft.write_text(text, encoding="utf-8", errors="backslashreplace")
        if flushed:
            flush(draft)
        draft.replace(path)
        if flushed:
            flush(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Bring a file or folder to the disk, so that a rename is never ahead of the content."""
    windows = os.name == "nt"
    if windows and path.is_dir():
        return  # its folders cannot be opened
    handle = os.open(path, os.O_RDWR if windows else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(path: Path) -> None:
    """Make a folder and those around it, and bring their names to the disk."""
    missing = []
    while not path.is_dir():
        missing.append(path)
        path = path.parent
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        flush(folder.parent)


def make_writable(folder: Path, option: str) -> None:
    """Make a folder and prove that it can be written.

    Raises
    ------
    CaptureError
        Naming the folder, the reason and the option that chooses another.
    """
    try:
        make_folder(folder)
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
        copy(source, target)


def give_out(source: Path, target: Path, copied: bool = False) -> None:
    """Give people a file of the store's, read-only: nobody should think that it may be changed.

    A reflink where the file system has such: a file of its own that takes no second place.  Else one file of two
    names; else, or where ``copied`` asks for it, a copy.

    Raises
    ------
    OSError
        Naming the target, for a full disk and the like.
    """
    if copied:
        copy(source, target)
    elif not _reflinked(source, target):
        link_or_copy(source, target)
    make_read_only(target)


def copy(source: Path, target: Path) -> None:
    """Copy a file's content, and bring it to the disk.

    Raises
    ------
    OSError
        Naming the target, for a full disk and the like.
    """
    try:
        shutil.copyfile(source, target)
        flush(target)
    except OSError as fault:  # it names the source, which is not at fault
        raise OSError(fault.errno, fault.strerror, str(target)) from fault


def make_read_only(path: Path) -> None:
    """Clear the write bits of a file's mode; who may read it stays as it is."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & WRITE:
        path.chmod(mode & ~WRITE)


def _reflinked(source: Path, target: Path) -> bool:
    """Make a file that shares another's blocks until either is written to; False where the file system cannot."""
    try:
        import fcntl

        with source.open("rb") as there, target.open("xb") as here:
            fcntl.ioctl(here, FICLONE, there.fileno())
            os.fsync(here)
    except (ImportError, OSError):
        target.unlink(missing_ok=True)
        return False
    return True
