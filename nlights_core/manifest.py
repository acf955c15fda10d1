"""Manifests: the ``artwork.yaml`` beside a capture, read into tiles."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Discriminator, Field, Tag

from nlights_core.capture import Encoding, GivenLights, HeightFile, Sensor, Sphere, Tile, TurnedFlats
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.configurations import MOST_FAULTS, Source, list_faults, load_stand
from nlights_core.errors import CaptureError, StandError
from nlights_core.names.artworks import LONGEST_NAME, fault_of, is_reserved
from nlights_core.names.capture_paths import CapturePaths, Frames, Location
from nlights_core.names.control_characters import escape_controls
from nlights_core.names.odd_names import is_text, refusal
from nlights_core.names.photographs import Folders, composed
from nlights_core.stands import Positive, Record, Stand

PlainText = Annotated[str, AfterValidator(composed)]
"""Text whose accents are composed: file systems differ in how they write them."""

TEXTS = (("artwork", "id"), ("artwork", "title"), ("tiles", None, "name"))
"""Fields that are the text that was written: ``0012`` is no number."""

AUTO = "auto"
"""Instead of a mask's name: found in the photographs."""

PLAIN_NAME = re.compile(r"[^\W_](?:[\w .,()+-]*[\w)])?")


class _Artwork(Record):
    id: PlainText
    title: str = ""


class _Sphere(Record):
    frames: Frames
    circle_px: tuple[float, float, Positive] | None = None
    points_px: list[tuple[float, float]] | None = Field(default=None, min_length=3)
    mask: str | None = None
    outline: str | None = None


class _FlatSet(Record):
    frames: Frames
    turn_deg: float = Field(default=0.0, ge=-360, le=360)


def _sets_or_set(given: object) -> str:
    several = isinstance(given, list) and any(isinstance(one, (dict, _FlatSet)) for one in given)
    return "sets" if several else "set"


Flats = Annotated[
    Annotated[list[_FlatSet], Tag("sets")] | Annotated[Frames, Tag("set")], Discriminator(_sets_or_set)
]
"""Photographs of the flat, or several sets of them, between which the board was turned in its plane."""


class _Lights(Record):
    directions: str
    intensities: str | None = None


class _KnownHeights(Record):
    file: str
    sigma_mm: Positive | None = None
    registration_mm: float = Field(default=0.0, ge=0)
    tilted: bool = False


class _Tile(Record):
    name: PlainText
    origin_mm: tuple[float, float] = (0.0, 0.0)
    frames: Frames | None = None
    flats: Flats | None = None
    dark: str | None = None
    mask: str | None = None
    known_heights: _KnownHeights | None = None


class Manifest(Record):
    """The fields of an ``artwork.yaml``; paths in it are relative to its folder."""

    artwork: _Artwork
    priority: int = Field(default=0, description="in a night's order: higher goes first")
    stand: str | None = Field(default=None, description="name of a shipped stand, or a file of the capture")
    frames: Frames | None = None
    flats: Flats | None = None
    dark: str | None = None
    mask: str | None = None
    chrome_spheres: list[_Sphere] = Field(default=[])
    lights: _Lights | None = None
    known_heights: _KnownHeights | None = None
    encoding: Encoding = Encoding()
    sensor: Sensor | None = None
    pixel_size_mm: Positive | None = None
    white_reflectance: float = Field(default=0.9, gt=0, le=1)
    flats_averaged: int | None = Field(default=None, ge=1)
    tiles: list[_Tile] = Field(default=[_Tile(name="r0c0")], min_length=1)


def read_manifest(path: Path) -> tuple[Source, Manifest]:
    """Read an ``artwork.yaml`` as it was written, and where each field stands.

    Raises
    ------
    CaptureError
        Every fault at once.
    """
    source = Source(path, CaptureError, TEXTS)
    return source, source.check(Manifest)


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
    source, manifest = read_manifest(path)
    return tiles_of(source, manifest, stand=stand, root=root)


def tiles_of(
    source: Source, manifest: Manifest, *, stand: str | None = None, root: str | Path | None = None
) -> list[Tile]:
    """Find the tiles of a manifest that was read; see `load_capture`."""
    folder = source.path.parent.resolve()
    measured = _stand(manifest, stand, folder, source)
    reader = _Reader(source, manifest, measured, folder, Path(root or folder).resolve())
    tiles = []
    for i, entry in enumerate(manifest.tiles):
        tiles.append(reader.tile(i, entry))
        if len(reader.faults) > MOST_FAULTS:  # more need not be looked for
            break
    if reader.faults:
        raise CaptureError(list_faults(list(dict.fromkeys(reader.faults))))
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
    if why := refusal(folder / manifest.stand):
        raise CaptureError(source.fault(("stand",), f"{manifest.stand} {why}"))
    if not (folder / manifest.stand).resolve().is_relative_to(folder):
        raise CaptureError(
            source.fault(("stand",), f"{manifest.stand} is outside the capture; give it with --stand")
        )
    return load_stand(str(Folders().find(folder, manifest.stand).path), folder)


class _Reader:
    """Reader of a manifest's tiles, collecting every fault."""

    def __init__(
        self, source: Source, manifest: Manifest, stand: Stand | None, folder: Path, root: Path
    ) -> None:
        self.source, self.manifest, self.stand = source, manifest, stand
        self.paths = CapturePaths(
            folder, root, stand.name if stand else "", list(stand.lamps) if stand else [], source.fault
        )
        self._names: set[str] = set()
        named = Path(root.name, folder.relative_to(root)) if folder.is_relative_to(root) else folder.name
        if not is_text(named):
            self.paths.tell((), f"the folder's name, {escape_controls(str(named))}, is not UTF-8; rename it")
        if fault := fault_of(manifest.artwork.id):
            self.paths.tell(("artwork", "id"), fault)

    @property
    def faults(self) -> list[str]:
        """Sentences about what is wrong, of all tiles so far."""
        return self.paths.faults

    def tile(self, index: int, entry: _Tile) -> Tile | None:
        """Resolve one tile; None when there were faults."""
        at: Location = ("tiles", index)
        self._require_plain((*at, "name"), entry.name)
        if entry.name.casefold() in self._names:
            self.paths.tell((*at, "name"), f"'{entry.name}' stands twice; rename one")
        self._names.add(entry.name.casefold())
        whole, self.paths.notes = self.manifest, []

        def either(field: str) -> tuple[Location, Any]:
            own = getattr(entry, field)
            return ((*at, field), own) if own is not None else ((field,), getattr(whole, field))

        dark = self._optional(*either("dark"), entry.name)
        auto_mask = either("mask")[1] == AUTO
        mask = None if auto_mask else self._optional(*either("mask"), entry.name)
        others = {path for path in (dark, mask) if path}
        frames = self._frames(*either("frames"), entry.name, others)
        flats, turned = self._flats(*either("flats"), entry.name, others, frames)
        spheres = [
            self._sphere(i, sphere, entry.name, frames) for i, sphere in enumerate(whole.chrome_spheres)
        ]
        lights = self._lights()
        heights = self._heights(at, entry)
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
            flats=flats,
            turned_flats=turned,
            flats_averaged=whole.flats_averaged,
            dark=dark,
            mask=mask,
            auto_mask=auto_mask,
            spheres=tuple(spheres),
            lights=lights,
            known_heights=heights,
            encoding=whole.encoding,
            sensor=whole.sensor,
            white_reflectance=whole.white_reflectance,
            warnings=tuple(
                CaptureWarning(note.code, f"{self.source.path.name}: {note.sentence}", note.lamps)
                for note in self.paths.notes
            ),
        )

    def _flats(
        self, at: Location, given: Any, tile: str, others: Collection[Path], frames: dict[str, Path]
    ) -> tuple[dict[str, Path] | None, tuple[TurnedFlats, ...]]:
        """The first set of flats, and the further ones with the board turned against it."""
        if given is None:
            return None, ()
        several = isinstance(given, list) and isinstance(given[0], _FlatSet)
        sets = given if several else [_FlatSet(frames=given)]
        found = []
        for i, one in enumerate(sets):
            place: Location = (*at, i, "frames") if several else at
            flats = self._frames(place, one.frames, tile, others)
            self._same_lamps(place, flats, frames)
            found.append({lamp: flats[lamp] for lamp in frames if lamp in flats})
        turns = [one.turn_deg - sets[0].turn_deg for one in sets]
        if len({round(turn % 360, 3) for turn in turns}) < len(turns):
            self.paths.tell(
                at,
                "has two sets with the same turn_deg; state by how many degrees the board was turned for each",
            )
        further = zip(turns[1:], found[1:], strict=True)
        return found[0], tuple(TurnedFlats(turn_deg=turn, flats=flats) for turn, flats in further)

    def _sphere(self, index: int, sphere: _Sphere, tile: str, frames: dict[str, Path]) -> Sphere:
        at: Location = ("chrome_spheres", index)
        mask = self._optional((*at, "mask"), sphere.mask, tile)
        outline = self._optional((*at, "outline"), sphere.outline, tile)
        others = {path for path in (mask, outline) if path}
        found = self._frames((*at, "frames"), sphere.frames, tile, others)
        self._same_lamps((*at, "frames"), found, frames)
        return Sphere(
            frames=found,
            circle_px=sphere.circle_px,
            points_px=tuple(sphere.points_px) if sphere.points_px else None,
            mask=mask,
            outline=outline,
        )

    def _lights(self) -> GivenLights | None:
        given = self.manifest.lights
        if given is None:
            return None
        intensities = given.intensities
        return GivenLights(
            directions=self.paths.file(("lights", "directions"), given.directions),
            intensities=self.paths.file(("lights", "intensities"), intensities) if intensities else None,
        )

    def _heights(self, at: Location, entry: _Tile) -> HeightFile | None:
        own = entry.known_heights
        given, place = (
            (own, (*at, "known_heights")) if own else (self.manifest.known_heights, ("known_heights",))
        )
        if given is None:
            return None
        place = (*place, "file")
        path = self.paths.file(place, self.paths.fill(place, given.file, entry.name))
        if path.suffix.lower() == ".ply" and given.sigma_mm is None:
            self.paths.tell(place[:-1], "sigma_mm is missing, which a PLY does not hold; add it, mm")
        return HeightFile(**{**given.model_dump(), "file": path})

    def _frames(
        self, at: Location, given: Frames | str | None, tile: str, others: Collection[Path]
    ) -> dict[str, Path]:
        if given is None:
            self.faults.append(f"{self.source.path}: frames: is missing; add one photograph per lamp")
            return {}
        return self.paths.frames(at, given, tile, others)

    def _optional(self, at: Location, text: Frames | str | None, tile: str) -> Path | None:
        return self.paths.photograph(at, text, tile) if isinstance(text, str) else None

    def _same_lamps(self, at: Location, other: dict[str, Path], frames: dict[str, Path]) -> None:
        missing = [lamp for lamp in frames if lamp not in other]
        if other and missing:
            self.paths.tell(at, f"lacks {', '.join(missing)}, which the frames have; add them")

    def _require_plain(self, at: Location, name: str) -> None:
        if len(name.encode()) > LONGEST_NAME:
            self.paths.tell(
                at, f"is {len(name.encode())} bytes long and names a folder; {LONGEST_NAME} are allowed"
            )
        if is_reserved(name):
            self.paths.tell(at, f"'{name}' is the name of a folder of nLights' own; give the tile another")
        if not PLAIN_NAME.fullmatch(name):
            self.paths.tell(
                at,
                f"'{name}' is not a plain name: it names a folder, so it starts with a letter or digit "
                "and has letters, digits, spaces and . , _ - + ( ) only",
            )
