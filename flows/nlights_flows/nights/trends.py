"""Trends of a stand from capture to capture, as control charts: each lamp's flat, how it fits, the noise."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.errors import NlightsError
from nlights_core.report.flat_quality import LEVEL, NOISE
from nlights_flows.tiles.records import read_provenance, read_quality

CAPTURES = 30
"""Of a stand, so many of the newest captures are shown."""

RESIDUAL = "Flats against computed lamps, rms"
FOLLOWED = (LEVEL, RESIDUAL, NOISE)
"""Numbers that are followed; those per lamp without the lamp."""

ENOUGH = 6
"""Flat sets from which limits are drawn; fewer say nothing about scatter."""

SIGMAS = 3.0
NARROWEST = 0.002
"""No limit is nearer to the centre than this share of it: a photograph is not repeated better."""


def measured(products: Path) -> dict[str, Any] | None:
    """Values of a tile that the trends follow: its stand, its flat set and its numbers.

    Returns
    -------
    dict or None
        "stand", "flats" (digest), "numbers" (value and unit by name).  None where there is no stand or no
        photographed flat.
    """
    try:
        provenance, rows = read_provenance(products), read_quality(products)
        stand = (provenance.get("stand") or {}).get("name")
        flats = next(
            (s["facts"].get("flats") for s in provenance["stages"] if s["stage"] == "flat_field"), None
        )
    except (NlightsError, KeyError, TypeError, AttributeError):  # damaged, which is told with its numbers
        return None
    if not stand or not flats:
        return None
    digest = hashlib.sha256(json.dumps(flats, sort_keys=True).encode()).hexdigest()[:12]
    numbers = {
        row["name"]: {"value": row["value"], "unit": row["unit"]}
        for row in rows
        if row["value"] is not None and _followed(row["name"])
    }
    return {"stand": stand, "flats": digest, "numbers": numbers}


def _followed(name: str) -> bool:
    return name in FOLLOWED or name.startswith(f"{LEVEL}, ")


def trends(captures: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Control charts of every stand.

    Parameters
    ----------
    captures : iterable of dict
        From `captures_of`, of several nights, newest first; `CAPTURES` of a stand are looked at.

    Returns
    -------
    list of dict
        "stand", "captures" and "charts"; a chart has "name", "unit", "points" (oldest first; "value", "night",
        "artwork", "new_flats", "outside"), "centre", and "low" and "high" (None where there are too few flats).
    """
    stands: dict[str, list[dict[str, Any]]] = {}
    for capture in newest_of_each_stand(captures):
        stands.setdefault(capture["stand"], []).append(capture)
    return [_charts(stand, list(reversed(found))) for stand, found in sorted(stands.items())]


def newest_of_each_stand(captures: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Those captures that the charts show: `CAPTURES` of each stand at most; they come newest first."""
    seen: Counter[str] = Counter()
    for capture in captures:
        seen[capture["stand"]] += 1
        if seen[capture["stand"]] <= CAPTURES:
            yield capture


def captures_of(night: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Captures in a night's record, newest first: what was made of an artwork with one flat set."""
    for artwork in reversed(night["artworks"]):
        seen = set()
        for tile in artwork["tiles"]:
            found = tile["measured"]
            if tile["state"] != "done" or not found or found["flats"] in seen:
                continue
            seen.add(found["flats"])
            yield {
                "stand": str(found["stand"]),
                "flats": found["flats"],
                "numbers": found["numbers"],
                "night": night["name"],
                "artwork": artwork["artwork"],
            }


def _charts(stand: str, captures: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = dict.fromkeys(name for capture in captures for name in capture["numbers"])
    charts = []
    for name in names:
        flats: set[str] = set()
        points = []
        for capture in captures:
            if name not in capture["numbers"]:
                continue
            points.append(
                {
                    "night": capture["night"],
                    "artwork": capture["artwork"],
                    "value": capture["numbers"][name]["value"],
                    # The same flats tell nothing new, whatever was photographed with them.
                    "new_flats": capture["flats"] not in flats,
                }
            )
            flats.add(capture["flats"])
        unit = next(c["numbers"][name]["unit"] for c in captures if name in c["numbers"])
        centre, low, high = control_limits([p["value"] for p in points if p["new_flats"]])
        for point in points:
            point["outside"] = low is not None and high is not None and not low <= point["value"] <= high
        charts.append(
            {"name": name, "unit": unit, "centre": centre, "low": low, "high": high, "points": points}
        )
    return {"stand": stand, "captures": len(captures), "charts": charts}


def control_limits(values: Sequence[float]) -> tuple[float, float | None, float | None]:
    """Median, and three robust standard deviations below and above it.

    The deviation is the median distance from the median, scaled to that of a normal
    distribution, and corrected for few values by n / (n - 0.8).

    Returns
    -------
    centre, low, high : float
        Without limits (None) where there are fewer than `ENOUGH` values.

    Examples
    --------
    >>> control_limits([10, 11, 12, 10, 11, 12, 11, 50])[0]
    11.0
    """
    centre = float(np.median(values))
    if len(values) < ENOUGH:
        return centre, None, None
    scatter = 1.4826 * float(np.median(np.abs(np.asarray(values) - centre)))
    reach = max(SIGMAS * scatter * len(values) / (len(values) - 0.8), NARROWEST * abs(centre))
    return centre, centre - reach, centre + reach
