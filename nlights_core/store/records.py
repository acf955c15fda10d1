"""Records: what made some files, and a digest of each; a seal shows whether the record itself is as written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from xxhash import xxh3_128

from nlights_core.files.content_digests import digest_of_file, digests_of_files
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.regular_files import irregular_kind

RECORD = "artefact.json"
"""Of every artefact."""

SEAL = "seal"
"""Last field of a record: the XXH3 digest of all that stands before it."""


def sealed(record: Mapping[str, Any]) -> str:
    """A record as text, with its seal."""
    seal = xxh3_128(json.dumps(record, indent=1).encode()).hexdigest()
    return json.dumps({**record, SEAL: seal}, indent=1) + "\n"


def read_sealed(path: Path) -> dict[str, Any]:
    """Read a record, without its seal.

    Raises
    ------
    OSError
        When it cannot be read.
    ValueError
        When a single character of it is not as it was written.
    """
    if kind := irregular_kind(path):
        raise ValueError(f"{kind}, where a file is expected")
    text = path.read_bytes().decode("utf-8")
    try:
        record = json.loads(text)
    except RecursionError:
        raise ValueError("is nested too deep") from None
    if not isinstance(record, dict) or record.pop(SEAL, None) is None:
        raise ValueError("holds no seal: it is no record, or one of an earlier version")
    if sealed(record) != text:
        raise ValueError("is not what was written")
    return record


def described_files(paths: Iterable[Path]) -> dict[str, dict[str, Any]]:
    """Size and digest of files by their names, for a record."""
    files = sorted(paths)
    digests = digests_of_files(files)
    return {path.name: {"bytes": path.stat().st_size, "xxh3": digests[path.name]} for path in files}


def have_sizes(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> bool:
    """Test whether a folder has the files of a record, each of its size; nothing is read."""
    try:
        return all(
            not irregular_kind(folder / name) and (folder / name).stat().st_size == said["bytes"]
            for name, said in files.items()
        )
    except OSError:
        return False


def faults_of_files(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Files of a folder that are not what a record says, with what is wrong; reads what this process has not yet."""
    faults = in_order(lambda name: _fault(folder / name, files[name]), files)
    return {name: fault for name, fault in zip(files, faults, strict=True) if fault}


def _fault(path: Path, said: Mapping[str, Any]) -> str:
    """Fault of a file, in words; empty where it is as said."""
    try:
        if kind := irregular_kind(path):
            return f"{kind}, where a file is expected"
        size = path.stat().st_size
        if size != said["bytes"]:
            return f"{size} bytes, where {said['bytes']} were written"
        return "" if digest_of_file(path) == said["xxh3"] else "other bytes than were written"
    except FileNotFoundError:
        return "is missing"
    except OSError as fault:
        return f"cannot be read ({fault.strerror})"
