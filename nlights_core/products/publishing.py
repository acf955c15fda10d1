"""Publishing: a tile's products appear whole, where people look for them."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from nlights_core.capture import Tile
from nlights_core.products.writing import WHAT
from nlights_core.store import ArtefactRef, Store, draft_name, link_or_copy, sweep

TRIES = 100
"""How often a run begins anew when others publish the same tile at the same time."""


FORMER = ".former"
"""Folder of an artwork in which products are kept that its number stood for before."""


class Published(NamedTuple):
    """Place of a tile's products.

    Attributes
    ----------
    folder : Path
        The tile's.
    kept : tuple of Path
        Where products of other photographs are now that were in its place.
    """

    folder: Path
    kept: tuple[Path, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what was kept."""
        return tuple(
            f"the number stood for other photographs before; their products are kept in {place}: see that it is right"
            for place in self.kept
        )


def publish(store: Store, tile: Tile, refs: Mapping[str, ArtefactRef], out: Path) -> Published:
    """Put a tile's products where people look for them: ``out/<artwork's folder>/<tile>/``.

    The folder appears whole.  Files are hard links into the store where the file system allows
    (so that they take no second place; they are read-only for that reason), copies otherwise.
    What people added to the folder is kept, but an evaluation of other products is not.

    Products that were made of none of these photographs are another artwork's, or the tile's from another time:
    they are moved, with what people added to them, to ``out/<artwork's folder>/.former/<date>/<tile>/``.

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
    Published
    """
    target = out / tile.folder / tile.name
    former = target.parent / f".former-{tile.name}"
    own = _photographs(store.path(refs["report"]))
    sweep(target.parent)
    kept = _settle(former, target, own)  # a run may have been killed between its two renames
    files = [
        path
        for name in ("maps", "mesh", "report")
        for path in sorted(store.path(refs[name]).iterdir())
        if path.name in WHAT
    ]
    if _published(target, refs["report"], files):
        return Published(target, tuple(kept))
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.parent / draft_name()
    draft.mkdir()
    try:
        for path in files:
            path.chmod(0o444)
            link_or_copy(path, draft / path.name)
        kept += _put(draft, target, former, own)
    except OSError:
        if not _published(target, refs["report"], files):  # else another run was faster
            raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # the artwork's folder, where nothing could be put into it
            target.parent.rmdir()
    return Published(target, tuple(kept))


def _put(draft: Path, target: Path, former: Path, own: frozenset[str]) -> list[Path]:
    """Put a draft in the target's place, with what people added there; returns what was kept elsewhere.

    Other runs may do the same at the same time, each step of theirs between any two of this one.
    Whoever finds things otherwise than expected begins anew.  What people added is in the draft
    before anything is moved, and stays in it from try to try; a folder is deleted only under a name
    that no other run looks at, and only if it is of the same photographs as what is in its place.
    """
    kept = []
    for _ in range(TRIES):
        # In this order: another run moves it from the one place to the other.
        there = next((place for place in (target, former) if place.is_dir()), None)
        if there is None or _are_others(_photographs(there), own) or _take_along(there, draft):
            if there == target:
                _move(target, former)
            if _move(draft, target):
                break
        kept += _settle(former, target, own)
    else:
        raise OSError(errno.EBUSY, "other runs keep publishing the same tile", str(target))
    return kept + _settle(former, target, own)


def _settle(former: Path, target: Path, own: frozenset[str]) -> list[Path]:
    """Bring back what a run has moved aside where nothing stands in its place, else remove it.

    What is of other photographs than what stands there is kept; returns where.
    """
    if not former.is_dir() or _move(former, target):
        return []

    def to_be_kept(folder: Path) -> bool:
        return _are_others(_photographs(folder), _photographs(target) or own)

    # Looked at before it has a name that is swept away when this run is killed, and once more behind that name.
    if to_be_kept(former):
        return _keep(former, target)
    aside = former.parent / draft_name()
    if _move(former, aside) and not _move(aside, target):
        if to_be_kept(aside):
            return _keep(aside, target)
        shutil.rmtree(aside, ignore_errors=True)
    return []


def _keep(folder: Path, target: Path) -> list[Path]:
    """Move products of other photographs to where they are kept; returns where, or nothing if they are gone."""
    date = datetime.now().astimezone().strftime("%Y-%m-%dT%H%M")
    for number in range(1, TRIES):
        place = target.parent / FORMER / (date if number == 1 else f"{date}-{number}") / target.name
        place.parent.mkdir(parents=True, exist_ok=True)
        if _move(folder, place):
            return [place]
        if not folder.is_dir():
            break
    with suppress(OSError):
        place.parent.rmdir()
    return []


def _photographs(folder: Path) -> frozenset[str]:
    """Digests of the photographs of the artwork that some products were made of; empty where nobody knows."""
    try:
        stages = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))["stages"]
        return frozenset(digest for one in stages for digest in (one["facts"].get("frames") or {}).values())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return frozenset()


def _are_others(one: frozenset[str], other: frozenset[str]) -> bool:
    """Test whether two sets of photographs have none in common; False where one is not known."""
    return bool(one and other) and one.isdisjoint(other)


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
