"""Publishing: a tile's products appear whole, where people look for them."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.products.writing import WHAT
from nlights_core.store import RECORD, ArtefactRef, Store, draft, sweep
from nlights_core.store.records import read_sealed
from nlights_core.store.whole_files import flush, give_out, make_folder

PRODUCTS = ("maps", "mesh", "report")
"""Artefacts that hold products."""

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
    remade : tuple of str
        Sentences about artefacts that were damaged and were made again.
    """

    folder: Path
    kept: tuple[Path, ...] = ()
    remade: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what was kept, and what was made again."""
        kept = (
            f"the number stood for other photographs before; their products are kept in {place}: see that it is right"
            for place in self.kept
        )
        return (*kept, *self.remade)


def publish(
    store: Store, tile: Tile, refs: Mapping[str, ArtefactRef], out: Path, *, copied: bool = False
) -> Published:
    """Put a tile's products where people look for them: ``out/<artwork's folder>/<tile>/``.

    The folder appears whole, on the disk too.  Files are reflinks of those in the store where the file system has
    such, else hard links, which take no second place either, else copies; all are read-only.  Where all of them
    are there already, each the store's own file or of the same digest, nothing is done.
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
    copied : bool
        Whether to copy in any case.

    Returns
    -------
    Published

    Raises
    ------
    RottenArtefactError
        When an artefact is not what was written; it is gone from the store, and the products are as before.
    OSError
        For a full disk and the like; the products are as before.
    """
    target = out / tile.folder / tile.name
    former = target.parent / f".former-{tile.name}"
    own = _photographs(store.path(refs["report"]))
    sweep(target.parent)
    files = _files(store, [refs[name] for name in PRODUCTS])
    kept = _settle(former, target, own)  # a run may have been killed between its two renames
    if _published(store, target, files, copied):
        return Published(target, tuple(kept))
    for name in PRODUCTS:
        store.require_whole(store.path(refs[name]), refs[name].key)
    make_folder(target.parent)
    try:
        with draft(target.parent) as place:
            place.mkdir()
            for path in files:
                give_out(path, place / path.name, copied)
            flush(place)
            kept += _put(place, target, former, own)
        flush(target.parent)
        _remember(store, target, files)
    except OSError:
        if not _published(store, target, files, copied):  # else another run was faster
            raise
    finally:
        with suppress(OSError):  # the artwork's folder, where nothing could be put into it
            target.parent.rmdir()
    return Published(target, tuple(kept))


def _files(store: Store, refs: Iterable[ArtefactRef]) -> dict[Path, str]:
    """Files of artefacts that are products, each with its digest."""
    found: dict[Path, str] = {}
    for ref in refs:
        folder = store.path(ref)
        try:
            record = read_sealed(folder / RECORD)
        except ValueError:
            store.require_whole(folder, ref.key)
            raise
        found |= {folder / name: said["xxh3"] for name, said in record["files"].items() if name in WHAT}
    return found


def _remember(store: Store, target: Path, files: Mapping[Path, str]) -> None:
    """Remember the digests of what was copied, so that the next run need not read it."""
    for path, digest in files.items():
        with suppress(OSError):
            if not path.samefile(target / path.name):
                store.remember_digest(target / path.name, digest)


def _put(place: Path, target: Path, former: Path, own: frozenset[str]) -> list[Path]:
    """Put a draft in the target's place, with what people added there; returns what was kept elsewhere.

    Other runs may do the same at the same time, each step of theirs between any two of this one.
    Whoever finds things otherwise than expected begins anew.  What people added is in the draft
    before anything is moved, and stays in it from try to try; a folder is deleted only under a name
    that no other run looks at, and only if it is of the same photographs as what is in its place.
    """
    kept = []
    for _ in range(TRIES):
        # In this order: another run moves it from the one place to the other.
        there = next((folder for folder in (target, former) if folder.is_dir()), None)
        if there is None or _are_others(_photographs(there), own) or _take_along(there, place):
            if there == target:
                _move(target, former)
            if _move(place, target):
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
    with draft(former.parent) as aside:
        if _move(former, aside) and not _move(aside, target) and to_be_kept(aside):
            return _keep(aside, target)
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
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
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


def _take_along(source: Path, place: Path) -> bool:
    """Copy what people added to a folder; False where another run has moved it meanwhile."""
    before = _inode(source)
    try:
        for path in source.iterdir():
            if path.name not in WHAT and path.name != "evaluation.json":
                _copy(path, place / path.name)
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


def _published(store: Store, target: Path, files: Mapping[Path, str], copied: bool) -> bool:
    """Test whether a folder has these very files: each the store's own, or of its digest."""
    return all(_is_same(store, target / path.name, path, digest, copied) for path, digest in files.items())


def _is_same(store: Store, path: Path, source: Path, digest: str, copied: bool) -> bool:
    try:
        there, here = path.lstat(), source.stat()
        if not stat.S_ISREG(there.st_mode) or there.st_size != here.st_size:
            return False
        return not copied if os.path.samestat(there, here) else store.digest(path) == digest
    except (OSError, TileError):
        return False


def _copy(source: Path, target: Path) -> None:
    """Copy a file or a folder to the disk, in the place of an earlier copy; the original stays until all is done."""
    if source.is_dir():
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target, symlinks=True)
    else:
        target.unlink(missing_ok=True)
        shutil.copy2(source, target, follow_symlinks=False)
    for path in (*target.rglob("*"), target):
        if not path.is_symlink():
            flush(path)
