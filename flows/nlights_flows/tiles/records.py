"""Records among a tile's products, read so that a damaged one is told and never taken for a good one."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from nlights_core.errors import CaptureError
from nlights_core.products.writing import PROVENANCE

MADE_AGAIN = "see `nlights verify`, or digitise the artwork again"
"""What to do about one."""

QUALITY = "quality.json"

_TEXTS = ("group", "name", "unit")


def read_quality(products: Path) -> list[dict[str, Any]]:
    """Quality numbers of a tile, as they stand in ``quality.json``.

    Returns
    -------
    list of dict
        Each with "group", "name", "unit" (text) and "value" (a finite number, or None where not measured).

    Raises
    ------
    CaptureError
        When the file is not there, or holds something else.
    """
    path = products / QUALITY
    rows = read_json(path)
    if not isinstance(rows, list):
        raise damaged(path, "should be a list of numbers")
    for i, row in enumerate(rows):
        if not isinstance(row, dict) or not all(isinstance(row.get(key), str) for key in _TEXTS):
            raise damaged(path, f"number {i + 1} lacks a name, group or unit")
        value = row.get("value", "")
        if value is not None and not _is_number(value):
            raise damaged(path, f"the value of '{row['name']}' is no number")
    return rows


def read_provenance(products: Path) -> dict[str, Any]:
    """Record of what made a tile's products, as it stands in ``provenance.json``.

    Raises
    ------
    CaptureError
        When the file is not there, or has no key.
    """
    path = products / PROVENANCE
    found = read_json(path)
    if not isinstance(found, dict) or not isinstance(found.get("key"), str):
        raise damaged(path, "should be a record with a key")
    return found


def read_json(path: Path, remedy: str = MADE_AGAIN) -> Any:
    """Contents of a JSON file.

    Raises
    ------
    CaptureError
        When it cannot be read or is no JSON; not-a-number is none.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except OSError as fault:
        raise CaptureError(f"{path}: cannot be read ({fault.strerror})") from None
    except (ValueError, RecursionError) as fault:
        reason = "nested too deep" if isinstance(fault, RecursionError) else str(fault)
        raise damaged(path, reason, remedy) from None


def damaged(path: Path, reason: str, remedy: str = MADE_AGAIN) -> CaptureError:
    """Fault of a record that is not what nLights wrote."""
    return CaptureError(f"{path}: is damaged ({reason}); {remedy}")


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
