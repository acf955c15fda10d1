"""Folders in which compiled loops are kept between processes, and digests by which they are found again.

What numba compiled is found by a digest of all sources that it was made of, not by a file's place or date: the
same code in another folder, or touched, finds it.  It is kept in a folder of the user's; `nlights doctor --warm`
also puts it into the installation, for accounts that have no home.  It holds code, so a folder counts only
where nobody else can write.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import sysconfig
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

import platformdirs

from nlights_core.machine.sources import CORE, digest_of_files, reached_files
from nlights_core.machine.targets import Target, supported_targets

INSTALLED = Path(sys.prefix) / "share" / "nlights" / "compiled"
"""Of the installation."""

MAKERS = ("numba", "llvmlite", "numpy")
"""Packages whose versions decide what is compiled."""

PREPARED = "prepared-"
"""Beginning of the mark that all loops are compiled."""


def users_folder() -> Path | None:
    """The user's own folder, or the one that ``NUMBA_CACHE_DIR`` names; None where there is no home."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(chosen) if chosen else platformdirs.user_cache_path("nlights") / "compiled"
    return folder if folder.is_absolute() or chosen else None


def folders() -> list[Path]:
    """Folders in which compiled loops are looked for."""
    own = users_folder()
    return [folder for folder in (INSTALLED, own) if folder is not None and is_trusted(folder)]


def writable_folder() -> Path | None:
    """The folder to which newly compiled loops go: the user's, or else the installation's, or none."""
    for folder in (users_folder(), INSTALLED):
        if folder is None:
            continue
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o755)
        except OSError:
            continue
        if os.access(folder, os.W_OK) and is_trusted(folder):
            return folder
    return None


def is_trusted(folder: Path) -> bool:
    """Tell whether what a folder holds was put there by this user, by root or by the installation's owner."""
    try:
        status = folder.stat()
    except OSError:
        return False
    if not hasattr(os, "getuid"):  # Windows keeps home folders apart by other means
        return True
    owners = {0, os.getuid(), Path(sys.prefix).stat().st_uid}
    return status.st_uid in owners and not status.st_mode & 0o022


@cache
def place_of(module: str) -> str:
    """Name the folder of a module's compiled loops by all that they are made of.

    Parameters
    ----------
    module : str
        As ``"nlights_core.solving.compiled_fits"``.

    Returns
    -------
    str
        The module's name within the core, and 16 hexadecimal digits.
    """
    return f"{module.partition('.')[2]}-{_digest([module])}"


def _digest(modules: list[str]) -> str:
    sources = digest_of_files(reached_files(modules), CORE)
    made_by = " ".join(f"{name} {version(name)}" for name in MAKERS)
    return hashlib.sha256(f"{sources} {made_by}".encode()).hexdigest()[:16]


def kernel_modules() -> list[str]:
    """Modules of the core that hold compiled loops."""
    files = sorted(CORE.rglob("compiled_*.py"))
    return [".".join(("nlights_core", *file.relative_to(CORE).with_suffix("").parts)) for file in files]


@cache
def _mark() -> str:
    return f"{PREPARED}{sysconfig.get_python_version()}-{_digest(kernel_modules())}-"


def is_prepared(target: str) -> bool:
    """Tell whether the loops of all bundled algorithms are compiled, of this very code and for a kind of processors.

    Parameters
    ----------
    target : str
        Name of a `nlights_core.machine.targets.Target`, or `nlights_core.machine.targets.NATIVE`.
    """
    return any((folder / f"{_mark()}{target}").exists() for folder in folders())


def set_prepared(target: str) -> None:
    """Remember that they are."""
    folder = writable_folder()
    if folder is not None:
        with suppress(OSError):
            (folder / f"{_mark()}{target}").touch()


def chosen_target() -> Target | None:
    """Choose for which kind of processors this process compiles, and whose loops it loads.

    Returns
    -------
    Target or None
        The fastest of those that are prepared; where none is, the fastest that the processor can run.  None: what
        the compiler makes for this very processor.
    """
    able = supported_targets()
    return next((target for target in able if is_prepared(target.name)), able[0] if able else None)


def install() -> Path | None:
    """Copy what is kept for this very code from the user's folder to the installation, where that can be written.

    What the installation holds of other code is deleted.

    Returns
    -------
    Path or None
        Where it is now; None where nothing can be kept at all.
    """
    source = writable_folder()
    if source is None or source == INSTALLED:
        return source
    try:
        INSTALLED.mkdir(parents=True, exist_ok=True, mode=0o755)
    except OSError:
        return source
    if not (os.access(INSTALLED, os.W_OK) and is_trusted(INSTALLED)):
        return source
    current = {place_of(module) for module in kernel_modules()}
    for old in INSTALLED.iterdir():
        if old.is_dir() and old.name not in current:
            shutil.rmtree(old, ignore_errors=True)
        elif old.name.startswith(PREPARED) and not old.name.startswith(_mark()):
            old.unlink(missing_ok=True)
    for name in current:
        if (source / name).is_dir():
            shutil.copytree(source / name, INSTALLED / name, dirs_exist_ok=True)
    for mark in source.glob(f"{_mark()}*"):
        (INSTALLED / mark.name).touch()
    return INSTALLED
