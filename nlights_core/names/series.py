"""Series of names: photographs whose names differ by one number."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePath

from nlights_core.names.photographs import SPELLINGS, by_numbers

FEWEST = 3
"""Photographs of a series: photometric stereo needs so many."""


@dataclass(frozen=True)
class Series:
    """Names that differ by one number.

    Attributes
    ----------
    pattern : str
        With ``{n}`` in the number's place; empty where no pattern says it.
    names : tuple of str
        In the order of their numbers.
    keys : tuple of str
        The numbers as they are written, in the same order.
    """

    pattern: str
    names: tuple[str, ...]
    keys: tuple[str, ...]


def find_series(names: Iterable[str]) -> tuple[list[Series], list[str]]:
    """Find the series among the names of a folder.

    Returns
    -------
    series : list of Series
        Of `FEWEST` names or more.
    others : list of str
        Names of none.

    Examples
    --------
    >>> series, others = find_series(["b.10.tga", "b.9.tga", "b.11.tga", "b.mask.tga"])
    >>> series[0].pattern, series[0].names, others
    ('b.{n}.tga', ('b.9.tga', 'b.10.tga', 'b.11.tga'), ['b.mask.tga'])
    >>> find_series(["001.png", "002.png", "003.png"])[0][0].pattern
    '{n:03d}.png'
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    others = []
    for name in sorted(names, key=by_numbers):
        parts = _parts(name)
        if len(parts) > 1:
            path = PurePath(name)
            kin = next((same[0] for same in SPELLINGS if path.suffix.lower() in same), path.suffix.lower())
            alike.setdefault((*(part.lower() for part in _parts(path.stem)[::2]), kin), []).append(name)
        else:
            others.append(name)
    series = []
    for group in alike.values():
        for one in _divided(group):
            if len(one) >= FEWEST:
                series.append(_series(one))
            else:
                others += one
    return series, sorted(others, key=by_numbers)


def _parts(name: str) -> list[str]:
    """Text and numbers of a name in turn, text first."""
    return re.split(r"([0-9]+)", name)


def _divided(names: list[str]) -> list[list[str]]:
    """Names by the numbers in which they agree, so that one number differs; as they are where none does so."""
    stems = [_parts(PurePath(name).stem)[1::2] for name in names]
    varying = [i for i in range(len(stems[0])) if len({stem[i] for stem in stems}) > 1]
    for i in reversed(varying):
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, stem in zip(names, stems, strict=True):
            groups.setdefault((*stem[:i], *stem[i + 1 :]), []).append(name)
        if all(len(group) >= FEWEST for group in groups.values()):
            return list(groups.values())
    return [names]


def _series(names: list[str]) -> Series:
    stems = [_parts(PurePath(name).stem) for name in names]
    varying = [i for i in range(1, len(stems[0]), 2) if len({stem[i] for stem in stems}) > 1]
    keys = [stem[varying[-1]] if varying else str(i) for i, stem in enumerate(stems, 1)]
    order = sorted(range(len(names)), key=lambda i: (int(keys[i]), names[i]))
    ordered = tuple(names[i] for i in order)
    numbers = tuple(keys[i] for i in order)
    width = min(map(len, numbers))
    padded = any(key.startswith("0") and key != "0" for key in numbers)
    fits = not padded or (width < 10 and all(key == str(int(key)).zfill(width) for key in numbers))
    plain = not any("{" in name or "}" in name for name in names)
    if len(varying) != 1 or not fits or not plain or len({int(key) for key in numbers}) < len(numbers):
        return Series("", ordered, tuple(PurePath(name).stem for name in ordered))
    parts = [*stems[order[0]]]
    parts[varying[0]] = f"{{n:0{width}d}}" if padded else "{n}"
    return Series("".join(parts) + PurePath(ordered[0]).suffix, ordered, numbers)
