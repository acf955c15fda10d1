"""The record of a night, ``night.json``: what became of every artwork and tile, rewritten as it happens."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from nlights_core import __version__
from nlights_core.store import write_whole
from nlights_flows.nights.decisions import reviewed, standing
from nlights_flows.nights.inbox import NIGHTS
from nlights_flows.tiles.records import damaged, read_json

SCHEMA = 1
"""Raised when a field changes its meaning or goes."""

RECORD = "night.json"
PAGE = "night.html"

State = Literal["done", "unchanged", "failed", "left", "waiting", "claimed elsewhere"]

WORST_FIRST: tuple[State, ...] = ("failed", "left", "claimed elsewhere", "waiting", "done", "unchanged")
"""The state of an artwork is the first of these that one of its tiles has."""

NOT_REACHED = "not reached yet"


@dataclass
class TileEntry:
    """Outcome of a tile.

    Attributes
    ----------
    tile : str
    state : State
        "left": for the next night.
    message : str
        Why, and what to do.
    seconds : float
        How long it took.
    megapixels : float or None
        None where no photograph could be read.
    numbers : list of dict
        Quality numbers with limits, see `nlights_flows.nights.limits.Limits.judged`.
    verdict : {"ok", "warn", "fail"} or None
        The worst of them.
    warnings : list of dict
        About the capture, see `nlights_core.capture_warnings`.
    products : str or None
        Folder of the products, relative to OUT.
    notes : list of str
        What was done and may not be expected: products of other photographs that were kept.
    measured : dict or None
        What the trends follow: "stand", "flats" (digest of the flat set), "numbers" (by name).
    review : list of dict
        What people decided, see `nlights_flows.nights.decisions.reviewed`.
    """

    tile: str
    state: State = "left"
    message: str = NOT_REACHED
    seconds: float = 0.0
    megapixels: float | None = None
    numbers: list[dict[str, Any]] = field(default_factory=list)
    verdict: str | None = None
    warnings: list[dict[str, Any]] = field(default_factory=list)
    products: str | None = None
    notes: list[str] = field(default_factory=list)
    measured: dict[str, Any] | None = None
    review: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class ArtworkEntry:
    """Outcome of an artwork, or of a folder of the inbox.

    Attributes
    ----------
    artwork, title : str
        Empty where no manifest says it.
    folder : str
        Relative to the inbox.
    state : State
    message : str
        Where the folder as a whole waits or is at fault.
    priority : int
    uploaded : str or None
        ISO time of the end of the upload.
    tiles : list of TileEntry
    """

    artwork: str
    title: str
    folder: str
    state: State = "left"
    message: str = ""
    priority: int = 0
    uploaded: str | None = None
    tiles: list[TileEntry] = field(default_factory=list)

    def settle(self) -> None:
        """Take the state from the tiles."""
        states = {tile.state for tile in self.tiles}
        self.state = next((state for state in WORST_FIRST if state in states), self.state)


@dataclass
class NightRecord:
    """Everything that the page of a night says; see docs/nights.md for the fields."""

    date: str
    name: str
    inbox: str
    out: str
    store: str
    recipe: str
    started: str
    until: str | None = None
    ended: str | None = None
    written: str = ""
    seconds: float = 0.0
    estimate: dict[str, float] = field(default_factory=dict)
    artworks: list[ArtworkEntry] = field(default_factory=list)
    disk: dict[str, dict[str, float]] = field(default_factory=dict)
    limits: list[dict[str, Any]] = field(default_factory=list)
    trends: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    notified: dict[str, Any] | None = None

    @property
    def tiles(self) -> Iterator[TileEntry]:
        """The tiles of all artworks."""
        return (tile for artwork in self.artworks for tile in artwork.tiles)

    def as_json(self) -> dict[str, Any]:
        """Contents of ``night.json``; what lies deeper than a tile's own fields is not copied."""
        artworks = [
            {**vars(artwork), "tiles": [dict(vars(tile)) for tile in artwork.tiles]}
            for artwork in self.artworks
        ]
        said = {"schema": SCHEMA, "nlights": __version__, "verdict": summarise_night(self)}
        return {**said, **vars(self), "artworks": artworks}


def summarise_night(record: NightRecord) -> str:
    """A night in one sentence.

    Examples
    --------
    >>> tiles = [TileEntry("a", "done"), TileEntry("b", "left")]
    >>> night = NightRecord("2026-03-02", "2026-03-02", "", "", "", "default", "")
    >>> night.artworks = [ArtworkEntry("x", "", "x", "left", tiles=tiles), ArtworkEntry("y", "", "y", "failed")]
    >>> summarise_night(night)
    '0 of 2 artworks done, 1 failed, 1 tile left for the next night'
    """
    states = Counter(artwork.state for artwork in record.artworks)
    inside = sum(count for state, count in states.items() if state != "waiting")
    if not record.artworks:
        return "the inbox is empty"
    finished = states["done"] + states["unchanged"]
    parts = [f"{finished} of {_count(inside, 'artwork')} done"] if inside else ["nothing was ready"]
    if states["unchanged"]:
        parts[0] += f" ({states['unchanged']} before this night)"
    failed = sum(tile.state == "failed" for tile in record.tiles)
    if states["failed"]:
        parts.append(f"{states['failed']} failed" + (f" ({_count(failed, 'tile')})" if failed > 1 else ""))
    left = sum(tile.state == "left" for tile in record.tiles)
    elsewhere = sum(tile.state == "claimed elsewhere" for tile in record.tiles)
    if left:
        parts.append(f"{_count(left, 'tile')} left for the next night")
    if elsewhere:
        parts.append(f"{_count(elsewhere, 'tile')} at work elsewhere")
    if states["waiting"]:
        parts.append(f"{_count(states['waiting'], 'folder')} waiting")
    decided = [standing(tile.review) for tile in record.tiles]
    open_tiles = [tile for tile, one in zip(record.tiles, decided, strict=True) if one is None]
    if warned := sum(bool(tile.warnings) for tile in open_tiles if tile.state == "done"):
        parts.append(f"{_count(warned, 'tile')} with a warning")
    for word, said in (("fail", "beyond a limit"), ("warn", "to be watched")):
        if bad := sum(tile.verdict == word for tile in open_tiles if tile.state != "failed"):
            parts.append(f"{_count(bad, 'tile')} {said}")
    if again := sum(one["decision"] == "repeat" for one in decided if one):
        parts.append(f"{_count(again, 'tile')} to be photographed again")
    return ", ".join(parts)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def night_exit_code(record: NightRecord) -> int:
    """0: all done or left for later; 1: something failed; 2: something failed and nothing was produced."""
    failed = any(artwork.state == "failed" for artwork in record.artworks)
    made = any(tile.state in ("done", "unchanged") for tile in record.tiles)
    return 0 if not failed else 1 if made else 2


def new_night(out: Path, started: datetime) -> Path:
    """Make the folder of a night: its date, and a number from the second on."""
    date = started.date().isoformat()
    nights = out / NIGHTS
    nights.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = nights / (date if number == 1 else f"{date}-{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
        else:
            return folder


def write_record(record: NightRecord, folder: Path, out: Path) -> None:
    """Write ``night.json`` into the night's folder and, as the newest, into OUT; each appears whole."""
    record.written = datetime.now().astimezone().isoformat(timespec="seconds")
    for key, place in (("out", Path(record.out)), ("store", Path(record.store))):
        usage = shutil.disk_usage(place)
        record.disk[key] = {"free": usage.free, "total": usage.total}
    text = json.dumps(record.as_json(), indent=1, ensure_ascii=False) + "\n"
    for place in (folder, out):
        write_whole(place / RECORD, text)


def take_in_decisions(record: NightRecord, out: Path) -> None:
    """Enter what people have decided by now about the tiles of a night."""
    for tile in record.tiles:
        if tile.products:
            tile.review, _ = reviewed(out / tile.products)


def read_night(out: Path) -> NightRecord:
    """Read the record of the newest night of an output folder.

    Raises
    ------
    CaptureError
        When it is damaged, or of another version of nLights.
    """
    path = out / RECORD
    remedy = "the next night writes another"
    found = read_json(path, remedy)
    try:
        known = {key: value for key, value in found.items() if key in NightRecord.__dataclass_fields__}
        known["artworks"] = [
            ArtworkEntry(**{**artwork, "tiles": [TileEntry(**tile) for tile in artwork["tiles"]]})
            for artwork in found["artworks"]
        ]
        return NightRecord(**known)
    except (TypeError, KeyError, AttributeError):
        raise damaged(path, "it is no record of a night of this version", remedy) from None
