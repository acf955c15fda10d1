"""Lists of photographs that other programs wrote: which line of a list means which photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PureWindowsPath

from nlights_core.names.photographs import composed

FOLDERS = 2
"""Folders above a photograph that may tell it from another of the same name."""


@dataclass(frozen=True)
class Matched:
    """Lines of a list that mean some photographs.

    Attributes
    ----------
    lines : tuple of int or None
        By photograph, the line that means it, counted from 0; None where there is none.
    doubtful : tuple of str
        Sentences about photographs that several lines mean, or lines that mean several photographs.
    """

    lines: tuple[int | None, ...]
    doubtful: tuple[str, ...]


def match_listed(names: Sequence[str], paths: Sequence[Path]) -> Matched:
    """Match the names of a list with photographs, by the name without its extension.

    A list was often made of exports (``light_1.jpg`` for ``light_1.tif``) on another computer: folders, capitals,
    extensions and the way accents are written may differ.  Where several lines have the name, the one whose folders
    agree furthest is meant, then the one with the very extension.

    Parameters
    ----------
    names : sequence of str
        As in the list, with folders as Windows or others write them.
    paths : sequence of Path
        The photographs.

    Examples
    --------
    >>> match_listed(["exports/b.jpg", "exports/a.jpg"], [Path("a.tif"), Path("b.tif")]).lines
    (1, 0)
    """
    listed = [_parts(PureWindowsPath(name)) for name in names]
    by_stem: dict[str, list[int]] = {}
    for line, parts in enumerate(listed):
        for stem in {parts[0], _stem(parts[0])}:
            by_stem.setdefault(stem, []).append(line)
    lines: list[int | None] = []
    doubtful = []
    for path in paths:
        wanted = _parts(path)
        candidates = [line for name in {wanted[0], _stem(wanted[0])} for line in by_stem.get(name, ())]
        ranks = {line: _likeness(listed[line], wanted) for line in candidates}
        best = [line for line in dict.fromkeys(candidates) if ranks[line] == max(ranks.values())]
        if len(best) > 1:
            both = " and ".join(sorted(names[line] for line in best[:2]))
            doubtful.append(f"{both} may both mean {path.name}")
        lines.append(best[0] if best else None)
    owners: dict[int, Path] = {}
    for path, own in zip(paths, lines, strict=True):
        if own is not None and own in owners:
            doubtful.append(f"{names[own]} may mean {_short(owners[own])} and {_short(path)}")
        elif own is not None:
            owners[own] = path
    return Matched(tuple(lines), tuple(doubtful))


def _parts(path: PurePath) -> tuple[str, ...]:
    """Name and folders of a path, from the name upwards, in one way of writing."""
    return tuple(composed(part).casefold() for part in reversed(path.parts))[: FOLDERS + 1] or ("",)


def _stem(name: str) -> str:
    return PurePath(name).stem


def _likeness(listed: tuple[str, ...], wanted: tuple[str, ...]) -> tuple[int, int]:
    """Likeness of a line and a photograph: folders that agree, then how much of the name does."""
    folders = 0
    for one, other in zip(listed[1:], wanted[1:], strict=False):
        if one != other:
            break
        folders += 1
    name = listed[0]
    return folders, 2 if name == wanted[0] else 1 if name == _stem(wanted[0]) else 0


def _short(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"
