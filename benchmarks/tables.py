"""Tables of figures: as Markdown between marker comments of a page, and as JSON beside it."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Cell = str | float | None
"""None: not measured."""


@dataclass(frozen=True)
class Table:
    """Figures with the names of their columns.

    Parameters
    ----------
    name : str
        What its markers in the page and its key in the JSON are called.
    columns : tuple of str
        With units.
    rows : list of tuples
        A cell per column.
    """

    name: str
    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]

    def markdown(self) -> str:
        """The table as a page shows it, numbers to three significant digits."""
        lines = [self.columns, tuple("---" for _ in self.columns)]
        lines += [tuple(shown(cell) for cell in row) for row in self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def record(self) -> list[dict[str, Cell]]:
        """The rows with their columns' names and all digits."""
        return [dict(zip(self.columns, row, strict=True)) for row in self.rows]


def shown(cell: Cell) -> str:
    """A cell as people read it.

    >>> shown(0.12996), shown(4.1), shown(1234.5), shown(2e-7), shown(None)
    ('0.130', '4.10', '1234', '2.00e-07', '-')
    """
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    if abs(cell) >= 100:
        return f"{cell:.0f}"
    return f"{cell:#.3g}"


def kept(limit_is_kept: bool) -> str:
    """Whether a figure keeps to its limit, in words."""
    return "met" if limit_is_kept else "**missed**"


def write(
    folder: Path, page: str, tables: list[Table], conditions: dict[str, Any], data: str | None = None
) -> None:
    """Put tables into a Markdown page and its JSON; all else there stays as it is.

    Parameters
    ----------
    folder : Path
        Made if it is absent; so are the files.
    page : str
        Name of both files without their ending.
    tables : list of Table
        Each replaces what stands between its markers, ``<!-- table NAME -->`` and ``<!-- end NAME -->``;
        without markers it is appended.
    conditions : dict
        How the figures were made; kept beside each table in the JSON.
    data : str, optional
        Name of the JSON, where it is not the page's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    prose, figures = folder / f"{page}.md", folder / f"{data or page}.json"
    text = prose.read_text(encoding="utf-8") if prose.exists() else f"# {page.capitalize()}\n"
    record = json.loads(figures.read_text(encoding="utf-8")) if figures.exists() else {}
    for table in tables:
        text = inserted(text, table)
        record[table.name] = {"made": conditions, "rows": table.record()}
    prose.write_text(text, encoding="utf-8")
    figures.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def inserted(text: str, table: Table) -> str:
    """A page with a table between its markers."""
    first, last = f"<!-- table {table.name} -->", f"<!-- end {table.name} -->"
    block = f"{first}\n{table.markdown()}{last}"
    if first not in text:
        return f"{text.rstrip()}\n\n{block}\n"
    return re.sub(f"{re.escape(first)}.*?{re.escape(last)}", lambda _: block, text, flags=re.DOTALL)
