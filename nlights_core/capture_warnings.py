"""Warnings about a capture: what its photographs show that nobody meant, with a code, the lamps and a remedy."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nlights_core.errors import TileError
from nlights_core.machine.progress import note

FILE = "warnings.json"
"""Where a tile's warnings stand, beside its numbers."""


@dataclass(frozen=True)
class CaptureWarning:
    """One thing that is wrong with a capture, or may be; the tile is measured nevertheless.

    Attributes
    ----------
    code : str
        Kind of the fault, for programs: lower-case words joined by hyphens.
    sentence : str
        What was found, where, and what to do, for people.
    lamps : tuple of str
        Whose photographs are concerned, in the tile's order; empty: all of them, or none in particular.
    value : float or None
        How much, where that is one number.
    unit : str
        Unit of the value.
    """

    code: str
    sentence: str
    lamps: tuple[str, ...] = ()
    value: float | None = None
    unit: str = ""

    def record(self) -> dict[str, Any]:
        """Plain values, as they stand in JSON."""
        return asdict(self) | {"lamps": list(self.lamps)}


def write_warnings(folder: Path, found: Sequence[CaptureWarning]) -> None:
    """Write ``warnings.json``: a list, empty where nothing is wrong."""
    text = json.dumps([warning.record() for warning in found], indent=1)
    (folder / FILE).write_text(text + "\n", encoding="utf-8")


def read_warnings(folder: Path) -> list[CaptureWarning]:
    """Read what `write_warnings` wrote; an empty list where there is no such file.

    Raises
    ------
    TileError
        When the file holds something else: nothing is known of warnings then.
    """
    path = folder / FILE
    if not path.is_file():
        return []
    try:
        return [
            CaptureWarning(**{**record, "lamps": tuple(record["lamps"]), "sentence": str(record["sentence"])})
            for record in json.loads(path.read_text(encoding="utf-8"))
        ]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise TileError(
            f"{path}: is damaged (it is no list of warnings), so that nobody knows what it warned of; see "
            "`nlights verify`, or digitise the artwork again"
        ) from None


_gathered: ContextVar[list[CaptureWarning] | None] = ContextVar("_gathered", default=None)


def warn(warning: CaptureWarning) -> None:
    """Warn from within an algorithm: said at once, and kept by the stage that runs it."""
    note(warning.sentence)
    found = _gathered.get()
    if found is not None:
        found.append(warning)


@contextmanager
def gathered(folder: Path) -> Iterator[None]:
    """Keep what `warn` says while the block lasts in a stage's folder, if it says anything."""
    found: list[CaptureWarning] = []
    before = _gathered.set(found)
    try:
        yield
    finally:
        _gathered.reset(before)
    if found:
        write_warnings(folder, found)
