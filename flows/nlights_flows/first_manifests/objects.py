"""Lists of artworks, ``objects.csv``: many folders, a first manifest for each."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

from nlights_core.errors import CaptureError, NlightsError
from nlights_core.names.artworks import folder_of
from nlights_flows.first_manifests.writing import Wanted, Written, write_manifest

COLUMNS = ("folder", *(field.name for field in fields(Wanted)))


@dataclass(frozen=True)
class Row:
    """A row: where it stands, its folder and what is wanted."""

    line: int
    folder: Path
    wanted: Wanted


def read_objects(path: Path, base: Path | None = None, stand: str = "") -> list[Row]:
    """Read a list of artworks: text in UTF-8, columns divided by commas, semicolons or tabs.

    Parameters
    ----------
    path : Path
        The list.
    base : Path, optional
        Where relative folders begin; the list's own folder by default.
    stand : str
        Of the rows that name none.

    Raises
    ------
    CaptureError
        When it cannot be read, or a column is missing or unknown.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as fault:
        said = fault.strerror if isinstance(fault, OSError) else "it is not text in UTF-8"
        raise CaptureError(f"{path}: cannot be read ({said}); save the list as CSV in UTF-8") from fault
    first = text.split("\n", 1)[0]
    divider = max(",;\t", key=first.count)
    rows = csv.DictReader(text.splitlines(), delimiter=divider)
    columns = [(name or "").strip().lower() for name in rows.fieldnames or ()]
    unknown = [name for name in columns if name not in COLUMNS]
    if "folder" not in columns or unknown:
        wrong = (
            f"unknown column {', '.join(map(repr, unknown))}" if unknown else "the column 'folder' is missing"
        )
        raise CaptureError(f"{path}:1: {wrong}; columns are {', '.join(COLUMNS)}, and only folder is needed")
    found = []
    for row in rows:
        values = {
            column: (value or "").strip()
            for column, value in zip(columns, list(row.values())[: len(columns)], strict=True)
        }
        if any(values.values()):
            folder = Path(values.pop("folder"))
            values["stand"] = values.get("stand") or stand
            found.append(Row(rows.line_num, (base or path.parent) / folder, Wanted(**values)))
    return found


def write_manifests(path: Path, rows: list[Row]) -> Iterator[Written | str]:
    """Write the manifest of each row; a row that fails is told with its line, and costs no other."""
    taken: dict[str, int] = {}
    for row in rows:
        where = f"{path}:{row.line}"
        number = row.wanted.id or row.folder.resolve().name
        before = taken.setdefault(folder_of(number).casefold(), row.line)
        try:
            if before != row.line:
                raise CaptureError(
                    f"the id '{number}' stands in line {before} already, capitals apart; correct one"
                )
            yield write_manifest(row.folder, row.wanted)
        except (NlightsError, OSError) as fault:
            yield f"{where}: {fault}"
