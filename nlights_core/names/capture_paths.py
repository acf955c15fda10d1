"""Paths of a capture: photographs by lamp, from every way to write them."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from nlights_core.errors import CaptureError
from nlights_core.names.control_characters import escape_controls
from nlights_core.names.odd_names import is_text, refusal
from nlights_core.names.photographs import Folders, Found, composed, gaps, is_hidden, number_of

Frames = dict[str, str] | list[str] | str
"""Photographs per lamp: a mapping, a list in the lamps' order, or a pattern."""

Location = tuple[str | int, ...]
"""Where in the manifest a field stands."""

MOST_FILES = 20_000
"""That the tiles of an artwork have in all: a thousand tiles with eight frames and eight flats have fewer."""

_HOLE = re.compile(r"\{([^{}]*)\}")


@dataclass(frozen=True)
class Note:
    """Remark about names that are allowed, but seldom meant.

    Attributes
    ----------
    code : {"near-name", "numbering"}
    sentence : str
    lamps : tuple of str
    """

    code: str
    sentence: str
    lamps: tuple[str, ...]


class CapturePaths:
    """Resolver of the paths of a capture; it collects every fault and every note.

    Parameters
    ----------
    folder, root : Path
        Where relative paths begin, and what no path may leave; both resolved.
    stand : str
        Name of the stand; empty where there is none.
    lamps : sequence of str
        Those of the stand.
    fault : callable
        Puts file, line and field before a sentence.
    """

    def __init__(
        self,
        folder: Path,
        root: Path,
        stand: str,
        lamps: Sequence[str],
        fault: Callable[[Location, str], str],
    ) -> None:
        self.folder, self.root, self.stand, self.lamps = folder, root, stand, list(lamps)
        self._spelt = {composed(lamp): lamp for lamp in reversed(lamps)}
        self._fault = fault
        self._folders = Folders()
        self._refused: set[Location] = set()
        self._asked = 0
        self._found: dict[tuple[str, bool], Found] = {}
        self._real_folders: dict[Path, Path] = {}
        self.faults: list[str] = []
        self.notes: list[Note] = []

    def frames(self, at: Location, given: Frames, tile: str, but: Collection[Path] = ()) -> dict[str, Path]:
        """Find the photographs by lamp.

        Parameters
        ----------
        at : Location
            Of the field.
        given : Frames
            What it says.
        tile : str
            Name of the tile.
        but : collection of Path
            Files that are something else, so that a pattern does not mean them.
        """
        if isinstance(given, str):
            found = self._pattern(at, given, tile, but)
        elif isinstance(given, list):
            found = self._list(at, given, tile)
        else:
            found = {
                self._lamp(lamp): self._find((*at, lamp), self.fill(at, text, tile))
                for lamp, text in given.items()
            }
        for lamp in found if self.stand else ():
            if composed(lamp) not in self._spelt:
                self.tell(
                    (*at, lamp) if isinstance(given, dict) else at,
                    f"the stand '{self.stand}' has no lamp '{lamp}'; it has {_few(self.lamps, 24)}",
                )
        if found and len(found) < 3:
            self.tell(at, f"photometric stereo needs at least 3 lamps; found {len(found)}")
        self._see_that_each_has_its_own(at, found)
        self._note_near(at, found)
        return {lamp: one.path for lamp, one in found.items()}

    def photograph(self, at: Location, text: str, tile: str) -> Path:
        """Find a single photograph, such as a dark frame or a mask."""
        found = self._find(at, self.fill(at, text, tile))
        self._note_near(at, {"": found})
        return found.path

    def file(self, at: Location, text: str) -> Path:
        """Find a file that is no photograph."""
        found = self._find(at, text, photograph=False)
        self._note_near(at, {"": found})
        return found.path

    def tell(self, at: Location, sentence: str) -> None:
        """Add a fault."""
        self.faults.append(self._fault(at, sentence))

    def fill(
        self, at: Location, text: str, tile: str, lamp: str = "", n: int = 0, keep: Collection[str] = ()
    ) -> str:
        """Put the tile's name, the lamp's name and its number into a path."""

        def value(match: re.Match[str]) -> str:
            name, _, width = match.group(1).partition(":")
            sized = bool(re.fullmatch(r"(0?[1-9]d?)?", width))
            if name in keep and (not width or (name == "n" and sized)):
                return match.group(0)
            if name == "tile" and not width:
                return tile
            if name == "lamp" and lamp and not width:
                return lamp
            if name == "n" and n and sized:
                return str(n).zfill(int(width.rstrip("d") or 0))
            self.tell(at, f"{match.group(0)} is not known here; known: {{tile}}, {{lamp}}, {{n}}")
            return ""

        return _HOLE.sub(value, text)

    def _lamp(self, name: str) -> str:
        """Name of a lamp as the stand writes it."""
        return self._spelt.get(composed(name), composed(name))

    def _list(self, at: Location, given: list[str], tile: str) -> dict[str, Found]:
        names = self.lamps if self.stand else [str(i + 1) for i in range(len(given))]
        if len(names) != len(given):
            self.tell(
                at,
                f"a list needs one photograph for each of the {len(names)} lamps of the stand; got "
                f"{len(given)}; name the lamps instead ({names[0]}: file)",
            )
            return {}
        found = [self._find((*at, i), self.fill(at, text, tile)) for i, text in enumerate(given)]
        return dict(zip(names, found, strict=True))

    def _pattern(self, at: Location, pattern: str, tile: str, but: Collection[Path]) -> dict[str, Found]:
        """A pattern with {lamp} or {n}: over the stand's lamps, or over the files that exist."""
        if not re.search(r"\{(lamp|n)(:[^{}]*)?\}", pattern):
            self.tell(at, f"the pattern '{pattern}' needs {{lamp}} or {{n}} to tell lamps apart")
            return {}
        if self.stand:
            return {
                lamp: self._find(at, self.fill(at, pattern, tile, lamp, n))
                for n, lamp in enumerate(self.lamps, 1)
            }
        known = len(self.faults)
        filled = self.fill(at, pattern, tile, keep=("lamp", "n"))
        return {} if len(self.faults) > known else self._existing(at, filled, but)

    def _existing(self, at: Location, pattern: str, but: Collection[Path]) -> dict[str, Found]:
        """Files that fit a pattern, in the order of their numbers (or names)."""
        self._find(at, _HOLE.sub("x", pattern))
        if at in self._refused:
            return {}
        fits = self._folders.fitting(self.folder, pattern)
        fits = [one for one in fits if self._resolved(at, one.path) not in but]
        by_lamp: dict[str | int, list[Found]] = {}
        for one in fits:
            by_lamp.setdefault(number_of(one.lamp), []).append(one)
        for name in (one.path.name for one in fits if not is_text(one.path.name)):
            self.tell(at, f"the name {escape_controls(name)} is not UTF-8; rename the photograph")
        for several in by_lamp.values():
            if len(several) > 1:
                names = " and ".join(one.path.name for one in several[:2])
                self.tell(at, f"{names} both fit '{pattern}' as lamp {several[0].lamp}; rename or remove one")
        if not fits:
            near = self._folders.like(self.folder / _HOLE.sub("1", pattern))
            hint = f"; did you mean {near[0]}?" if near else "; correct it"
            self.tell(at, f"no file fits the pattern '{pattern}'{hint}")
        found = {
            several[0].lamp: Found(self._resolved(at, several[0].path), several[0].near)
            for several in by_lamp.values()
        }
        if at[0] != "chrome_spheres" and at[-1] == "frames" and (missing := gaps(found)):
            self.notes.append(
                Note(
                    "numbering",
                    f"the {len(found)} photographs that fit '{pattern}' are not numbered throughout: there is "
                    f"none of {_few(missing)}; see whether a lamp is missing",
                    (),
                )
            )
        return found

    def _find(self, at: Location, text: str, photograph: bool = True) -> Found:
        """Find a file; whatever name it was given, it is inside the root.

        Raises
        ------
        CaptureError
            When the manifest names more files than any artwork has.
        """
        self._asked += 1
        if self._asked > MOST_FILES:
            sentence = (
                f"the tiles have more than {MOST_FILES} files in all; divide them into several artworks"
            )
            raise CaptureError(self._fault(at, sentence))
        if (text, photograph) in self._found:
            return self._found[text, photograph]
        path = self._resolved(at, self.folder / text, text)
        if at in self._refused:
            return Found(path)
        hidden = [part for part in Path(text).parts if is_hidden(part)]
        if photograph and hidden:
            self.tell(
                at,
                f"'{text}' is hidden or a system's own ({hidden[0]}), never a photograph; name the photograph",
            )
            return Found(path)
        found = self._folders.find(self.folder, text)
        found = Found(self._resolved(at, found.path, text), found.near)
        if at not in self._refused:  # what many tiles share is looked for once
            self._found[text, photograph] = found
        return found

    def _resolved(self, at: Location, path: Path, text: str | None = None) -> Path:
        if why := refusal(path):
            if at not in self._refused:
                self._refused.add(at)
                self.tell(at, f"'{_short(text or path.name)}' {why}")
            return path
        path = self._real(path)
        if not path.is_relative_to(self.root) and at not in self._refused:
            self._refused.add(at)
            self.tell(
                at,
                f"'{text or path.name}' is outside the capture root {self.root}; move it in or widen it by --root",
            )
        return path

    def _real(self, path: Path) -> Path:
        """A path without links; each folder is asked once."""
        if path.name in ("", "..") or path.is_symlink():
            return path.resolve()
        if path.parent not in self._real_folders:
            self._real_folders[path.parent] = path.parent.resolve()
        return self._real_folders[path.parent] / path.name

    def _see_that_each_has_its_own(self, at: Location, found: dict[str, Found]) -> None:
        """Tell of a photograph that stands under two lamps."""
        owners: dict[Path, str] = {}
        for lamp, one in found.items():
            if one.path in owners and at not in self._refused:
                self.tell(
                    at,
                    f"{one.path.name} stands under {owners[one.path]} and {lamp}; name the one that was taken under "
                    "each",
                )
            owners.setdefault(one.path, lamp)

    def _note_near(self, at: Location, found: dict[str, Found]) -> None:
        near = {lamp: one.path.name for lamp, one in found.items() if one.near}
        if near:
            self.notes.append(
                Note(
                    "near-name",
                    f"{at[-1]}: {_few(list(near.values()))}: differs from the name in the manifest by capitals or by "
                    "the spelling of the extension, and is taken for it; write it as it is",
                    tuple(lamp for lamp in near if lamp),
                )
            )


def _few(names: Sequence[str], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:117]}..."
