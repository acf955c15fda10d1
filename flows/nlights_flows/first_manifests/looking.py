"""Looking at a folder: which photographs are of the artwork, and which of a flat, a sphere or the dark."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from nlights_core.errors import CaptureError
from nlights_core.manifest import PLAIN_NAME
from nlights_core.names.photographs import SPELLINGS, is_hidden
from nlights_core.names.series import FEWEST, Series, find_series
from nlights_core.photographs.decoders import EXTENSIONS, RAW_EXTENSIONS

DEEPEST = 3
"""Levels of folders that are looked at."""

OF_SPHERES = ("sphere", "chrome", "probe", "mirror")
OF_FLATS = ("flat", "flats", "flatfield", "white", "whites")
OF_DARKS = ("dark", "darks", "darkframe", "black", "bias")
OF_OUTLINES = ("ref", "reference", "outline", "ambient")
"""Words in names of files and folders by which photographs are told apart."""

LISTS = (".lp", ".dome")
"""Extensions of lists of lights; text files are lists by their names."""


@dataclass(frozen=True)
class Group:
    """A series of photographs and its folder, relative to the capture ("" for the capture's own)."""

    folder: str
    series: Series

    def path(self, name: str) -> str:
        """Path of one of its names or of its pattern."""
        return f"{self.folder}/{name}" if self.folder else name

    @property
    def paths(self) -> list[str]:
        """Paths of its photographs."""
        return [self.path(name) for name in self.series.names]

    @property
    def called(self) -> str:
        """Name of it for people."""
        return self.path(self.series.pattern or f"{self.series.names[0]} ... {self.series.names[-1]}")


@dataclass(frozen=True)
class SphereSeen:
    """Photographs of a chrome sphere, with a photograph or a mask of its outline where there is one."""

    group: Group
    outline: str | None
    mask: str | None


@dataclass
class Look:
    """Everything that the names in a folder say.

    Attributes
    ----------
    folder : Path
    frames : Group
        Of the artwork; of the first tile where there are several.
    tiles : list of str
        Names of the folders of tiles; empty where there is but one.
    flats : Group or None
    dark, mask : str or None
    spheres : list of SphereSeen
    lists : list of str
        Files that may state lights, the likeliest first.
    intensities : list of str
    stands : list of str
        YAML files that may be a stand.
    unused : list of str
        Sentences about photographs that were left out.
    """

    folder: Path
    frames: Group
    tiles: list[str] = field(default_factory=list)
    flats: Group | None = None
    dark: str | None = None
    mask: str | None = None
    spheres: list[SphereSeen] = field(default_factory=list)
    lists: list[str] = field(default_factory=list)
    intensities: list[str] = field(default_factory=list)
    stands: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)


def look_at(folder: Path) -> Look:
    """Look at the names in a folder.

    Raises
    ------
    CaptureError
        When there is no set of photographs in it, or several and nobody can know which is meant.
    """
    photographs, texts = _files(folder)
    if not photographs:
        raise CaptureError(f"{folder}: holds no photographs; give the folder that does")
    groups: list[Group] = []
    singles: list[str] = []
    for place, names in photographs.items():
        series, others = find_series(names)
        groups += [Group(place, one) for one in series]
        singles += [f"{place}/{name}" if place else name for name in others]
    spheres = [group for group in groups if _is(group.called, OF_SPHERES, parts=True)]
    flats = [group for group in groups if _is(group.called, OF_FLATS) and group not in spheres]
    darks = [group for group in groups if _is(group.called, OF_DARKS) and group not in (*spheres, *flats)]
    rest = [group for group in groups if group not in (*spheres, *flats, *darks)]
    rest, unused = _without_exports(rest or _named(singles))
    if not rest and spheres:
        raise CaptureError(
            f"{folder}: holds photographs of a chrome sphere ({spheres[0].called}), but none of an artwork; "
            "run init on the folder that holds both"
        )
    look = Look(folder, *_tiles(folder, rest, texts), unused=unused)
    _add_others(look, spheres, flats, darks, singles)
    lists = [path for path in texts if _is_list(path)]
    look.intensities = [path for path in texts if "intensit" in PurePosixPath(path).stem.lower()]
    look.lists = sorted(
        lists, key=lambda path: (_is(path, OF_SPHERES, parts=True), not path.lower().endswith(LISTS))
    )
    look.stands = [path for path in texts if path.lower().endswith((".yaml", ".yml"))]
    return look


def _files(folder: Path) -> tuple[dict[str, list[str]], list[str]]:
    """Photographs by folder, and text files, of a folder and those below; hidden ones and products left out."""
    photographs: dict[str, list[str]] = {}
    texts = []
    for place, folders, files in os.walk(folder):
        relative = Path(place).relative_to(folder).as_posix()
        depth = 0 if relative == "." else relative.count("/") + 1
        made = "provenance.json" in files
        folders[:] = sorted(name for name in folders if not is_hidden(name) and depth < DEEPEST and not made)
        prefix = "" if relative == "." else relative
        for name in sorted(files):
            path = PurePosixPath(prefix, name)
            if is_hidden(name) or made:
                continue
            if path.suffix.lower() in EXTENSIONS:
                photographs.setdefault(prefix, []).append(name)
            elif path.suffix.lower() in (".txt", ".csv", ".yaml", ".yml", *LISTS):
                texts.append(path.as_posix())
    return photographs, sorted(texts, key=lambda path: (path.count("/"), path))


def _is(path: str, words: Sequence[str], parts: bool = False) -> bool:
    """Test whether a name holds one of some words, or has it as a part of one."""
    own = [word for word in re.split(r"[^a-z]+", path.lower()) if word]
    return any(word in one if parts else word == one for one in own for word in words)


def _is_list(path: str) -> bool:
    pure = PurePosixPath(path)
    if pure.suffix.lower() in LISTS:
        return True
    stem = pure.stem.lower()
    return (
        pure.suffix.lower() in (".txt", ".csv")
        and "intensit" not in stem
        and ("light" in stem or "direction" in stem)
    )


def _named(singles: Sequence[str]) -> list[Group]:
    """Photographs without numbers, such as ``left.tif``, where a folder has enough of one kind."""
    words = (*OF_FLATS, *OF_DARKS, *OF_OUTLINES, "mask", "normal", "map")
    by_folder: dict[tuple[str, str], list[str]] = {}
    for path in singles:
        pure = PurePosixPath(path)
        if not _is(pure.name, words) and not _is(path, OF_SPHERES, parts=True):
            place = "" if str(pure.parent) == "." else str(pure.parent)
            by_folder.setdefault((place, pure.suffix.lower()), []).append(pure.name)
    return [
        Group(place, Series("", tuple(names), tuple(PurePosixPath(name).stem for name in names)))
        for (place, _), names in by_folder.items()
        if len(names) >= FEWEST
    ]


def _rank(group: Group) -> int:
    """Rank of a kind of file by what it has lost of what the camera saw: raw, TIFF, PNG and others, JPEG."""
    suffix = PurePosixPath(group.series.names[0]).suffix.lower()
    return (
        0 if suffix in RAW_EXTENSIONS else 1 if suffix in SPELLINGS[0] else 3 if suffix in SPELLINGS[1] else 2
    )


def _without_exports(groups: list[Group]) -> tuple[list[Group], list[str]]:
    """Leave out what was exported from other photographs of the same names; and say so."""
    by_stems: dict[tuple[str, ...], list[Group]] = {}
    for group in groups:
        stems = tuple(PurePosixPath(name).stem.lower() for name in group.series.names)
        by_stems.setdefault(stems, []).append(group)
    kept, told = [], []
    for same in by_stems.values():
        best = min(map(_rank, same))
        kept += [group for group in same if _rank(group) == best]
        told += [
            f"{group.called}: taken for exports of the same photographs, and left out"
            for group in same
            if _rank(group) > best
        ]
    return kept, told


def _tiles(folder: Path, groups: list[Group], texts: Sequence[str]) -> tuple[Group, list[str]]:
    """Frames, and the names of the tiles' folders where there are several that look alike."""
    if not groups:
        raise CaptureError(
            f"{folder}: holds no photographs of an artwork: three or more of one kind, a lamp each, are asked for, "
            "whose names differ by a number and do not say that they are of a flat, a sphere or the dark"
        )
    if len(groups) == 1:
        return groups[0], []
    tops = {group.folder.split("/")[0] for group in groups}
    owners = {path.split("/")[0] for path in texts if "/" in path and _is_list(path)}
    alike = {
        (str(PurePosixPath(group.folder).parent), _of_tile(group), group.series.keys) for group in groups
    }
    names = [PurePosixPath(group.folder).name for group in groups]
    plain = all(PLAIN_NAME.fullmatch(name) for name in names) and len(set(map(str.casefold, names))) == len(
        names
    )
    if len(alike) == 1 and plain and groups[0].series.pattern and not (tops & owners and len(tops) > 1):
        return groups[0], names
    found = ", ".join(f"{group.called} ({len(group.series.names)})" for group in groups[:5])
    more = f" and {len(groups) - 5} more" if len(groups) > 5 else ""
    raise CaptureError(
        f"{folder}: holds several sets of photographs, and which is the artwork's cannot be told: {found}{more}; "
        "run init on the folder of each artwork (or on all with --from), and move out what does not belong"
    )


def _of_tile(group: Group) -> str:
    """Pattern with the folder's name as ``{tile}``."""
    return group.series.pattern.replace(PurePosixPath(group.folder).name, "{tile}")


def _add_others(
    look: Look, spheres: list[Group], flats: list[Group], darks: list[Group], singles: list[str]
) -> None:
    """Take in what lies beside the frames."""
    count = len(look.frames.series.names)
    left = list(singles)

    def take(words: Sequence[str], place: str | None = None) -> str | None:
        for path in left:
            own = str(PurePosixPath(path).parent) if "/" in path else ""
            if _is(PurePosixPath(path).name, words) and (own == place if place is not None else True):
                left.remove(path)
                return path
        return None

    for group in spheres:
        if len(group.series.names) == count:
            seen = SphereSeen(group, take(OF_OUTLINES, group.folder), take(("mask",), group.folder))
            look.spheres.append(seen)
        else:
            look.unused.append(
                f"{group.called}: {len(group.series.names)} photographs of a sphere for {count} lamps"
            )
    for group in flats:
        if len(group.series.names) == count and look.flats is None:
            look.flats = group
        else:
            look.unused.append(f"{group.called}: {len(group.series.names)} flats for {count} lamps")
    tiles = [*look.tiles] or [""]
    look.dark = take(OF_DARKS)
    for group in darks:
        look.dark = look.dark or group.paths[0]
        look.unused.append(f"{group.called}: several dark frames; one is used, {look.dark}")
    masks = [take(("mask",), look.frames.folder) or take(("mask",), "")]
    if look.tiles and masks[0]:
        own = PurePosixPath(look.frames.folder).name
        masks += [path for path in left if path in {masks[0].replace(own, tile) for tile in tiles[1:]}]
        left[:] = [path for path in left if path not in masks]
    if (
        masks[0]
        and len(masks) in (1, len(tiles))
        and (len(tiles) == 1 or "/" not in masks[0] or len(masks) > 1)
    ):
        look.mask = masks[0]
    look.unused += [f"{path}: not used" for path in left if path not in look.frames.paths]
