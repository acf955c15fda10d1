"""Check that what a tile is made of stays the same while it runs: an upload may replace a file at any time."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.machine.band_threads import cores
from nlights_core.recipe import Recipe
from nlights_core.stages.inputs import FLATS
from nlights_core.store import Store

Stamp = tuple[int, int, int, int]
"""Size, times of writing and of change in ns, inode: a tool that sets the first back cannot set back the second."""

THREADS = 4
"""That find digests, at most: they soon take all that the memory gives."""


@dataclass(frozen=True)
class Photographs:
    """Stamps of a tile's photographs, taken when it was begun.

    A stage names its work by the digests of the photographs and reads them afterwards; what is
    replaced in between would lie in the store under another photograph's name.

    Attributes
    ----------
    store, tile : Store, Tile
        Whose.
    stamps : dict
        By file, its stamp and the digest of that content, which may still be under way; None where it could
        not be found, because the file cannot be read or became another.
    artefacts : frozenset of Path
        What the store had of this tile and of its flats.
    """

    store: Store
    tile: Tile
    stamps: dict[Path, tuple[Stamp, Future[str | None]]]
    artefacts: frozenset[Path]

    @classmethod
    @contextmanager
    def watched(cls, tile: Tile, recipe: Recipe, store: Store) -> Iterator[Photographs]:
        """Look at the photographs that a recipe reads, and at the files beside them, for as long as it runs.

        A tile of which a photograph is not what it was has failed, whatever else became of it: what seems
        damaged may only be half-way here.

        The digests are those that the stages ask for anyway, so a file is read once.  They are found
        beside the stages, in the order in which they are asked for: a flat field needs those of
        the flats.  A stage that asks for one before its turn reads that file itself.

        Raises
        ------
        TileError
            Naming the photographs that changed; the artefacts that were made meanwhile are gone from the store.
        """
        with _stamped(list(_files(tile, recipe)), store) as stamps:
            seen = cls(store, tile, stamps, frozenset(_artefacts(store, tile)))
            try:
                yield seen
            except BaseException as fault:
                changed = seen._changed()
                if changed and isinstance(fault, Exception):  # who stops a run is told nothing else
                    raise changed from fault
                raise
            if changed := seen._changed():
                raise changed

    def _changed(self) -> TileError | None:
        """Message about photographs that are not what they were; what was made meanwhile is gone then."""
        changed = [path for path, seen in self.stamps.items() if not self._same(path, *seen)]
        if not changed:
            return None
        # Nobody can tell what they were made of; deleting artefacts is always safe.
        for folder in _artefacts(self.store, self.tile) - self.artefacts:
            shutil.rmtree(folder, ignore_errors=True)
        names = ", ".join(path.name for path in changed[:3])
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        return TileError(
            f"{changed[0].parent}: its files were changed while it ran ({names}{more}); nothing was made of "
            "them; run again when the upload is complete"
        )

    def _same(self, path: Path, stamp: Stamp, digest: Future[str | None]) -> bool:
        try:
            return _stamp(path) == stamp or self.store.digest(path) == digest.result()
        except (OSError, TileError):
            return False


def _files(tile: Tile, recipe: Recipe) -> Iterator[Path]:
    """Files that the stages read of a tile, in their order."""
    given: list[Path | None] = [tile.stand.file if tile.stand else None]
    for sphere in tile.spheres:
        given += [*sphere.frames.values(), sphere.mask, sphere.outline]
    if tile.lights:
        given += [tile.lights.directions, tile.lights.intensities]
    if recipe.needs("flats"):
        given += (tile.flats or {}).values()
        given += (path for turned in tile.turned_flats for path in turned.flats.values())
    given += [tile.dark, tile.mask, *tile.frames.values()]
    if tile.known_heights:
        given.append(tile.known_heights.file)
    yield from dict.fromkeys(path for path in given if path)


@contextmanager
def _stamped(paths: list[Path], store: Store) -> Iterator[dict[Path, tuple[Stamp, Future[str | None]]]]:
    """Stamps of files, and their digests, which are being found until the block ends."""
    over = threading.Event()

    def digest(path: Path, stamp: Stamp) -> str | None:
        try:
            found = store.digest(path, over.is_set)
            return found if _stamp(path) == stamp else None
        except (OSError, TileError):  # the stage that reads it will say what is wrong
            return None

    pool = ThreadPoolExecutor(min(cores(), THREADS), thread_name_prefix="digests")
    stamps = {}
    try:
        for path in paths:
            with suppress(OSError):
                stamps[path] = (stamp := _stamp(path)), pool.submit(digest, path, stamp)
        yield stamps
    finally:
        over.set()
        pool.shutdown(cancel_futures=True)


def _stamp(path: Path) -> Stamp:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _artefacts(store: Store, tile: Tile) -> set[Path]:
    """Folders of artefacts, not drafts, of a tile and of the flats of its artwork."""
    return {
        folder
        for name in (tile.name, FLATS)
        if (place := store.root / tile.folder / name).is_dir()
        for folder in place.iterdir()
        if not folder.name.startswith(".")
    }
