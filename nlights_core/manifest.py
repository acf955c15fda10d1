"""Manifests: the ``artwork.yaml`` beside a capture, read into tiles."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from nlights_core.capture import Encoding, GivenLights, Sensor, Sphere, Tile
from nlights_core.configurations import Source, load_stand
from nlights_core.errors import CaptureError, StandError
from nlights_core.stands import Positive, Record, Stand

Frames = dict[str, str] | list[str] | str
"""Photographs per lamp: a mapping, a list in the lamps' order, or a pattern."""

PlainText = Annotated[str, AfterValidator(lambda text: unicodedata.normalize("NFC", text))]
"""Text whose accents are composed: file systems differ in how they write them."""

LONGEST_NAME = 120
"""Bytes of a name that becomes a folder's."""

PLAIN_NAME = re.compile(r"[^\W_](?:[\w .,()+-]*[\w)])?")
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")


class _Artwork(Record):
    id: PlainText
    title: str = ""


class _Sphere(Record):
    frames: Frames
    circle_px: tuple[float, float, Positive] | None = None
    points_px: list[tuple[float, float]] | None = Field(default=None, min_length=3)
    mask: str | None = None
    outline: str | None = None


class _Lights(Record):
    directions: str
    intensities: str | None = None


class _Tile(Record):
    name: PlainText
    origin_mm: tuple[float, float] = (0.0, 0.0)
    frames: Frames | None = None
    flats: Frames | None = None
    dark: str | None = None
    mask: str | None = None


class Manifest(Record):
    """The fields of an ``artwork.yaml``; paths in it are relative to its folder."""

    artwork: _Artwork
    priority: int = Field(default=0, description="in a night's order: higher goes first")
    stand: str | None = Field(default=None, description="name of a shipped stand, or a file of the capture")
    frames: Frames | None = None
    flats: Frames | None = None
    dark: str | None = None
    mask: str | None = None
    chrome_spheres: list[_Sphere] = Field(default=[])
    lights: _Lights | None = None
    encoding: Encoding = Encoding()
    sensor: Sensor | None = None
    pixel_size_mm: Positive | None = None
    white_reflectance: float = Field(default=0.9, gt=0, le=1)
    tiles: list[_Tile] = Field(default=[_Tile(name="r0c0")], min_length=1)


def load_capture(path: str | Path, *, stand: str | None = None, root: str | Path | None = None) -> list[Tile]:
    """Read an ``artwork.yaml`` into its tiles, without opening a photograph.

    Parameters
    ----------
    path : str or Path
        The manifest, or the folder that holds an ``artwork.yaml``.
    stand : str, optional
        Name or file of a stand, instead of the manifest's.
    root : str or Path, optional
        The capture root that no path may leave; the manifest's folder by default.

    Returns
    -------
    list of Tile
        In the manifest's order, with absolute paths.  A missing photograph is not noticed here:
        it costs its own tile, later.

    Raises
    ------
    CaptureError
        Every fault of the manifest at once, with file, line, field and remedy.
    StandError
        When the stand's file is at fault.
    """
    path = Path(path)
    path = path / "artwork.yaml" if path.is_dir() else path
    source = Source(path, CaptureError)
    manifest = source.check(Manifest)
    folder = path.parent.resolve()
    measured = _stand(manifest, stand, folder, source)
    reader = _Reader(source, manifest, measured, folder, Path(root or folder).resolve())
    tiles = [reader.tile(i, entry) for i, entry in enumerate(manifest.tiles)]
    if reader.faults:
        raise CaptureError("\n".join(dict.fromkeys(reader.faults)))
    return [tile for tile in tiles if tile is not None]


def _stand(manifest: Manifest, given: str | None, folder: Path, source: Source) -> Stand | None:
    if given is not None:
        return load_stand(given)
    if manifest.stand is None:
        return None
    if not manifest.stand.endswith((".yaml", ".yml")):
        try:
            return load_stand(manifest.stand)
        except StandError as fault:
            raise CaptureError(source.fault(("stand",), str(fault))) from None
    if not (folder / manifest.stand).resolve().is_relative_to(folder):
        raise CaptureError(
            source.fault(("stand",), f"{manifest.stand} is outside the capture; give it with --stand")
        )
    return load_stand(manifest.stand, folder)


class _Reader:
    """Resolver of a manifest's paths, collecting every fault."""

    def __init__(
        self, source: Source, manifest: Manifest, stand: Stand | None, folder: Path, root: Path
    ) -> None:
        self.source, self.manifest, self.stand = source, manifest, stand
        self.folder, self.root = folder, root
        self.faults: list[str] = []
        self._names: set[str] = set()
        self._outside: set[tuple[str | int, ...]] = set()
        self._plain(("artwork", "id"), manifest.artwork.id)

    def tile(self, index: int, entry: _Tile) -> Tile | None:
        """Resolve one tile; None when there were faults."""
        at: tuple[str | int, ...] = ("tiles", index)
        self._plain((*at, "name"), entry.name)
        if entry.name.casefold() in self._names:
            self.faults.append(self.source.fault((*at, "name"), f"'{entry.name}' stands twice; rename one"))
        self._names.add(entry.name.casefold())
        whole = self.manifest

        def either(field: str) -> tuple[tuple[str | int, ...], Frames | str | None]:
            own = getattr(entry, field)
            return ((*at, field), own) if own is not None else ((field,), getattr(whole, field))

        frames = self._frames(*either("frames"), entry.name)
        flats_at, flats_given = either("flats")
        flats = None
        if flats_given is not None:
            flats = self._frames(flats_at, flats_given, entry.name)
            self._same_lamps(flats_at, flats, frames)
        dark, mask = (self._optional(*either(field), entry.name) for field in ("dark", "mask"))
        spheres = [
            self._sphere(i, sphere, entry.name, frames) for i, sphere in enumerate(whole.chrome_spheres)
        ]
        lights = self._lights()
        if self.faults:
            return None
        return Tile(
            artwork=whole.artwork.id,
            title=whole.artwork.title,
            name=entry.name,
            origin_mm=entry.origin_mm,
            stand=self.stand,
            pixel_size_mm=whole.pixel_size_mm,
            frames=frames,
            flats={lamp: flats[lamp] for lamp in frames} if flats else None,
            dark=dark,
            mask=mask,
            spheres=tuple(spheres),
            lights=lights,
            encoding=whole.encoding,
            sensor=whole.sensor,
            white_reflectance=whole.white_reflectance,
        )

    def _sphere(self, index: int, sphere: _Sphere, tile: str, frames: dict[str, Path]) -> Sphere:
        at = ("chrome_spheres", index)
        found = self._frames((*at, "frames"), sphere.frames, tile)
        self._same_lamps((*at, "frames"), found, frames)
        return Sphere(
            frames=found,
            circle_px=sphere.circle_px,
            points_px=tuple(sphere.points_px) if sphere.points_px else None,
            mask=self._optional((*at, "mask"), sphere.mask, tile),
            outline=self._optional((*at, "outline"), sphere.outline, tile),
        )

    def _lights(self) -> GivenLights | None:
        given = self.manifest.lights
        if given is None:
            return None
        directions = self._path(("lights", "directions"), given.directions)
        intensities = self._optional(("lights", "intensities"), given.intensities, "")
        return GivenLights(directions=directions, intensities=intensities)

    def _frames(self, at: tuple[str | int, ...], given: Frames | str | None, tile: str) -> dict[str, Path]:
        """Photographs by lamp, from any of the three ways to write them."""
        if given is None:
            self.faults.append(f"{self.source.path}: frames: is missing; add one photograph per lamp")
            return {}
        if isinstance(given, str):
            found = self._pattern(at, given, tile)
        elif isinstance(given, list):
            found = self._list(at, given, tile)
        else:
            found = {
                lamp: self._path((*at, lamp), self._fill(at, text, tile)) for lamp, text in given.items()
            }
        if self.stand is not None:
            for lamp in found:
                if lamp not in self.stand.lamps:
                    self.faults.append(
                        self.source.fault(
                            (*at, lamp) if isinstance(given, dict) else at,
                            f"the stand '{self.stand.name}' has no lamp '{lamp}'; it has "
                            + ", ".join(self.stand.lamps),
                        )
                    )
        if found and len(found) < 3:
            self.faults.append(
                self.source.fault(at, f"photometric stereo needs at least 3 lamps; found {len(found)}")
            )
        return found

    def _list(self, at: tuple[str | int, ...], given: list[str], tile: str) -> dict[str, Path]:
        names = list(self.stand.lamps) if self.stand else [str(i + 1) for i in range(len(given))]
        if len(names) != len(given):
            self.faults.append(
                self.source.fault(
                    at,
                    f"a list needs one photograph for each of the {len(names)} lamps of the stand; got "
                    f"{len(given)}; name the lamps instead ({names[0]}: file)",
                )
            )
            return {}
        paths = [self._path((*at, i), self._fill(at, text, tile)) for i, text in enumerate(given)]
        return dict(zip(names, paths, strict=True))

    def _pattern(self, at: tuple[str | int, ...], pattern: str, tile: str) -> dict[str, Path]:
        """A pattern with {lamp} or {n}: over the stand's lamps, or over the files that exist."""
        if not re.search(r"\{(lamp|n)(:[^{}]*)?\}", pattern):
            self.faults.append(
                self.source.fault(at, f"the pattern '{pattern}' needs {{lamp}} or {{n}} to tell lamps apart")
            )
            return {}
        if self.stand is not None:
            return {
                lamp: self._path(at, self._fill(at, pattern, tile, lamp, n))
                for n, lamp in enumerate(self.stand.lamps, 1)
            }
        return self._existing(at, self._fill(at, pattern, tile, keep=("lamp", "n")))

    def _existing(self, at: tuple[str | int, ...], pattern: str) -> dict[str, Path]:
        """Files that fit a pattern, in the order of their numbers (or names)."""
        self._path(at, _PLACEHOLDER.sub("x", pattern))
        parts = _PLACEHOLDER.split(pattern)
        wild = "".join(p if i % 2 == 0 else "*" for i, p in enumerate(parts))
        regular = "".join(
            re.escape(p) if i % 2 == 0 else (r"(\d+)" if p.startswith("n") else "(.+)")
            for i, p in enumerate(parts)
        )
        found = {}
        for path in self.folder.glob(wild):
            match = re.fullmatch(regular, path.relative_to(self.folder).as_posix())
            if match:
                found[match.group(1)] = self._path(at, path.relative_to(self.folder).as_posix())
        numbered = all(key.isdigit() for key in found)
        if not found:
            self.faults.append(self.source.fault(at, f"no file fits the pattern '{pattern}'; correct it"))
        return dict(sorted(found.items(), key=lambda item: int(item[0]) if numbered else item[0]))

    def _fill(
        self,
        at: tuple[str | int, ...],
        text: str,
        tile: str,
        lamp: str = "",
        n: int = 0,
        keep: tuple[str, ...] = (),
    ) -> str:
        """Put the tile's name, the lamp's name and its number into a path."""

        def value(match: re.Match[str]) -> str:
            name, _, width = match.group(1).partition(":")
            if name in keep:
                return match.group(0)
            if name == "tile":
                return tile
            if name == "lamp" and lamp:
                return lamp
            if name == "n" and n and re.fullmatch(r"(0?[1-9]d?)?", width):
                return str(n).zfill(int(width.rstrip("d") or 0))
            self.faults.append(
                self.source.fault(at, f"{match.group(0)} is not known here; known: {{tile}}, {{lamp}}, {{n}}")
            )
            return ""

        return _PLACEHOLDER.sub(value, text)

    def _optional(self, at: tuple[str | int, ...], text: Frames | str | None, tile: str) -> Path | None:
        return self._path(at, self._fill(at, text, tile)) if isinstance(text, str) else None

    def _path(self, at: tuple[str | int, ...], text: str) -> Path:
        try:
            path = (self.folder / text).resolve()
        except (OSError, ValueError, RuntimeError):  # a NUL, a loop of links
            path = Path("/")
        if not path.is_relative_to(self.root) and at not in self._outside:
            self._outside.add(at)
            self.faults.append(
                self.source.fault(
                    at,
                    f"'{text}' is outside the capture root {self.root}; move it in or widen it by --root",
                )
            )
        return path

    def _same_lamps(self, at: tuple[str | int, ...], other: dict[str, Path], frames: dict[str, Path]) -> None:
        missing = [lamp for lamp in frames if lamp not in other]
        if other and missing:
            self.faults.append(
                self.source.fault(at, f"lacks {', '.join(missing)}, which the frames have; add them")
            )

    def _plain(self, at: tuple[str | int, ...], name: str) -> None:
        if len(name.encode()) > LONGEST_NAME:
            self.faults.append(
                self.source.fault(
                    at, f"is {len(name.encode())} bytes long and names a folder; {LONGEST_NAME} are allowed"
                )
            )
        if not PLAIN_NAME.fullmatch(name):
            self.faults.append(
                self.source.fault(
                    at,
                    f"'{name}' is not a plain name: it names a folder, so it starts with a letter or digit "
                    "and has letters, digits, spaces and . , _ - + ( ) only",
                )
            )
