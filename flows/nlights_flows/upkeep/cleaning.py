"""Cleaning: what a store holds and no product needs any more."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from nlights_core.errors import NlightsError
from nlights_core.machine.progress import Progress
from nlights_core.products.writing import PROVENANCE
from nlights_core.store import RECORD, ArtefactRef, sweep_below
from nlights_core.store.drafts import discard
from nlights_core.store.records import read_sealed
from nlights_core.store.references import found_mask
from nlights_flows.tiles.inventory import artefact_folders, place_of, product_folders

DAY = 86400.0


@dataclass
class Cleaned:
    """Result of a cleaning.

    Attributes
    ----------
    artefacts : list of Path
        That were removed.
    drafts : int
        How many, without a writer, were removed.
    size : int
        Bytes that only these artefacts had.
    kept : int
        Artefacts that stay.
    unreadable : list of Path
        Products that do not say what they were made of; all artefacts of their artwork stay.
    """

    artefacts: list[Path] = field(default_factory=list)
    drafts: int = 0
    size: int = 0
    kept: int = 0
    unreadable: list[Path] = field(default_factory=list)


def clean(
    store: Path,
    outs: Sequence[Path],
    older_than_days: float,
    *,
    dry: bool = False,
    progress: Progress = lambda share: None,
) -> Cleaned:
    """Remove drafts without a writer, and artefacts that no product refers to and no run has used for some days.

    Parameters
    ----------
    store : Path
        Root of the store.
    outs : sequence of Path
        Every folder of products that was made from it.
    older_than_days : float
        Days since a run last made or used an artefact.
    dry : bool
        Remove nothing.
    progress : callable
        Told the share done.

    Returns
    -------
    Cleaned
        What was, or would be, removed.

    Raises
    ------
    NlightsError
        When a folder holds no products at all: then it is hardly the right one, and everything would go.
    """
    found = Cleaned()
    needed: set[str] = set()
    artworks: set[str] = set()
    for out in outs:
        folders = list(product_folders(out, former=True))
        if not folders:
            raise NlightsError(
                f"--out: {out} holds no products; name the folders that digitise and nightly wrote to"
            )
        for folder in folders:
            named = set(_referred(folder))
            needed |= named
            if not named:
                found.unreadable.append(folder)
                artworks.add(place_of(folder)[0])
    found.drafts = sum(sweep_below(place, dry=dry) for place in (store, *outs))
    places = list(artefact_folders(store))
    if not places:
        raise NlightsError(f"--store: {store} holds no artefacts; name the folder that digitise kept them in")
    for number, folder in enumerate(places, 1):
        name = folder.relative_to(store).as_posix()
        if name in needed or folder.parent.parent.name in artworks or _age(folder) < older_than_days * DAY:
            found.kept += 1
        else:
            found.size += _own_size(folder)
            found.artefacts.append(folder)
            if not dry:
                discard(folder)
                for place in (folder.parent, folder.parent.parent):
                    with suppress(OSError):  # others are in it
                        place.rmdir()
        progress(number / len(places))
    return found


def _referred(products: Path) -> Iterator[str]:
    """Folders of all artefacts in the chain of some products; none where nobody can tell."""
    try:
        made = read_sealed(products / PROVENANCE)
    except (OSError, ValueError):
        return
    yield ArtefactRef("report", made["artwork"], made["tile"], made["key"]).folder
    for stage in made["stages"]:
        yield ArtefactRef(stage["stage"], stage["artwork"], stage["tile"], stage["key"]).folder
        if mask := found_mask(stage):
            yield mask


def _age(folder: Path) -> float:
    """Seconds since an artefact was made or a run last used it; 0 where it is gone."""
    try:
        newest = folder.lstat().st_mtime
        with suppress(OSError):
            newest = max(newest, (folder / RECORD).stat().st_mtime)
    except OSError:
        return 0.0
    return time.time() - newest


def _own_size(folder: Path) -> int:
    """Bytes of the files that have no second name, among the products for instance."""
    size = 0
    with suppress(OSError):
        for path in folder.iterdir():
            status = path.lstat()
            size += status.st_size if status.st_nlink == 1 else 0
    return size
