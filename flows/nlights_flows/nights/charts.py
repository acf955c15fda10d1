"""Control charts as small pictures: where every point and line of a chart stands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nlights_core.report.figures import figure_of

WIDTH, HEIGHT = 300.0, 96.0
"""Of a chart, in its own units."""
EDGE = 8.0


def chart(trend: Mapping[str, Any]) -> dict[str, Any]:
    """Place a trend of `nlights_flows.nights.trends.trends` on a picture.

    Returns
    -------
    dict
        "name", "unit", "points" ("x", "y", "outside", "new_flats", "said"), "path" of the line between them,
        "lines" ("y", "kind") and "sentence", which says in words what the picture shows.
    """
    points, unit = trend["points"], trend["unit"]
    values = [point["value"] for point in points]
    lines = {"centre": trend["centre"], "low": trend["low"], "high": trend["high"]}
    shown = values + [value for value in lines.values() if value is not None]
    # A chart of nearly equal values must not show their last digit as a mountain.
    middle = (max(shown) + min(shown)) / 2
    reach = max((max(shown) - min(shown)) / 2, 0.002 * abs(middle), 1e-12)

    def x(i: int) -> float:
        return EDGE + (WIDTH - 2 * EDGE) * (i + 0.5) / len(points)

    def y(value: float) -> float:
        return float(HEIGHT / 2 - (value - middle) / reach * (HEIGHT / 2 - EDGE))

    placed = [
        {
            "x": f"{x(i):.1f}",
            "y": f"{y(point['value']):.1f}",
            "outside": point["outside"],
            "new_flats": point["new_flats"],
            "said": f"{point['night']}, {point['artwork']}: {figure_of(point['value'])} {unit}"
            + ("" if point["new_flats"] else " (the same flats as before)"),
        }
        for i, point in enumerate(points)
    ]
    return {
        "name": trend["name"],
        "unit": unit,
        "points": placed,
        "path": " ".join(f"{point['x']},{point['y']}" for point in placed),
        "lines": [
            {"kind": kind, "y": f"{y(value):.1f}"} for kind, value in lines.items() if value is not None
        ],
        "newest": figure_of(values[-1]),
        "outside": newly_outside(trend, points[-1]["night"]),
        "sentence": _sentence(trend),
    }


def newly_outside(trend: Mapping[str, Any], night: str) -> bool:
    """Test whether a capture of a night is outside the limits; what was told before need not alarm again."""
    return any(point["outside"] and point["night"] == night for point in trend["points"])


def _sentence(trend: Mapping[str, Any]) -> str:
    centre, low, high = (figure_of(trend[key]) for key in ("centre", "low", "high"))
    if trend["low"] is None:
        return f"median {centre}; too few flat sets for limits"
    outside = [point for point in trend["points"] if point["outside"]]
    told = ", ".join(f"{point['artwork']} ({point['night']})" for point in outside[-3:])
    said = f"OUTSIDE: {told}" if outside else "all inside"
    return f"median {centre}, limits {low} to {high}; {said}"
