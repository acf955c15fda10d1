"""Earlier nights: of their records only what estimates and trends need, read one at a time."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import FiniteFloat, TypeAdapter
from typing_extensions import TypedDict

from nlights_core.machine.regular_files import irregular_kind
from nlights_flows.nights.inbox import NIGHTS
from nlights_flows.nights.record import RECORD
from nlights_flows.nights.trends import captures_of, newest_of_each_stand

REMEMBERED = 100
"""So many of the newest nights are looked at for times and trends."""

TIMED = 200
"""So many of the newest tiles tell how long one takes."""


class _Number(TypedDict):
    value: FiniteFloat
    unit: str


class _Measured(TypedDict):
    stand: str
    flats: str
    numbers: dict[str, _Number]


class _EarlierTile(TypedDict):
    state: str
    seconds: FiniteFloat
    megapixels: FiniteFloat | None
    measured: _Measured | None


class _EarlierArtwork(TypedDict):
    artwork: str
    tiles: list[_EarlierTile]


class EarlierNight(TypedDict):
    """Fields of a ``night.json`` that later nights use; one with others is of another version, or somebody's own."""

    schema: Literal[1]
    name: str
    recipe: str
    started: str
    artworks: list[_EarlierArtwork]


_EARLIER = TypeAdapter(EarlierNight)


@dataclass(frozen=True)
class Earlier:
    """Captures and times that are kept of earlier nights.

    Attributes
    ----------
    captures : list of dict
        Newest first, `nlights_flows.nights.trends.CAPTURES` of a stand at most.
    timed : list of (float, float)
        Megapixels and seconds of the tiles that nights with a recipe made, newest first, `TIMED` at most.
    """

    captures: list[dict[str, Any]]
    timed: list[tuple[float, float]]


def earlier_nights(out: Path, recipe: str, but: str = "") -> Earlier:
    """Look through the newest nights of an output folder; what cannot be read is left out.

    Parameters
    ----------
    out : Path
        Folder of the products.
    recipe : str
        Whose tiles tell how long one takes.
    but : str
        A night that is left out, by its name.
    """
    nights = []
    paths = (path for path in (out / NIGHTS).glob(f"*/{RECORD}") if path.parent.name != but)
    for path in sorted(paths, reverse=True)[:REMEMBERED]:
        # A record of a thousand tiles is large: nothing of it stays but these.
        with suppress(OSError, ValueError, RecursionError):  # pydantic's faults are ValueErrors
            if not irregular_kind(path):
                night = _EARLIER.validate_json(path.read_bytes(), strict=True)
                captures = list(newest_of_each_stand(captures_of(night)))
                nights.append((night["started"], captures, _timed(night, recipe)))
    nights.sort(key=lambda night: night[0], reverse=True)
    return Earlier(
        list(newest_of_each_stand(capture for _, captures, _ in nights for capture in captures)),
        [tile for _, _, timed in nights for tile in timed][:TIMED],
    )


def _timed(night: EarlierNight, recipe: str) -> list[tuple[float, float]]:
    if night["recipe"] != recipe:
        return []
    return [
        (tile["megapixels"], tile["seconds"])
        for artwork in night["artworks"]
        for tile in artwork["tiles"]
        if tile["state"] == "done" and tile["megapixels"] and tile["megapixels"] > 0 and tile["seconds"] >= 0
    ][:TIMED]
