"""References: names of artefacts, and why each would exist."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlights_core import __version__
from nlights_core.algorithms import Algorithm
from nlights_core.machine.progress import Progress
from nlights_core.machine.sources import EVERYTHING_RESTS_ON, digests_of_places
from nlights_core.names.artworks import folder_of
from nlights_core.registry import code_digest, installed, is_bundled


@dataclass(frozen=True)
class ArtefactRef:
    """Name of an artefact: all that a flow ever passes on.

    Attributes
    ----------
    stage, artwork, tile : str
        Where it belongs.
    key : str
        sha256 of everything that determines its content, 64 hexadecimal digits.
    """

    stage: str
    artwork: str
    tile: str
    key: str

    @property
    def folder(self) -> str:
        """Path of the folder, relative to the store."""
        return f"{folder_of(self.artwork)}/{self.tile}/{self.stage}-{self.key[:12]}"


@dataclass(frozen=True)
class Work:
    """Plan of a stage: the artefact's name, why it would exist, and how to make it.

    Attributes
    ----------
    ref : ArtefactRef
        Known before anything runs.
    record : dict
        Why the artefact exists, in full: stage, algorithm, code, core, inputs.
    make : callable
        Fills an empty folder; nothing else is written.
    """

    ref: ArtefactRef
    record: dict[str, Any]
    make: Callable[[Path, Progress], None]


def describe(
    stage: str,
    artwork: str,
    tile: str,
    *,
    rests_on: Iterable[str] = (),
    algorithm: Algorithm | None = None,
    inputs: Mapping[str, ArtefactRef | None] | None = None,
    facts: Mapping[str, Any] | None = None,
) -> tuple[ArtefactRef, dict[str, Any]]:
    """Name an artefact by everything that determines its content.

    Parameters
    ----------
    stage, artwork, tile : str
        Where it belongs.
    rests_on : iterable of str
        Departments of the core whose code decides its content, beside that of the stage itself and
        `nlights_core.machine.sources.EVERYTHING_RESTS_ON`.
    algorithm : Algorithm, optional
        Its name, options and code enter the key.
    inputs : mapping of names to artefacts, optional
        Their keys enter the key.
    facts : mapping, optional
        JSON values that enter the key: digests of files, settings of the capture.

    Returns
    -------
    ref : ArtefactRef
    record : dict
        The same in full, for ``artefact.json``.
    """
    given = {name: ref for name, ref in (inputs or {}).items() if ref is not None}
    origin = installed().origin(algorithm) if algorithm else None
    places = (*EVERYTHING_RESTS_ON, f"stages.{stage}", *rests_on)
    cause: dict[str, Any] = {
        "stage": stage,
        "code": digests_of_places(places),
        "algorithm": None
        if algorithm is None
        else {
            "use": algorithm.name,
            "options": algorithm.model_dump(mode="json"),
            "code": code_digest(type(algorithm)),
            # Its authors may ship more than code; what nLights ships with a version is in the code already.
            "version": None if is_bundled(type(algorithm)) else origin,
        },
        "inputs": {name: ref.key for name, ref in given.items()},
        "facts": dict(facts or {}),
    }
    key = hashlib.sha256(json.dumps(cause, sort_keys=True).encode()).hexdigest()
    # What follows the cause says more, but decides nothing: another version with the same code makes the same.
    record = {
        "artwork": artwork,
        "tile": tile,
        "key": key,
        **cause,
        "nlights": __version__,
        "origin": origin,
        "input_folders": {name: ref.folder for name, ref in given.items()},
    }
    return ArtefactRef(stage, artwork, tile, key), record


def folders_read(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Artefacts that a stage reads, by its record: the folder of each in the store, and how its key begins."""
    for name, folder in record["input_folders"].items():
        yield folder, record["inputs"][name]
    mask = found_mask(record)
    if mask:
        yield mask, mask.rpartition("-")[2]


def found_mask(record: Mapping[str, Any]) -> str | None:
    """Folder of the mask that the store found for a stage's photographs; None where a file or nothing masks them."""
    mask = record["facts"].get("mask")
    return (
        f"{folder_of(record['artwork'])}/{record['tile']}/{mask}" if str(mask).startswith("mask-") else None
    )
