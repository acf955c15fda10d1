"""The inbox of a night: which artworks lie there, wholly uploaded, and in which order they are taken."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.configurations import Source
from nlights_core.errors import CaptureError, NlightsError
from nlights_core.manifest import Manifest, read_manifest, tiles_of
from nlights_core.names.artworks import folder_of
from nlights_core.names.odd_names import refusal
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
    names: dict[str, Path] = field(default_factory=dict)
    """Folders of what is ready, by the name of the folder of its products, in small letters."""


def scan(inbox: Path, settle: float, ignored: Iterable[Path] = ()) -> Inbox:
    """Look through an inbox, two levels deep; whatever an upload is, it costs itself alone.

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
    for folder, names in _folders(root, root, found, skipped):
        if MANIFEST in names:
            _add(folder, root, settle, found)
        elif any(Path(name).suffix.lower() in EXTENSIONS for name in names):
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
    if os.path.lexists(root / MANIFEST):
        raise CaptureError(
            f"{inbox}: is an artwork itself (it holds {MANIFEST}); give the folder above it, or use nlights digitise"
        )
    return root


def _folders(
    folder: Path, root: Path, found: Inbox, skipped: set[Path], depth: int = 2
) -> Iterator[tuple[Path, frozenset[str]]]:
    """Folders of an inbox, resolved, each once, and the names in it; not those inside an artwork's."""
    for path in _inside(folder, found):
        try:
            real = path.resolve()
            names = frozenset(one.name for one in real.iterdir() if not is_hidden(one.name))
        except (OSError, RuntimeError) as fault:
            found.passed_by.append(PassedBy(path, _unreadable(fault), True))
            continue
        if not real.is_relative_to(root):
            found.passed_by.append(
                PassedBy(path, "is a link that leads out of the inbox; move the capture in", True)
            )
        elif real not in skipped:
            skipped.add(real)
            yield real, names
            if depth > 1 and MANIFEST not in names:
                yield from _folders(real, root, found, skipped, depth - 1)


def _inside(folder: Path, found: Inbox) -> list[Path]:
    """Folders in a folder, and links to such; one that cannot be looked at is told and costs no other."""
    inside = []
    try:
        with os.scandir(folder) as entries:
            listed = sorted((entry for entry in entries if not is_hidden(entry.name)), key=lambda e: e.name)
    except OSError as fault:
        found.passed_by.append(PassedBy(folder, _unreadable(fault), True))
        return []
    for entry in listed:
        path = Path(entry.path)
        try:
            if entry.is_dir():
                inside.append(path)
            elif entry.is_symlink() and not path.exists():
                found.passed_by.append(
                    PassedBy(path, "is a link that leads nowhere; mend or remove it", True)
                )
        except OSError as fault:
            found.passed_by.append(PassedBy(path, _unreadable(fault), True))
    return inside


def _unreadable(fault: Exception) -> str:
    reason = getattr(fault, "strerror", None) or fault
    return f"cannot be read ({reason}); see its permissions, and whose it is"


def _add(folder: Path, root: Path, settle: float, found: Inbox) -> None:
    """Read an artwork's manifest; whatever is wrong with it, or odd about it, is told and passed by."""
    path, artwork = folder / MANIFEST, ""
    try:
        uploaded, waiting = _upload(folder, settle, [])
        if not waiting:
            source, manifest = _read(path, root)
            artwork = manifest.artwork.id
            tiles = tuple(tiles_of(source, manifest, root=root))
            _require_free_name(artwork, path, found)
            uploaded, waiting = _upload(folder, settle, tiles)
    except Exception as fault:  # nothing that somebody uploads may end a night
        found.passed_by.append(PassedBy(folder, _explained(fault, path), True, artwork))
        return
    if waiting:
        found.passed_by.append(PassedBy(folder, waiting, failed=False, artwork=artwork))
        return
    found.names[folder_of(artwork).casefold()] = folder
    title, priority = manifest.artwork.title, manifest.priority
    found.ready.append(Candidate(folder, artwork, title, priority, uploaded, tiles))


def _read(path: Path, root: Path) -> tuple[Source, Manifest]:
    """Read a manifest that lies in the inbox."""
    if refusal(path):  # a link that leads in a circle
        raise CaptureError(f"{path}: {refusal(path)}")
    if not path.resolve().is_relative_to(root):
        raise CaptureError(f"{path}: is a link that leads out of the inbox; put the manifest itself here")
    return read_manifest(path)


def _explained(fault: Exception, path: Path) -> str:
    """Fault of a manifest as a sentence."""
    if isinstance(fault, NlightsError):
        return str(fault)
    if isinstance(fault, OSError):
        return f"{fault.filename or path}: {_unreadable(fault)}"
    return (
        f"{path}: cannot be understood ({type(fault).__name__}: {fault}); that it is not said better is a defect: "
        "please report it, and look for what is unusual in the manifest"
    )


def _require_free_name(artwork: str, manifest: Path, found: Inbox) -> None:
    """Two artworks may not write into one folder of products."""
    if other := found.names.get(folder_of(artwork).casefold()):
        raise CaptureError(
            f"{manifest}: artwork.id: '{artwork}' is also the id of {other / MANIFEST}; correct one of "
            "them, or join their tiles in one manifest"
        )


def _upload(folder: Path, settle: float, tiles: Iterable[Tile]) -> tuple[float, str]:
    """Time when an upload was finished, and why it is not, where it is not.

    Raises
    ------
    CaptureError
        When the marker has a date that no calendar has.
    """
    marker = folder / MARKER
    try:
        uploaded = marker.stat().st_mtime
    except OSError:
        pass
    else:
        try:
            datetime.fromtimestamp(uploaded).astimezone()
        except (ValueError, OverflowError, OSError):
            raise CaptureError(
                f"{marker}: is dated {uploaded:.0f} s from 1970, which no calendar has; set the clock of the "
                "computer that uploads, and make the file anew"
            ) from None
        return uploaded, ""
    shared = {path for tile in tiles for path in photographs_of(tile) if not path.is_relative_to(folder)}
    try:
        newest, path = max(_changes(folder, shared))
    except FileNotFoundError as fault:
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
