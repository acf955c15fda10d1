"""Review: which tiles of an output folder wait for a person's word, and what was decided about the others."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

from nlights_core.errors import CaptureError, NlightsError
from nlights_core.names.artworks import folder_of
from nlights_flows.nights.decisions import LOCK, Choice, add_decision, decide, standing
from nlights_flows.nights.inbox import NIGHTS
from nlights_flows.nights.limits import Limits
from nlights_flows.nights.numbers import look_at_products
from nlights_flows.nights.page import number_rows, write_pages
from nlights_flows.nights.record import PAGE, RECORD, TileEntry, read_night, take_in_decisions
from nlights_flows.tiles.environment import alone
from nlights_flows.tiles.inventory import product_folders
from nlights_flows.tiles.records import read_provenance

State = Literal["fine", "open", "accepted", "repeat"]


@dataclass(frozen=True)
class Reviewed:
    """A tile as a person looks at it.

    Attributes
    ----------
    artwork : str
        Inventory number.
    folder : Path
        The products.
    entry : TileEntry
        What the products say, and people of them.
    """

    artwork: str
    folder: Path
    entry: TileEntry

    @property
    def name(self) -> str:
        """Name of artwork and tile, as people write it."""
        return f"{self.artwork}/{self.entry.tile}"

    @property
    def state(self) -> State:
        """State of the decision: "open" while there is something to look at and nobody has decided."""
        decision = standing(self.entry.review)
        if decision:
            return "accepted" if decision["decision"] == "accept" else "repeat"
        return "open" if self.reasons else "fine"

    @property
    def outside(self) -> list[dict[str, Any]]:
        """Numbers beyond their limits; of those per lamp the worst."""
        return [row for row in number_rows(self.entry.numbers) if row["verdict"] in ("warn", "fail")]

    @property
    def reasons(self) -> list[str]:
        """Sentences on what is to be looked at."""
        numbers = [
            f"{row['name']} is {row['shown']}{' ' * bool(row['unit'])}{row['unit']}, {row['word']} ({row['allowed']})"
            for row in self.outside
        ]
        return numbers + [f"warning: {warning['sentence']}" for warning in self.entry.warnings]

    def as_json(self) -> dict[str, Any]:
        """Plain values, for programs."""
        return {
            "artwork": self.artwork,
            "tile": self.entry.tile,
            "folder": str(self.folder),
            "state": self.state,
            "verdict": self.entry.verdict,
            "numbers": [row for row in self.entry.numbers if row["verdict"] in ("warn", "fail")],
            "warnings": self.entry.warnings,
            "decisions": self.entry.review,
        }


def review_tiles(out: Path, limits: Limits) -> list[Reviewed]:
    """Look at every tile of an output folder.

    Returns
    -------
    list of Reviewed
        By artwork and tile.

    Raises
    ------
    CaptureError
        When there is none.
    """
    found = [review_tile(folder, limits) for folder in _tiles_of(out)]
    if not found:
        raise CaptureError(f"{out}: holds no products; give the folder that digitise or nightly had as --out")
    return found


def review_tile(folder: Path, limits: Limits) -> Reviewed:
    """Look at the tile whose products are in a folder."""
    entry = TileEntry(folder.name, "unchanged", "")
    look_at_products(entry, folder, limits)
    return Reviewed(_artwork_of(folder), folder, entry)


def find_tile(out: Path, name: str) -> Path:
    """Folder of the products of a tile.

    Parameters
    ----------
    out : Path
        Folder of all products.
    name : str
        ARTWORK/TILE, as everything that nLights says names it; the number of an artwork may hold slashes.

    Raises
    ------
    CaptureError
        When there is no such tile, with the nearest name.
    """
    folders = _tiles_of(out)
    if not folders:
        raise CaptureError(f"{out}: holds no products; give the folder that digitise or nightly had as --out")
    artwork, slash, tile = name.rstrip("/").rpartition("/")
    wanted = out / folder_of(artwork) / tile if slash and artwork and tile else None
    if wanted in folders:
        return wanted
    names = {f"{_artwork_of(folder)}/{folder.name}": folder for folder in folders}
    near = difflib.get_close_matches(name, names, 1)
    meant = f"did you mean '{near[0]}'?" if near else f"there are {len(names)}, as '{next(iter(names))}'"
    raise CaptureError(f"{out}: holds no tile '{name}'; write ARTWORK/TILE; {meant}")


def record_decision(out: Path, name: str, choice: Choice, by: str, why: str) -> Path:
    """Record what a person decided about a tile, and draw the newest night's page anew.

    Returns
    -------
    Path
        The folder of its products.

    Raises
    ------
    CaptureError
        When there is no such tile, or name or reason is no text; nothing was written then.
    """
    folder = find_tile(out, name)
    add_decision(folder, decide(choice, by, why, folder), out)
    return folder


def draw_page_anew(out: Path) -> str:
    """Draw the page of the newest night with what people have decided since.

    A night at work draws its page itself; should it do so at the same time, its record tells, and
    the page is drawn from that.

    Returns
    -------
    str
        Why it could not be drawn; empty where it was, or there is none.
    """
    try:
        with alone(out / LOCK):
            for _ in range(3):
                if not (out / RECORD).is_file() or not (out / PAGE).is_file():
                    break
                before = (out / RECORD).stat()
                record = read_night(out)
                folder = out / NIGHTS / Path(record.name).name
                if not folder.is_dir():
                    break
                take_in_decisions(record, out)
                write_pages(record, folder, out)
                after = (out / RECORD).stat()
                if (before.st_ino, before.st_mtime_ns) == (after.st_ino, after.st_mtime_ns):
                    break
        return ""
    except NlightsError as fault:
        return str(fault)
    except Exception as fault:  # a record of another version may hold anything
        return f"{out / RECORD}: the page could not be drawn from it ({type(fault).__name__}: {fault})"


def _tiles_of(out: Path) -> list[Path]:
    """Folders of products, OUT/<artwork>/<tile>, by name."""
    return [folder for folder in product_folders(out) if folder.parent.parent == out]


def _artwork_of(folder: Path) -> str:
    """Inventory number of the artwork that a tile's products belong to."""
    own = folder.parent.name
    try:
        written = read_provenance(folder).get("artwork")
    except NlightsError:
        return unquote(own)
    return written if isinstance(written, str) and folder_of(written) == own else unquote(own)
