"""Names of photographs: which file is meant, however people and disks write its name."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePath

from nlights_core.names.control_characters import escape_controls

PLACEHOLDER = re.compile(r"\{(lamp|n)(?::0?([1-9]?)d?)?\}")
"""Place in a pattern that differs from lamp to lamp; a number may say how many digits it has."""

NEVER_PHOTOGRAPHS = frozenset(
    (
        *("__macosx", "@eadir", "$recycle.bin", "#recycle", "#snapshot", "system volume information"),
        *("thumbs.db", "ehthumbs.db", "desktop.ini", "icon\r"),
    )
)
"""Names, in lower case, of what systems and file servers put beside photographs."""

SPELLINGS = ((".tif", ".tiff"), (".jpg", ".jpe", ".jpeg"))
"""Extensions that mean the same."""

MOST_MISSING = 100
"""Numbers that are named in one gap."""


def composed(text: str) -> str:
    r"""Text whose accents are one letter with their base: file systems differ in how they write them.

    Examples
    --------
    >>> len("e\u0301"), len(composed("e\u0301"))
    (2, 1)
    """
    return unicodedata.normalize("NFC", text)


def is_hidden(name: str) -> bool:
    """Test whether a file or folder is hidden, or one that a system has put there: never a photograph.

    Examples
    --------
    >>> is_hidden("._light_1.tif"), is_hidden("__MACOSX"), is_hidden("light_1.tif"), is_hidden("..")
    (True, True, False, False)
    """
    return (name.startswith(".") and name not in (".", "..")) or name.casefold() in NEVER_PHOTOGRAPHS


def by_numbers(name: str) -> tuple[tuple[bool, int, str], ...]:
    """Key by which ``light_2`` comes before ``light_10``.

    Examples
    --------
    >>> sorted(["light_10", "light_2"], key=by_numbers)
    ['light_2', 'light_10']
    """
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((not part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts)


def number_of(lamp: str) -> str | int:
    """A lamp's number where its name is one, so that ``01`` is ``1``; else its name."""
    return int(lamp) if re.fullmatch(r"[0-9]+", lamp) else lamp


def gaps(lamps: Iterable[str]) -> list[str]:
    """Names that a series of lamps lacks, by the numbers in them; none where all distances are equal.

    Examples
    --------
    >>> gaps(["light_1", "light_2", "light_5"]), gaps(["2", "4", "6"]), gaps(["a", "b"])
    (['light_3', 'light_4'], [], [])
    """
    parts = [re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", lamp) for lamp in lamps]
    matches = [match for match in parts if match]
    if len(matches) < 3 or len(matches) < len(parts) or len({(m[1], m[3]) for m in matches}) > 1:
        return []
    widths = {len(match[2]) for match in matches}
    width = widths.pop() if len(widths) == 1 else 0
    numbers = sorted(int(match[2]) for match in matches)
    steps = list(pairwise(numbers))
    if len({after - before for before, after in steps}) == 1:
        return []
    missing = [n for before, after in steps for n in range(before + 1, min(after, before + MOST_MISSING))]
    return [f"{matches[0][1]}{n:0{width}d}{matches[0][3]}" for n in missing]


@dataclass(frozen=True)
class Found:
    """A file that a name means.

    Attributes
    ----------
    path : Path
        As the disk writes it; as it was asked for where there is none.
    near : bool
        Its name is another: capitals or the spelling of its extension differ.
    lamp : str
        What stands for ``{lamp}`` or ``{n}``, where a pattern was looked for.
    """

    path: Path
    near: bool = False
    lamp: str = ""


class Folders:
    """Folders and the names in them; each is read once.

    A name means the file of that name; composed and decomposed accents are the same.  Where there is
    none, it means the only one that differs by capitals or by ``.tif`` for ``.tiff``, ``.jpg`` for ``.jpeg``.
    """

    def __init__(self) -> None:
        self._read: dict[Path, dict[str, list[str]]] = {}

    def find(self, folder: Path, text: str) -> Found:
        """Find what a path means; brackets, stars and the like are letters of a name.

        Parameters
        ----------
        folder : Path
            Where a relative path begins.
        text : str
            The path, with ``/`` between folders.
        """
        found = Found(folder)
        for part in Path(text).parts:
            found = self._child(found, part)
        return found

    def fitting(self, folder: Path, pattern: str) -> list[Found]:
        """Find all files that fit a pattern with ``{lamp}`` or ``{n}``; never hidden ones.

        Returns
        -------
        list of Found
            In the order of their numbers, several for one lamp where several fit.  One of a near name is left out
            where the lamp has one of the very name.
        """
        fits: list[tuple[Found, dict[str, str]]] = [(Found(folder), {})]
        for part in Path(pattern).parts:
            fits = list(self._deeper(fits, part))
        found = [
            Found(one.path, one.near, escape_controls(composed(values.get("lamp", values.get("n", "")))))
            for one, values in fits
            if not one.path.is_dir()
        ]
        exact = {number_of(one.lamp) for one in found if not one.near}
        found = [one for one in found if not one.near or number_of(one.lamp) not in exact]
        return sorted(found, key=lambda one: (by_numbers(one.lamp), one.path))

    def like(self, path: Path) -> list[str]:
        """Names beside a path that may be meant: of other capitals, another extension, other leading zeros."""
        wanted = _bare(path.name)
        names = (name for kin in self._names(path.parent).values() for name in kin)
        return sorted(name for name in names if _bare(name) == wanted and name != path.name)

    def _deeper(
        self, fits: list[tuple[Found, dict[str, str]]], part: str
    ) -> Iterator[tuple[Found, dict[str, str]]]:
        """Files and folders of the next level that fit, with what stands for the placeholders."""
        if not PLACEHOLDER.search(part):
            children = ((self._child(one, part), values) for one, values in fits)
            yield from (fit for fit in children if fit[0].path.exists() or fit[0].path.is_symlink())
            return
        expression = _expression(composed(part))
        for one, values in fits:
            for name in (name for kin in self._names(one.path).values() for name in kin):
                match = expression.fullmatch(composed(name))
                own = match.groupdict() if match else {}
                if match and all(values.get(key, value) == value for key, value in own.items()):
                    filled = PLACEHOLDER.sub(partial(_value, own), composed(part))
                    yield Found(one.path / name, one.near or filled != composed(name)), {**values, **own}

    def _child(self, parent: Found, part: str) -> Found:
        """Child of a folder that a name means."""
        kin = self._names(parent.path).get(_kin(part), [])
        same = [name for name in kin if composed(name) == composed(part)]
        if part in same or len(same or kin) != 1:
            return Found(parent.path / part, parent.near)
        return Found(parent.path / (same or kin)[0], parent.near or not same)

    def _names(self, folder: Path) -> dict[str, list[str]]:
        """Names in a folder by what those have in common that may be meant for each other; none if unreadable."""
        if folder not in self._read:
            found = self._read[folder] = {}
            try:
                names = sorted(path.name for path in folder.iterdir())
            except (OSError, ValueError):
                names = []
            for name in names:
                if not is_hidden(name):
                    found.setdefault(_kin(name), []).append(name)
        return self._read[folder]


def did_you_mean(path: Path) -> str:
    """Words to be put behind a missing file: the names beside it that may be meant, or nothing.

    Examples
    --------
    >>> did_you_mean(Path("/nowhere/light_1.tif"))
    ''
    """
    like = Folders().like(path)[:3]
    return f"; did you mean {' or '.join(like)}?" if like else ""


def _value(values: Mapping[str, str], hole: re.Match[str]) -> str:
    return values[hole[1]]


def _kin(name: str) -> str:
    """Key that names have in common which may be meant for each other."""
    path = PurePath(composed(name).casefold())
    return path.stem + next((same[0] for same in SPELLINGS if path.suffix in same), path.suffix)


def _bare(name: str) -> str:
    """Name without extension, capitals, and leading zeros of its numbers."""
    stem = PurePath(composed(name).casefold()).stem
    return re.sub(r"[0-9]+", lambda digits: str(int(digits[0])), stem)


def _expression(part: str) -> re.Pattern[str]:
    """Expression of the names that fit a part of a pattern, near ones too; a placeholder is one value throughout."""
    suffix = PurePath(part).suffix
    same = next((same for same in SPELLINGS if suffix.casefold() in same), None)
    rest = part.removesuffix(suffix) if same else part
    written, at, known = "", 0, set[str]()
    for hole in PLACEHOLDER.finditer(rest):
        name, width = hole[1], int(hole[2] or 1)
        digits = "[0-9]+" if width == 1 else f"[0-9]{{{width}}}|[1-9][0-9]{{{width},}}"
        written += re.escape(rest[at : hole.start()])
        written += f"(?P={name})" if name in known else f"(?P<{name}>{digits if name == 'n' else '.+'})"
        known.add(name)
        at = hole.end()
    written += re.escape(rest[at:])
    if same:
        written += f"(?:{'|'.join(map(re.escape, same))})"
    return re.compile(written, re.IGNORECASE | re.DOTALL)
