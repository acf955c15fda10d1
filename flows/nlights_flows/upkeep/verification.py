"""Verification: every product and every artefact, byte by byte, against the digests that were written with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nlights_core.machine.progress import Progress
from nlights_core.names.artworks import folder_of
from nlights_core.products.writing import PROVENANCE
from nlights_core.stages.inputs import FLATS
from nlights_core.store import RECORD, ArtefactRef
from nlights_core.store.drafts import discard
from nlights_core.store.records import faults_of_files, read_sealed
from nlights_flows.tiles.inventory import artefact_folders, place_of, product_folders
from nlights_flows.upkeep.remedies import Remedies
from nlights_flows.upkeep.repair import restore

AGAIN = 5
"""How often a folder is looked at that runs keep replacing meanwhile."""


@dataclass
class Damage:
    """One folder that is not what was written.

    Attributes
    ----------
    folder : Path
    kind : {"products", "artefact"}
    files : dict
        By file, what is wrong with it.
    restored : list of str
        Files that were brought back from whole artefacts.
    deleted : bool
        Whether the artefact was removed.
    """

    folder: Path
    kind: Literal["products", "artefact"]
    files: dict[str, str]
    restored: list[str] = field(default_factory=list)
    deleted: bool = False

    @property
    def remaining(self) -> list[str]:
        """Files that are still not what was written."""
        return [] if self.deleted else [name for name in self.files if name not in self.restored]

    def record(self) -> dict[str, Any]:
        """The same as JSON."""
        return {
            "folder": str(self.folder),
            "kind": self.kind,
            "files": self.files,
            "restored": self.restored,
            "deleted": self.deleted,
        }


@dataclass
class Verified:
    """Result of a verification.

    Attributes
    ----------
    products, artefacts : int
        How many were looked at.
    size : int
        Their bytes, what products and artefacts share counted twice.
    damages : list of Damage
    commands : list of str
        What makes the rest, and what was removed from the store.
    """

    products: int = 0
    artefacts: int = 0
    size: int = 0
    damages: list[Damage] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)

    def exit_code(self) -> int:
        """0: all whole, or mended; 1: something remains; 2: there was nothing."""
        if not self.products + self.artefacts:
            return 2
        return 1 if any(damage.remaining for damage in self.damages) else 0

    def record(self) -> dict[str, Any]:
        """The same as JSON."""
        return {
            "products": self.products,
            "artefacts": self.artefacts,
            "bytes": self.size,
            "damaged": [damage.record() for damage in self.damages],
            "commands": self.commands,
        }


def verify(
    out: Path, store: Path, *, repair: bool = False, progress: Progress = lambda share: None
) -> Verified:
    """Look at every product of an output folder and every artefact of a store, and mend what can be.

    A night may be at work beside: what is replaced meanwhile is looked at again, and what is removed was nobody's.

    Parameters
    ----------
    out, store : Path
        Folders of the products and of the artefacts.
    repair : bool
        Whether to restore products from whole artefacts, and to remove artefacts that are damaged.
    progress : callable
        Told the share done.

    Returns
    -------
    Verified
    """
    found = Verified()
    # A tile's artefacts before its products, so that what they share is read once.
    works: list[tuple[str, str, int, Path]] = [
        (folder.parent.parent.name, folder.parent.name, 0, folder) for folder in artefact_folders(store)
    ]
    works += [(*place_of(folder), 1, folder) for folder in product_folders(out, former=True)]
    works.sort()
    sizes = [_size(folder) for _, _, _, folder in works]
    done, total = 0, max(sum(sizes), 1)
    for (_, _, is_products, folder), size in zip(works, sizes, strict=True):
        faults = _looked_at(folder, faults_of_products if is_products else faults_of_artefact)
        done += size
        progress(done / total)
        if faults is None:  # it is gone
            continue
        found.size += size
        found.products += is_products
        found.artefacts += not is_products
        if faults:
            found.damages.append(Damage(folder, "products" if is_products else "artefact", faults))
    remedies = Remedies(out, store)  # asked before what it reads is removed
    commands = {place: remedies.command(*place) for place in sorted(set(map(_place, found.damages)))}
    if repair:
        _mend(found, store)
    open_places = {_place(damage) for damage in found.damages if damage.remaining or damage.deleted}
    found.commands = [
        command
        for (artwork, tile), command in commands.items()
        if (artwork, tile) in open_places
        # Making any tile makes the flats.
        and (tile != FLATS or not any(one[0] == artwork and one[1] != FLATS for one in open_places))
    ]
    return found


def _place(damage: Damage) -> tuple[str, str]:
    if damage.kind == "products":
        return place_of(damage.folder)
    return damage.folder.parent.parent.name, damage.folder.parent.name


def _mend(found: Verified, store: Path) -> None:
    """Restore products from whole artefacts, then remove artefacts that are damaged."""
    rotten = {damage.folder for damage in found.damages if damage.kind == "artefact"}
    for damage in found.damages:
        if damage.kind == "products":
            damage.restored = restore(damage.folder, damage.files, store, rotten)
    for damage in found.damages:
        if damage.kind == "artefact" and _looked_at(damage.folder, faults_of_artefact):
            discard(damage.folder)
        damage.deleted = damage.kind == "artefact"


def _looked_at(folder: Path, look: Callable[[Path], dict[str, str]]) -> dict[str, str] | None:
    """Faults of a folder, looked at again where it was replaced meanwhile; None where it is gone."""
    faults: dict[str, str] | None = None
    for _ in range(AGAIN):
        before = _stamp(folder)
        faults = look(folder) if before else None
        if not faults or _stamp(folder) == before:
            break
    return faults


def _stamp(folder: Path) -> tuple[int, int] | None:
    """Inode and time of change of a folder; None where there is none."""
    try:
        status = folder.lstat()
    except OSError:
        return None
    return status.st_ino, status.st_ctime_ns


def faults_of_artefact(folder: Path) -> dict[str, str]:
    """Files of an artefact that are not what was written, with what is wrong; empty where it is whole."""
    record, faults = _read(folder, RECORD)
    if record is None:
        return faults
    faults = faults_of_files(folder, record["files"])
    own = ArtefactRef(record["stage"], record["artwork"], record["tile"], record["key"]).folder
    if Path(own).parts != folder.absolute().parts[-3:]:
        faults[RECORD] = f"is of another artefact ({own})"
    return faults


def faults_of_products(folder: Path) -> dict[str, str]:
    """Products of a tile that are not what was written, with what is wrong; empty where they are whole."""
    record, faults = _read(folder, PROVENANCE)
    if record is None:
        return faults
    faults = faults_of_files(folder, record["files"])
    artwork, tile = place_of(folder)
    if (folder_of(record["artwork"]), record["tile"]) != (artwork, tile):
        faults[PROVENANCE] = f"is of other products ({record['artwork']}/{record['tile']})"
    return faults


def _read(folder: Path, name: str) -> tuple[dict[str, Any] | None, dict[str, str]]:
    """Record of a folder, or what is wrong with it."""
    try:
        if not folder.is_dir():
            return None, {name: "a file stands in the place of its folder"}
        return read_sealed(folder / name), {}
    except FileNotFoundError:
        return None, {name: "is missing"}
    except (OSError, ValueError) as fault:
        return None, {name: getattr(fault, "strerror", None) or str(fault)}


def _size(folder: Path) -> int:
    return sum(_sizes(folder))


def _sizes(folder: Path) -> Iterator[int]:
    try:
        for path in folder.iterdir():
            yield path.lstat().st_size
    except OSError:
        return
