"""The inbox of a night: which artworks lie there, wholly uploaded, and in which order they are taken."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError, NlightsError
from nlights_core.manifest import load_capture, read_manifest
from nlights_core.names.artworks import folder_of
from nlights_core.names.photographs import is_hidden
from nlights_core.photographs.decoders import EXTENSIONS

MANIFEST = "artwork.yaml"
MARKER = "upload-complete"
"""Name of the file that says that an artwork's folder is complete."""

NIGHTS = "nights"
"""Folder of the nights beside those of the artworks."""


@dataclass(frozen=True)
class Candidate:
    """An artwork that can be digitised.

    Attributes
    ----------
    folder : Path
        That of its manifest, resolved.
    artwork, title : str
        Inventory number and title.
    priority : int
        Higher goes first.
    uploaded : float
        When its upload was finished, seconds since 1970.
    tiles : tuple of Tile
    """

    folder: Path
    artwork: str
    title: str
    priority: int
    uploaded: float
    tiles: tuple[Tile, ...]


@dataclass(frozen=True)
class PassedBy:
    """A folder that cannot be digitised now.

    Attributes
    ----------
    folder : Path
    message : str
        Why, and what to do.
    failed : bool
        A fault that somebody must mend; otherwise it waits for its upload.
    artwork : str
        Inventory number, where it is known.
    """

    folder: Path
    message: str
    failed: bool
    artwork: str = ""


@dataclass
class Inbox:
    """Result of a scan."""

    ready: list[Candidate] = field(default_factory=list)
    passed_by: list[PassedBy] = field(default_factory=list)


def scan(inbox: Path, settle: float, ignored: Iterable[Path] = ()) -> Inbox:
    """Look through an inbox, two levels deep.

    Parameters
    ----------
    inbox : Path
        The capture root of all artworks in it.
    settle : float
        Seconds for which nothing in a folder without a marker must have changed.
    ignored : iterable of Path
        Folders that are no captures: products, store.

    Returns
    -------
    Inbox
        What is ready in the order of the night: highest priority, oldest upload, inventory number.

    Raises
    ------
    CaptureError
        See `require_inbox`.
    """
    root = require_inbox(inbox)
    found, bare = Inbox(), []
    skipped = {path.resolve() for path in ignored}
    for folder in _folders(root, root, found, skipped):
        if (folder / MANIFEST).exists():
            _add(folder, root, settle, found)
        elif _has_photographs(folder):
            bare.append(folder)
    _tell_bare(bare, root, found)
    found.ready.sort(key=lambda one: (-one.priority, one.uploaded, one.artwork))
    return found


def require_inbox(inbox: Path) -> Path:
    """Refuse what is no inbox.

    Returns
    -------
    Path
        Resolved.

    Raises
    ------
    CaptureError
        When there is no such folder, or it is an artwork itself.
    """
    root = inbox.resolve()
    if not root.is_dir():
        raise CaptureError(
            f"{inbox}: there is no such folder; give the folder into which captures are uploaded"
        )
    if (root / MANIFEST).exists():
        raise CaptureError(
            f"{inbox}: is an artwork itself (it holds {MANIFEST}); give the folder above it, or use nlights digitise"
        )
    return root


def _folders(folder: Path, root: Path, found: Inbox, skipped: set[Path], depth: int = 2) -> Iterator[Path]:
    """Folders of an inbox, resolved, each once; not those inside an artwork's."""
    try:
        inside = sorted(path for path in folder.iterdir() if path.is_dir() and not is_hidden(path.name))
    except OSError as fault:
        found.passed_by.append(
            PassedBy(folder, f"cannot be read ({fault.strerror}); see its permissions", True)
        )
        return
    for path in inside:
        real = path.resolve()
        if not real.is_relative_to(root):
            found.passed_by.append(
                PassedBy(path, "is a link that leads out of the inbox; move the capture in", True)
            )
        elif real not in skipped:
            skipped.add(real)
            yield real
            if depth > 1 and not (real / MANIFEST).exists():
                yield from _folders(real, root, found, skipped, depth - 1)


def _add(folder: Path, root: Path, settle: float, found: Inbox) -> None:
    """Read an artwork's manifest; whatever is wrong with it is told and passed by."""
    manifest = folder / MANIFEST
    uploaded, message = _upload(folder, settle, [])
    if message:
        found.passed_by.append(PassedBy(folder, message, failed=False))
        return
    artwork = ""
    try:
        if not manifest.resolve().is_relative_to(root):
            raise CaptureError(
                f"{manifest}: is a link that leads out of the inbox; put the manifest itself here"
            )
        _, read = read_manifest(manifest)
        artwork = read.artwork.id
        tiles = tuple(load_capture(manifest, root=root))
        _require_free_name(artwork, manifest, found)
    except NlightsError as fault:
        found.passed_by.append(PassedBy(folder, str(fault), True, artwork))
        return
    uploaded, message = _upload(folder, settle, tiles)
    if message:
        found.passed_by.append(PassedBy(folder, message, failed=False, artwork=artwork))
        return
    found.ready.append(Candidate(folder, artwork, read.artwork.title, read.priority, uploaded, tiles))


def _require_free_name(artwork: str, manifest: Path, found: Inbox) -> None:
    """Two artworks may not write into one folder of products."""
    if artwork.casefold() == NIGHTS:
        raise CaptureError(
            f"{manifest}: artwork.id: '{artwork}' is the name of the folder of all nights; give the artwork another"
        )
    for other in found.ready:
        if folder_of(other.artwork).casefold() == folder_of(artwork).casefold():
            raise CaptureError(
                f"{manifest}: artwork.id: '{artwork}' is also the id of {other.folder / MANIFEST}; correct one of "
                "them, or join their tiles in one manifest"
            )


def _upload(folder: Path, settle: float, tiles: Iterable[Tile]) -> tuple[float, str]:
    """Time when an upload was finished, and why it is not, where it is not."""
    try:
        marker = (folder / MARKER).stat().st_mtime
        return marker, ""
    except OSError:
        pass
    shared = {path for tile in tiles for path in photographs_of(tile) if not path.is_relative_to(folder)}
    try:
        newest, path = max(_changes(folder, shared))
    except OSError as fault:
        return 0.0, f"is changing ({fault.filename}: {fault.strerror}); the next night looks again"
    quiet = time.time() - newest
    if quiet >= settle:
        return newest, ""
    name = path.relative_to(folder) if path.is_relative_to(folder) else path
    when = f"changed {quiet:.0f} s ago" if quiet >= 0 else f"is dated {-quiet:.0f} s in the future"
    return newest, (
        f"the upload may not be finished: {name} {when}, and {settle:g} s of quiet are asked for; put a file "
        f"'{MARKER}' into the folder when it is"
    )


def _changes(folder: Path, others: Iterable[Path]) -> Iterator[tuple[float, Path]]:
    """Times when the files of a folder, and some others, were last changed or put there."""
    places = [folder]
    for place, folders, files in os.walk(folder):
        places += [Path(place) / name for name in (*folders, *files)]
    for path in (*places, *others):
        try:
            status = path.lstat()
        except FileNotFoundError:  # a missing photograph is told by the tile that needs it
            if path.is_relative_to(folder):
                raise
            continue
        yield max(status.st_mtime, status.st_ctime), path


def photographs_of(tile: Tile) -> list[Path]:
    """Every file that a tile may be made of."""
    spheres = [path for sphere in tile.spheres for path in sphere.frames.values()]
    single = [path for path in (tile.dark, tile.mask) if path]
    single += [tile.known_heights.file] if tile.known_heights else []
    return [*tile.frames.values(), *(tile.flats or {}).values(), *spheres, *single]


def _has_photographs(folder: Path) -> bool:
    try:
        return any(
            path.suffix.lower() in EXTENSIONS and not is_hidden(path.name) for path in folder.iterdir()
        )
    except OSError:
        return False


def _tell_bare(bare: list[Path], root: Path, found: Inbox) -> None:
    """Tell of folders with photographs that nothing names; flats that artworks share are named by them."""
    named = {path.parent for one in found.ready for tile in one.tiles for path in photographs_of(tile)}
    waiting = {one.folder for one in found.passed_by}
    for folder in bare:
        # Until all manifests can be read nobody knows whose flats these are, but a capture has its own folder.
        if folder in named or any(parent in waiting for parent in folder.parents):
            continue
        found.passed_by.append(
            PassedBy(
                folder,
                f"holds photographs but no {MANIFEST}, and no artwork names them; write one, or wait for its upload",
                failed=False,
            )
        )
