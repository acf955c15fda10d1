"""Words of a tile's products: its quality numbers, held against the limits, its warnings, what people decided."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nlights_core.capture_warnings import CaptureWarning, read_warnings
from nlights_core.errors import NlightsError
from nlights_flows.nights.decisions import reviewed
from nlights_flows.nights.limits import VERDICTS, Limits
from nlights_flows.nights.record import TileEntry
from nlights_flows.nights.trends import measured
from nlights_flows.tiles.records import read_provenance, read_quality

DAMAGED = "damaged-record"
"""Code of the warning that a file among the products is not what nLights wrote."""


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

    Raises
    ------
    CaptureError
        When ``quality.json`` is damaged.
    """
    judged = limits.judged(read_quality(products))
    return judged, _worst([row["verdict"] for row in judged]), _megapixels(products / "height.tif")


def look_at_products(entry: TileEntry, products: Path, limits: Limits) -> None:
    """Enter what a tile's products say of themselves, and people of them; what is damaged is a warning."""
    entry.warnings = []
    faults = []
    try:
        entry.numbers, entry.verdict, size = numbers_of(products, limits)
        entry.megapixels = entry.megapixels or size
    except NlightsError as fault:
        faults.append(str(fault))
    try:
        entry.warnings = [warning.record() for warning in read_warnings(products)]
    except NlightsError as fault:
        faults.append(str(fault))
    try:
        read_provenance(products)
    except NlightsError as fault:
        faults.append(str(fault))
    entry.measured = measured(products)
    entry.review, fault_of_review = reviewed(products)
    faults += [fault_of_review] * bool(fault_of_review and fault_of_review not in faults)
    entry.warnings += [CaptureWarning(DAMAGED, said).record() for said in faults]


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
