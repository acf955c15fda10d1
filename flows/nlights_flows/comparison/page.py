"""The page of a comparison, ``compare.html``: one self-contained file."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nlights_core.report.figures import NOT_MEASURED, figure_of
from nlights_flows.comparison.comparing import Comparison
from nlights_flows.comparison.pictures import TilePictures, tile_pictures
from nlights_flows.tiles.pages import template

TILES = 3
"""Tiles of which pictures are shown; each takes some megabytes."""


def write_page(path: Path, comparison: Comparison) -> None:
    """Write the page: it needs nothing else, and its only script is the curtain's.

    Parameters
    ----------
    path : Path
        File to write.
    comparison : Comparison
        What was found.

    Raises
    ------
    OSError
        When it cannot be written, or a product has gone.
    """
    from markupsafe import Markup

    record = comparison.record
    script = Path(__file__).with_name("curtain.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    metrics = [metric for metric in record["metrics"] if metric["over"]]
    page = template(Path(__file__).with_name("compare.html.j2")).render(
        record=record,
        metrics=[(metric, table_rows(metric)) for metric in metrics],
        unmeasured=[metric for metric in record["metrics"] if not metric["over"]],
        verdicts=[describe_metric(metric) for metric in metrics],
        overall=overall(record["metrics"]),
        described=[
            (row["title"], row["unit"], [figure_of(value, row["unit"]) for value in row["values"].values()])
            for row in record["described"]
        ],
        options=differing_options(record),
        stages=stage_rows(record),
        tiles=_pictures(comparison),
        tile_rows=tile_rows(record),
        failures=[run for run in record["runs"] if run["state"] == "failed"],
        pair=chosen_pair(record),
        figure_of=figure_of,
        over=over,
        script=Markup(script),
        digest=digest,
    )
    path.write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n")


def _pictures(comparison: Comparison) -> list[TilePictures]:
    names = comparison.record["compared"]
    measured = {tile["name"]: tile for tile in comparison.record["tiles"] if tile["compared"]}
    drawn = []
    for case, grid in comparison.cases[:TILES]:
        folders = [comparison.runs[name, case.name].outcome.folder for name in names]
        # The truth was used in the numbers, so it fits.
        truth = case.truth if "angle_error" in measured[case.name]["values"] else None
        drawn.append(tile_pictures(case.name, names, [f for f in folders if f is not None], truth, grid))
    return drawn


def signed(value: float) -> str:
    """A difference with its sign, as a person writes it."""
    return ("+" if value > 0 else "") + figure_of(value)


def ranged(interval: Sequence[float] | None) -> str:
    """An interval as a person writes it."""
    if interval is None:
        return "no interval"
    return f"{figure_of(interval[0])} to {figure_of(interval[1])}"


def over(metric: Mapping[str, Any]) -> str:
    """Name what the interval of a metric is over, in words."""
    found = metric["over"]
    tiles = f"{found['tiles']} tile{'s' * (found['tiles'] != 1)}"
    if found["kind"] == "tiles":
        return f"over {tiles}"
    what = "blocks" if found["kind"] == "blocks" else "lamps"
    return f"over {found['places']} {what} of {tiles}"


def describe_metric(metric: Mapping[str, Any]) -> str:
    """Verdict of a metric, in one or two sentences."""
    unit, rows = metric["unit"], [row for row in metric["variants"] if row["value"] is not None]
    title = metric["title"]
    if len(rows) < 2:
        return f"{title}: measured for one variant only, so nothing is compared."
    if len({row["value"] for row in rows}) == 1:
        return f"{title}: {figure_of(rows[0]['value'])} {unit} for every variant, so nothing is ranked."
    if all(row["rank"] is None for row in rows):
        return f"{title}: too few independent places for an interval, so nothing is ranked."
    first = sorted((row for row in rows if row["rank"] == 1), key=lambda row: row["value"])
    names = "; ".join(row["name"] for row in first)
    if not metric["winners"]:
        return f"{title}: no winner, not told apart are {names}."
    nearest = min((row for row in rows if row["rank"] > 1), key=lambda row: row["value"])
    away = nearest["to_best"]
    several = f"best are {names} (not told apart), from" if len(first) > 1 else f"best is {names} with"
    return (
        f"{title}: {several} {figure_of(first[0]['value'])} {unit}; {nearest['name']} comes next, worse by "
        f"{figure_of(away['value'])} {unit} (95 % interval {ranged(away['interval'])})."
    )


def overall(metrics: Sequence[Mapping[str, Any]]) -> str:
    """The answer in one sentence: who wins against the truth."""
    true = [metric for metric in metrics if metric["needs_truth"] and metric["over"]]
    if not true:
        return (
            "There is no truth for these captures. The numbers below say how well the photographs agree with each "
            "variant; the smallest is not proved to be the most correct."
        )
    told = [metric for metric in true if metric["winners"]]
    if not told:
        return "Against the truth no variant is told apart from the best."
    common = [name for name in told[0]["winners"] if all(name in metric["winners"] for metric in told)]
    by = " and ".join(
        metric["title"].split(",")[0][0].lower() + metric["title"].split(",")[0][1:] for metric in told
    )
    if not common:
        return "Against the truth it depends on what is asked: no variant is among the best by every measure."
    rest = "" if len(told) == len(true) else "; by the other measure nobody is told apart"
    if len(common) == 1:
        return f"Against the truth the winner is {common[0]} ({by}){rest}."
    return f"Against the truth the best are {'; '.join(common)}, which are not told apart ({by}){rest}."


def table_rows(metric: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a metric's table, best first, with places for the drawn intervals in percent."""
    rows = sorted(metric["variants"], key=lambda row: (row["value"] is None, row["value"] or 0.0))
    ends = [
        end
        for row in rows
        if row["value"] is not None
        for end in (row["to_best"]["value"], *(row["to_best"]["interval"] or ()))
    ]
    low, high = min((0.0, *ends)), max((0.0, *ends))
    span = (high - low) or 1.0

    def place(value: float) -> float:
        return float(5 + 90 * (value - low) / span)

    ranks = [row["rank"] for row in rows]
    shown = []
    for row in rows:
        if row["value"] is None:
            shown.append({"name": row["name"], "rank": "", "value": NOT_MEASURED, "bar": None, "wins": False})
            continue
        best, first = row["to_best"], row["to_first"]
        shared = row["rank"] is not None and ranks.count(row["rank"]) > 1
        interval = best["interval"]
        shown.append(
            {
                "name": row["name"],
                "wins": row["name"] in metric["winners"],
                "rank": "not ranked" if row["rank"] is None else f"{row['rank']}{' =' if shared else ''}",
                "value": figure_of(row["value"]),
                "interval": ranged(row["interval"]),
                "to_best": "best" if row["best"] else signed(best["value"]),
                "to_best_interval": "" if row["best"] else ranged(interval),
                "to_first": signed(first["value"]) if first else NOT_MEASURED,
                "to_first_interval": ranged(first["interval"]) if first and first["value"] else "",
                "bar": {
                    "zero": place(0.0),
                    "dot": place(best["value"]),
                    "left": place(interval[0]) if interval else place(best["value"]),
                    "width": 90 * (interval[1] - interval[0]) / span if interval else 0.0,
                },
            }
        )
    return shown


def chosen_pair(record: Mapping[str, Any]) -> tuple[str, str]:
    """The variants that the curtain shows first: the first one and the best, or the worst where that is the first."""
    names = record["compared"]
    if len(names) < 2:
        return ("", "")
    for metric in record["metrics"]:
        values = {row["name"]: row["value"] for row in metric["variants"] if row["value"] is not None}
        if names[0] in values:
            best, worst = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
            other = best if values[best] < values[names[0]] else worst
            return (names[0], other if other != names[0] else names[1])
    return names[0], names[1]


def differing_options(record: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """The fields in which the recipes differ, with each variant's value."""
    flat = [dict(_leaves("", variant["recipe"])) for variant in record["variants"]]
    fields = dict.fromkeys(field for one in flat for field in one)
    rows = [(field, [str(one.get(field, "\N{EN DASH}")) for one in flat]) for field in fields]
    return [(field, values) for field, values in rows if len(set(values)) > 1]


def _leaves(name: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [
            leaf for key, part in value.items() for leaf in _leaves(f"{name}.{key}" if name else key, part)
        ]
    return [(name, value)]


def stage_rows(record: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Rows of stages: for each variant, on the first tile that was run, which artefact it is and what it cost.

    Returns
    -------
    list of (stage, cells)
        A cell is a letter, the same for the same artefact, and a sentence.
    """
    tile = next((one["name"] for one in record["tiles"] if one["compared"]), None)
    runs = {run["variant"]: run["stages"] for run in record["runs"] if run["tile"] == tile}
    names = [variant["name"] for variant in record["variants"]]
    stages = dict.fromkeys(made["stage"] for name in names for made in runs.get(name, ()))
    said = {"made": "made", "shared": "shared", "kept": "in the store before"}
    rows = []
    for stage in stages:
        letters: dict[str, str] = {}
        cells = []
        for name in names:
            made = next((one for one in runs.get(name, ()) if one["stage"] == stage), None)
            if made is None:
                cells.append(("\N{EN DASH}", ""))
                continue
            letter = letters.setdefault(made["key"], _letter(len(letters)))
            cells.append((letter, f"{said[made['origin']]}, {made['seconds']:.1f} s"))
        rows.append((stage, cells))
    return rows


def _letter(number: int) -> str:
    return chr(ord("A") + number) if number < 26 else str(number + 1)


def tile_rows(record: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, list[str]]]]]:
    """Rows of tiles: for each ranked metric, every tile's number of every variant."""
    rows = []
    for metric in record["metrics"]:
        tiles = [tile for tile in record["tiles"] if tile["compared"] and metric["key"] in tile["values"]]
        cells = [
            (
                tile["name"],
                [figure_of(value) for value in tile["values"][metric["key"]].values()],
            )
            for tile in tiles
        ]
        if cells:
            rows.append((f"{metric['title']}, {metric['unit']}", cells))
    return rows
