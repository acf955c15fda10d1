"""The quality numbers of a tile, held against the limits."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nlights_flows.nights.limits import VERDICTS, Limits


def numbers_of(products: Path, limits: Limits) -> tuple[list[dict[str, Any]], str | None, float | None]:
    """Read the quality numbers of a tile.

    Parameters
    ----------
    products : Path
        Its folder.
    limits : Limits

    Returns
    -------
    numbers : list of dict
        Those with a limit, see `Limits.judged`.
    verdict : str or None
        The worst of them; None where none was measured.
    megapixels : float or None
        Size of the products.
    """
    try:
        rows = json.loads((products / "quality.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return [], None, None
    judged = limits.judged(rows)
    return judged, _worst([row["verdict"] for row in judged]), _megapixels(products / "height.tif")


def _worst(found: Sequence[str | None]) -> str | None:
    known = [VERDICTS.index(verdict) for verdict in found if verdict in VERDICTS]
    return VERDICTS[max(known)] if known else None


def _megapixels(height: Path) -> float | None:
    import tifffile

    try:
        with tifffile.TiffFile(height) as file:
            rows, columns = file.pages.first.shape[:2]
    except (OSError, ValueError, tifffile.TiffFileError):
        return None
    return float(rows * columns / 1e6)
