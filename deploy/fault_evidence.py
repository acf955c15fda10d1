"""What a night left behind: digests of products and artefacts, what is whole, what was done anew, what stays."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nlights_core.store import RECORD, ArtefactRef, Store

VARIES = ("seconds", "seal")
"""What an artefact's record may say differently each time."""

PASSING = re.compile(r"\.(draft|former|probe|now|stale)-.*|\.(night\.(json|html)|[0-9a-f]{32})-[0-9a-f]{8}")
"""Names of what is there only while something is written."""

Seen = dict[str, tuple[int, int, int]]
"""By artefact: inode of its folder, inode and time of change (ns) of its record."""


class FaultError(Exception):
    """A fault that was not survived as it should."""


def require(holds: bool, message: str) -> None:
    """Raise where something does not hold.

    Raises
    ------
    FaultError
        With the message.
    """
    if not holds:
        raise FaultError(message)


def digest_of_products(out: Path) -> dict[str, str]:
    """Digests of every product file, by its path: not of the store, and not of the nights' own pages."""
    return {
        path.relative_to(out).as_posix(): _digest(path.read_bytes())
        for path in sorted(out.rglob("*"))
        if path.is_file()
        and len(inside := path.relative_to(out).parts) > 2
        # OUT/<artwork>/<tile>/file: whatever starts with a dot is no product.
        and inside[0] != "nights"
        and not any(part.startswith(".") for part in inside)
    }


def digest_of_artefacts(store: Path) -> dict[str, str]:
    """Digests of every file of every artefact, by its path; of a record without what `VARIES`."""
    found = {}
    for folder in _artefacts(store):
        for path in sorted(folder.iterdir()):
            content = path.read_bytes()
            if path.name == RECORD:
                record = {name: said for name, said in json.loads(content).items() if name not in VARIES}
                content = json.dumps(record, sort_keys=True).encode()
            found[path.relative_to(store).as_posix()] = _digest(content)
    return found


def seen(store: Path) -> Seen:
    """Which artefacts there are now, and which folders and files they are exactly."""
    found: Seen = {}
    for folder in _artefacts(store):
        try:
            place, record = folder.stat(), (folder / RECORD).stat()
        except FileNotFoundError:  # it is being replaced
            continue
        found[folder.relative_to(store).as_posix()] = (place.st_ino, record.st_ino, record.st_mtime_ns)
    return found


def require_whole(root: Path) -> None:
    """See that a store holds whole artefacts only.

    Raises
    ------
    FaultError
        Naming those that are not.
    """
    store, broken = Store(root), []
    for folder in _artefacts(root):
        try:
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            ref = ArtefactRef(record["stage"], record["artwork"], record["tile"], record["key"])
        except (OSError, ValueError, KeyError) as fault:
            broken.append(f"{folder}: {fault!r}")
            continue
        if store.path(ref) != folder or not store.has(ref):
            broken.append(f"{folder}: is not whole")
    require(not broken, "; ".join(broken))


def require_nothing_redone(before: Seen, store: Path) -> None:
    """See that what was finished once is still the same folder.

    Raises
    ------
    FaultError
        Naming what is not.
    """
    after = seen(store)
    redone = [name for name, known in before.items() if after.get(name) != known]
    require(not redone, f"was finished before the fault and done again: {', '.join(redone)}")


def require_same(expected: Mapping[str, str], found: Mapping[str, str], what: str) -> None:
    """See that two sets of digests are equal.

    Raises
    ------
    FaultError
        Naming what lacks, what is too much and what differs.
    """
    wrong = [f"lacks {name}" for name in expected if name not in found]
    wrong += [f"has {name}, which should not be there" for name in found if name not in expected]
    wrong += [f"{name} differs" for name in expected if name in found and found[name] != expected[name]]
    require(not wrong, f"{what}: {'; '.join(wrong[:8])}{' and more' if len(wrong) > 8 else ''}")


def left_about(*roots: Path) -> list[str]:
    """What is still there of writing that has ended, one way or the other."""
    return sorted({str(path) for root in roots for path in root.rglob(".*") if PASSING.fullmatch(path.name)})


def record_of(out: Path) -> dict[str, Any]:
    """The record of the newest night.

    Raises
    ------
    FaultError
        When it is not there or not whole.
    """
    try:
        return json.loads((out / "night.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]
    except (OSError, ValueError) as fault:
        raise FaultError(f"{out / 'night.json'}: {fault}") from fault


def states(out: Path) -> dict[str, str]:
    """What the newest night says of each folder of the inbox."""
    return {one["folder"]: one["state"] for one in record_of(out)["artworks"]}


def messages(out: Path) -> str:
    """All that the newest night says to people."""
    artworks = record_of(out)["artworks"]
    told = [one["message"] for one in artworks]
    told += [tile["message"] for one in artworks for tile in one["tiles"]]
    return "\n".join(filter(None, told))


def _artefacts(store: Path) -> list[Path]:
    """Folders of artefacts, ``<artwork>/<tile>/<stage>-<key>``."""
    return sorted(
        folder
        for folder in store.glob("*/*/*")
        if folder.is_dir() and not any(part.startswith(".") for part in folder.relative_to(store).parts)
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
