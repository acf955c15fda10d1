"""Publishing: a tile's products appear whole, where people look for them."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.products.writing import WHAT
from nlights_core.store import ArtefactRef, Store, draft_name, link_or_copy, sweep

TRIES = 100
"""How often a run begins anew when others publish the same tile at the same time."""


def publish(store: Store, tile: Tile, refs: Mapping[str, ArtefactRef], out: Path) -> Path:
    """Put a tile's products where people look for them: ``out/<artwork>/<tile>/``.

    The folder appears whole.  Files are hard links into the store where the file system allows
    (so that they take no second place; they are read-only for that reason), copies otherwise.
    What people added to the folder is kept, but an evaluation of other products is not.

    Parameters
    ----------
    store : Store
    tile : Tile
    refs : mapping
        The artefacts "maps", "mesh" and "report".
    out : Path
        Folder of all products.

    Returns
    -------
    Path
        The tile's folder.
    """
    target = out / tile.artwork / tile.name
    former = target.parent / f".former-{tile.name}"
    sweep(target.parent)
    _settle(former, target)  # a run may have been killed between its two renames
    files = [
        path
        for name in ("maps", "mesh", "report")
        for path in sorted(store.path(refs[name]).iterdir())
        if path.name in WHAT
    ]
    if _published(target, refs["report"], files):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.parent / draft_name()
    draft.mkdir()
    try:
        for path in files:
            path.chmod(0o444)
            link_or_copy(path, draft / path.name)
        _put(draft, target, former)
    except OSError:
        if not _published(target, refs["report"], files):  # else another run was faster
            raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # the artwork's folder, where nothing could be put into it
            target.parent.rmdir()
    return target


def _put(draft: Path, target: Path, former: Path) -> None:
    """Put a draft in the target's place, with what people added there.

    Other runs may do the same at the same time, each step of theirs between any two of this one.
    Whoever finds things otherwise than expected begins anew.  What people added is in the draft
    before anything is moved, and stays in it from try to try; a folder is deleted only under a name
    that no other run looks at.
    """
    for _ in range(TRIES):
        # In this order: another run moves it from the one place to the other.
        there = next((place for place in (target, former) if place.is_dir()), None)
        if there is None or _take_along(there, draft):
            if there == target:
                _move(target, former)
            if _move(draft, target):
                break
        _settle(former, target)
    else:
        raise OSError(errno.EBUSY, "other runs keep publishing the same tile", str(target))
    _settle(former, target)


def _settle(former: Path, target: Path) -> None:
    """Bring back what a run has moved aside where nothing stands in its place, else remove it."""
    if not former.is_dir():
        return
    aside = former.parent / draft_name()
    if not _move(former, target) and _move(former, aside) and not _move(aside, target):
        shutil.rmtree(aside, ignore_errors=True)


def _move(source: Path, target: Path) -> bool:
    """Rename a folder; False where another run was here: nothing to rename, or something in the place."""
    try:
        source.rename(target)
    except OSError as fault:
        if fault.errno not in (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST):
            raise
        return False
    return True


def _take_along(source: Path, draft: Path) -> bool:
    """Copy what people added to a folder; False where another run has moved it meanwhile."""
    before = _inode(source)
    try:
        for path in source.iterdir():
            if path.name not in WHAT and path.name != "evaluation.json":
                _copy(path, draft / path.name)
    except OSError:
        if before is not None and _inode(source) == before:
            raise
        return False
    return _inode(source) == before


def _inode(path: Path) -> int | None:
    """Inode number that tells a folder from another of the same name; None where there is none."""
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None


def _published(target: Path, report: ArtefactRef, files: list[Path]) -> bool:
    try:
        provenance = json.loads((target / "provenance.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return provenance.get("key") == report.key and all((target / path.name).exists() for path in files)


def _copy(source: Path, target: Path) -> None:
    """Copy a file or a folder, in the place of an earlier copy; the original stays until all is in place."""
    if source.is_dir():
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target, symlinks=True)
    else:
        target.unlink(missing_ok=True)
        shutil.copy2(source, target, follow_symlinks=False)
