"""The page of a night, ``night.html``: one self-contained file, read at eight in the morning."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nlights_core import __version__
from nlights_core.report.figures import figure_of
from nlights_core.store import write_whole
from nlights_flows.nights.charts import HEIGHT, WIDTH, chart, newly_outside
from nlights_flows.nights.decisions import describe_decision, standing
from nlights_flows.nights.estimates import format_bytes
from nlights_flows.nights.limits import VERDICTS
from nlights_flows.nights.pictures import thumbnail
from nlights_flows.nights.record import PAGE, NightRecord, summarise_night
from nlights_flows.tiles.pages import template

MOST = 300
"""Tiles of which the page shows picture and numbers, and lines of each list; with more it grows too large for a
browser.  The rest is counted; all of it is in ``night.json``."""

LISTS = ("doubts", "beyond", "older", "repeats", "accepted", "noted", "waiting")
"""Lists of the page with a line for each entry."""

WORDS = {
    "ok": "within its limits",
    "warn": "to be watched",
    "fail": "beyond its limit",
    None: "not measured",
}
"""What colours say, in words."""


def write_pages(record: NightRecord, folder: Path, out: Path) -> None:
    """Write the page into the night's folder and, as the newest, into OUT; each appears whole.

    Raises
    ------
    OSError
        When one cannot be written.
    """
    page = template(Path(__file__).with_name("night.html.j2"))
    shown = _shown(record, out)
    for place, up in ((folder, "../../"), (out, "")):
        write_whole(place / PAGE, page.render(up=up, **shown))


def _shown(record: NightRecord, out: Path) -> dict[str, Any]:
    data = record.as_json()
    drawn = 0
    for artwork in data["artworks"]:
        for tile in artwork["tiles"]:
            tile["link"] = quote(tile["products"]) + "/report.html" if tile["products"] else ""
            tile["picture"] = ""
            if tile["products"] and drawn < MOST:
                drawn += 1
                tile["picture"] = thumbnail(out / tile["products"], out, draw=tile["state"] == "done")
            tile["numbers"] = number_rows(tile["numbers"])
            tile["decided"] = [
                (one["decision"] if one["counts"] else "former", describe_decision(one))
                for one in tile["review"]
            ]
    artworks = data["artworks"]
    shown: dict[str, Any] = {
        "record": data,
        "version": __version__,
        "sentence": summarise_night(record),
        "mood": mood(data),
        "failures": [
            {**a, "tiles": [t for t in a["tiles"] if t["state"] == "failed"]}
            for a in artworks
            if a["state"] == "failed"
        ],
        "doubts": doubts(artworks),
        "beyond": beyond(artworks),
        "older": older(artworks),
        "repeats": decided(artworks, "repeat"),
        "accepted": decided(artworks, "accept"),
        "moved": moved(data),
        "left": [
            {**a, "tiles": [t for t in a["tiles"] if t["state"] in ("left", "claimed elsewhere")]}
            for a in artworks
            if any(t["state"] in ("left", "claimed elsewhere") for t in a["tiles"])
        ],
        "noted": [(a, t) for a in artworks for t in a["tiles"] if t["notes"]],
        "waiting": [a for a in artworks if a["state"] == "waiting"],
        "tonight": [a for a in artworks if a["tiles"] and a["state"] != "unchanged"],
        "finished": sum(a["state"] == "unchanged" for a in artworks),
        "before": [a for a in artworks if a["state"] == "unchanged"],
        "stands": [
            {**stand, "charts": [chart(trend) for trend in stand["charts"]]} for stand in data["trends"]
        ],
        "disks": [
            (
                name,
                data[name],
                format_bytes(disk["free"]),
                f"{100 * disk['free'] / max(disk['total'], 1):.0f}",
            )
            for name, disk in data["disk"].items()
        ],
        "facts": _facts(data),
        "duration": duration,
        "figure_of": figure_of,
        "words": WORDS,
        "chart_size": (WIDTH, HEIGHT),
    }
    more = {name: max(len(shown[name]) - MOST, 0) for name in LISTS}
    shown |= {name: shown[name][:MOST] for name in LISTS}
    for name in ("failures", "left", "tonight", "before"):
        shown[name], more[name] = first_tiles(shown[name], MOST)
    return {**shown, "more": more}


def first_tiles(artworks: Sequence[Mapping[str, Any]], most: int) -> tuple[list[dict[str, Any]], int]:
    """Artworks with so many tiles together, and how many tiles are left out; one without tiles counts as one.

    Examples
    --------
    >>> first_tiles([{"tiles": "ab"}, {"tiles": ""}, {"tiles": "cd"}, {"tiles": "e"}], 4)
    ([{'tiles': 'ab'}, {'tiles': ''}, {'tiles': 'c'}], 2)
    """
    found: list[dict[str, Any]] = []
    room = most
    for artwork in artworks:
        if room > 0:
            found.append({**artwork, "tiles": artwork["tiles"][:room]})
        room -= max(len(artwork["tiles"]), 1)
    return found, max(-room, 0)


def number_rows(numbers: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The numbers of a tile to be shown: of those per lamp the worst only, with the limit in words."""
    worst: dict[str, Mapping[str, Any]] = {}
    for row in numbers:
        known = worst.get(row["limit"])
        if known is None or _badness(row) > _badness(known):
            worst[row["limit"]] = row
    return [
        {
            **row,
            "shown": figure_of(row["value"], row["unit"]),
            "word": WORDS[row["verdict"]],
            "allowed": _allowed(row),
        }
        for row in worst.values()
    ]


def _badness(row: Mapping[str, Any]) -> tuple[int, float]:
    if row["verdict"] is None:
        return -1, 0.0
    return VERDICTS.index(row["verdict"]), -row["value"] if row["smallest"] else row["value"]


def _allowed(row: Mapping[str, Any]) -> str:
    word = "at least" if row["smallest"] else "at most"
    limits = f"warns at {row['warn']:g}"
    return f"{word} {row['fail']:g}, {limits}" if row["fail"] is not None else f"{word} {row['warn']:g}"


def doubts(artworks: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Warnings about captures of this night that nobody has decided on: artwork, tile, link, sentence."""
    return [
        (artwork["artwork"], tile["tile"], tile["link"], warning["sentence"])
        for artwork, tile in _undecided(artworks, "done")
        for warning in tile["warnings"]
    ]


def beyond(artworks: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, dict[str, Any]]]:
    """Numbers not within their limits that nobody has decided on: artwork, tile, link, number; the worst first."""
    found = [
        (artwork["artwork"], tile["tile"], tile["link"], row)
        for artwork, tile in _undecided(artworks, "done")
        for row in tile["numbers"]
        if row["verdict"] in ("warn", "fail")
    ]
    return sorted(found, key=lambda one: -VERDICTS.index(one[3]["verdict"]))


def older(artworks: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """Tiles of nights before that still wait for a decision: artwork, tile, link, what is to be looked at."""
    found = []
    for artwork, tile in _undecided(artworks, "unchanged"):
        bad = sum(row["verdict"] in ("warn", "fail") for row in tile["numbers"])
        parts = [f"{bad} number{'s' * (bad != 1)} not within limits"] if bad else []
        parts += [warning["sentence"] for warning in tile["warnings"]]
        if parts:
            found.append((artwork["artwork"], tile["tile"], tile["link"], "; ".join(parts)))
    return found


def decided(artworks: Sequence[Mapping[str, Any]], choice: str) -> list[tuple[str, str, str, str]]:
    """Tiles about which people have decided so: artwork, tile, link, sentence."""
    return [
        (artwork["artwork"], tile["tile"], tile["link"], describe_decision(one))
        for artwork in artworks
        for tile in artwork["tiles"]
        if (one := standing(tile["review"])) and one["decision"] == choice
    ]


def _undecided(artworks: Sequence[Mapping[str, Any]], state: str) -> Iterator[tuple[Any, Any]]:
    return (
        (artwork, tile)
        for artwork in artworks
        for tile in artwork["tiles"]
        if tile["state"] == state and not standing(tile["review"])
    )


def mood(data: Mapping[str, Any]) -> str:
    """Mood of the night, as the colour of its heading: "bad", "open" or "good"."""
    states = {artwork["state"] for artwork in data["artworks"]}
    tiles = [tile for artwork in data["artworks"] for tile in artwork["tiles"]]
    verdicts = {tile["verdict"] for tile in tiles if not standing(tile["review"])}
    if "failed" in states or "fail" in verdicts:
        return "bad"
    unfinished = states & {"left", "waiting", "claimed elsewhere"}
    artworks = data["artworks"]
    noted = any(tile["notes"] for tile in tiles)
    waits = doubts(artworks) or older(artworks) or decided(artworks, "repeat")
    watched = unfinished or noted or "warn" in verdicts or waits or moved(data)
    return "open" if watched else "good"


def moved(data: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Charts that this night has left their limits: stand, chart."""
    return [
        (stand["stand"], chart(trend))
        for stand in data["trends"]
        for trend in stand["charts"]
        if newly_outside(trend, data["name"])
    ]


def duration(seconds: float) -> str:
    """Seconds as a person says them.

    Examples
    --------
    >>> duration(7.4), duration(130), duration(7500)
    ('7 s', '2 min 10 s', '2 h 5 min')
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def _facts(data: Mapping[str, Any]) -> list[tuple[str, str]]:
    clock = "%H:%M"
    started = datetime.fromisoformat(data["started"])
    ran = f"began {started:{clock}}"
    if data["ended"]:
        ran += f", ended {datetime.fromisoformat(data['ended']):{clock}}, took {duration(data['seconds'])}"
    until = f"{datetime.fromisoformat(data['until']):{clock}}" if data["until"] else "no limit"
    estimate = data["estimate"]
    per = (
        f"{estimate['constant']:.1f} s and {estimate['slope']:.2f} s per megapixel"
        if estimate
        else "not known"
    )
    told = data["notified"]
    return [
        ("Night", data["name"]),
        ("Ran", ran),
        ("Until", until),
        ("Inbox", data["inbox"]),
        ("Products", data["out"]),
        ("Recipe", data["recipe"]),
        ("A tile takes", per),
        *([("Told of this night", told["host"])] if told and told["told"] else []),
    ]
