"""Writing a first ``artwork.yaml``: what was found, what could not be told, and the command to go on with."""

from __future__ import annotations

import json
import shlex
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.configurations import Source, find, load_stand, shipped_names
from nlights_core.errors import CaptureError, NlightsError, StandError
from nlights_core.manifest import load_capture
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.recipe import load_recipe
from nlights_core.stands import Stand
from nlights_flows.first_manifests.exposures import tell_exposures
from nlights_flows.first_manifests.lamps import (
    SELENE_LIGHTS,
    SELENE_LIST,
    Given,
    find_lights,
    selene_scale,
)
from nlights_flows.first_manifests.looking import Group, Look, look_at

MANIFEST = "artwork.yaml"


@dataclass(frozen=True)
class Wanted:
    """Wishes of the person who asks for a manifest; an empty text leaves it to what is found.

    Attributes
    ----------
    id, title : str
        Of the artwork; the folder's name is its id by default.
    stand : str
        Name of a shipped one, or a file.
    recipe : str
        Name or file of the recipe to go on with.
    """

    id: str = ""
    title: str = ""
    stand: str = ""
    recipe: str = ""


@dataclass
class Written:
    """Outcome of a folder.

    Attributes
    ----------
    path : Path
        The manifest.
    found, unsure : list of str
        Sentences.
    missing : str
        The one thing without which it cannot be digitised; empty where there is none.
    commands : list of str
        To go on with.
    """

    path: Path
    found: list[str] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)
    missing: str = ""
    commands: list[str] = field(default_factory=list)


def write_manifest(folder: Path, wanted: Wanted) -> Written:
    """Write the ``artwork.yaml`` of a folder; never over an existing one.

    Raises
    ------
    CaptureError
        When there is one, or the folder holds no set of photographs; nothing was written.
    """
    path = folder / MANIFEST
    if not folder.is_dir():
        raise CaptureError(f"{folder}: there is no such folder; give the folder that holds the photographs")
    if path.exists() or path.is_symlink():
        raise CaptureError(
            f"{path}: is there already, and init never writes over one; edit it, or move it away"
        )
    look = look_at(folder)
    written = Written(path)
    stand, stand_field, stand_option = _stand(look, wanted, written)
    given = find_lights(look)
    scale = None if stand or given.directions else selene_scale(look)
    if scale is not None:
        given.directions = SELENE_LIST
        written.found.append(
            f"a Selene set: lit from the top, right, bottom and left, at 45 degrees ({SELENE_LIST})"
        )
    fields = {
        "artwork": f"{{id: {_text(wanted.id or folder.resolve().name)}, title: {_text(wanted.title)}}}",
        "stand": _text(stand_field) if stand_field else "",
        **_photographs(look, stand, given, written),
        "pixel_size_mm": f"{scale:.6g}" if scale else "",
        **_lamps_of(look, given, written),
    }
    recipe = wanted.recipe or _recipe_for(look, stand, given)
    written.unsure += given.notes + look.unused
    tiles = _tried(path, _yaml(fields), written, wanted.stand if stand_option else None)
    if tiles:
        _examine(tiles[0], fields, written)
        _see_whether_enough(tiles[0], wanted, recipe, look, written)
    options = (f" --stand {shlex.quote(stand_option)}" if stand_option else "") + (
        f" --recipe {shlex.quote(recipe)}" if recipe not in ("", "default") else ""
    )
    written.commands = [f"nlights {verb} {shlex.quote(str(path))}{options}" for verb in ("check", "digitise")]
    if given.directions == SELENE_LIST:
        _write_new(folder / SELENE_LIST, SELENE_LIGHTS)
    _write_new(path, _header(written) + _yaml(fields) + _footer(fields))
    return written


def _stand(look: Look, wanted: Wanted, written: Written) -> tuple[Stand | None, str, str]:
    """The stand, how the manifest names it, and how the command line must where the manifest cannot.

    Raises
    ------
    StandError
        When the one that was asked for cannot be loaded.
    """
    if wanted.stand:
        stand = load_stand(wanted.stand)
        place = find(wanted.stand, "stands", StandError).resolve()
        written.found.append(f"the stand '{stand.name}', which was asked for")
        if not wanted.stand.endswith((".yaml", ".yml")):
            return stand, wanted.stand, ""
        inside = place.is_relative_to(look.folder.resolve())
        return (
            (stand, place.relative_to(look.folder.resolve()).as_posix(), "")
            if inside
            else (stand, "", wanted.stand)
        )
    for path in look.stands:
        try:
            stand = Source(look.folder / path, StandError).check(Stand)
        except NlightsError:
            continue
        written.found.append(f"{path}: the stand '{stand.name}'")
        return stand, path, ""
    return None, "", ""


def _photographs(look: Look, stand: Stand | None, given: Given, written: Written) -> dict[str, str]:
    """Fields of frames, flats, dark and mask."""
    groups = [look.frames, *([look.flats] if look.flats else []), *(sphere.group for sphere in look.spheres)]
    count = len(look.frames.series.names)
    lamps = list(stand.lamps) if stand else []
    keys = look.frames.series.keys
    numbered = [str(i) for i in range(1, len(lamps) + 1)] == [key.lstrip("0") for key in keys]
    alike = all(group.series.keys == keys for group in groups) and (not stand or numbered)
    if stand and count != len(lamps):
        written.missing = (
            f"a photograph for each lamp: the stand '{stand.name}' has {len(lamps)}, and there are {count}"
        )
    if stand and not numbered and count == len(lamps):
        written.unsure.append(
            f"whose lamp each photograph is: they are taken in the order of names, as {', '.join(lamps[:3])} ..."
        )
    if any(
        [int(k) for k in group.series.keys if k.isdecimal()] != [int(k) for k in keys if k.isdecimal()]
        for group in groups
    ):
        written.unsure.append(
            "which photographs belong to one lamp: the sets are numbered otherwise, and taken in order"
        )
    written.found.append(f"{look.frames.called}: {count} photographs, one per lamp")
    if given.chosen is not None:
        written.unsure.append(
            f"{given.directions} names {len(given.chosen)} of {count} photographs; the others are left out"
        )
    fields = {"frames": _frames(look.frames, look, alike, given.chosen)}
    if look.tiles:
        written.found.append(f"{len(look.tiles)} tiles: {', '.join(look.tiles[:6])}")
        written.unsure.append(
            "whether the folders are tiles of one artwork: if not, run init on each of them"
        )
    if look.flats:
        written.found.append(f"{look.flats.called}: flats")
        fields["flats"] = _frames(look.flats, look, alike, given.chosen, tiled=False)
    for name in ("dark", "mask"):
        if value := getattr(look, name):
            written.found.append(f"{value}: {'dark frame' if name == 'dark' else 'mask'}")
            fields[name] = _text(_tiled(value, look) if name == "mask" else value)
    if look.tiles:
        fields["tiles"] = "".join(f"\n  - {{name: {_text(name)}}}" for name in look.tiles)
    return fields


def _lamps_of(look: Look, given: Given, written: Written) -> dict[str, str]:
    """Fields of spheres and lights."""
    fields = {}
    groups = [look.frames, *(sphere.group for sphere in look.spheres)]
    alike = all(group.series.keys == look.frames.series.keys for group in groups)
    if look.spheres:
        spheres = ""
        for sphere in look.spheres:
            spheres += f"\n  - frames: {_frames(sphere.group, look, alike, given.chosen, tiled=False)}"
            for name in ("outline", "mask"):
                if value := getattr(sphere, name):
                    spheres += f"\n    {name}: {_text(value)}"
            written.found.append(f"{sphere.group.called}: photographs of a chrome sphere")
        fields["chrome_spheres"] = spheres
    if given.directions:
        if given.directions != SELENE_LIST:
            written.found.append(f"{given.directions}: the directions of the lights")
        lights = f"directions: {_text(given.directions)}"
        if given.intensities:
            written.found.append(f"{given.intensities}: their intensities")
            lights += f", intensities: {_text(given.intensities)}"
        fields["lights"] = f"{{{lights}}}"
    return fields


def _frames(group: Group, look: Look, alike: bool, chosen: Sequence[int] | None, tiled: bool = True) -> str:
    """Photographs as the manifest writes them: a pattern where one says it, else one by one."""
    series = group.series
    if alike and series.pattern and chosen is None:
        return _text(_tiled(group.path(series.pattern), look) if tiled else group.path(series.pattern))
    paths = [_text(_tiled(path, look) if tiled else path) for path in group.paths]
    named = look.frames.series
    if chosen is not None or not named.pattern:
        keep = range(len(paths)) if chosen is None else chosen
        return "{" + ", ".join(f"{_text(named.keys[i])}: {paths[i]}" for i in keep) + "}"
    return "[" + ", ".join(paths) + "]"


def _tiled(path: str, look: Look) -> str:
    return path.replace(Path(look.frames.folder).name, "{tile}") if look.tiles else path


def _recipe_for(look: Look, stand: Stand | None, given: Given) -> str:
    """Name of the shipped recipe that fits what was found; empty where none does."""
    if stand is not None:
        return "default" if look.flats else "no-flats"
    return "given-directions" if given.directions else "chrome-sphere" if look.spheres else ""


def _tried(path: Path, text: str, written: Written, stand: str | None) -> list[Tile]:
    """Tiles of the manifest as the other commands would read it."""
    draft = path.with_name(f".artwork-{uuid.uuid4().hex[:8]}.yaml")
    try:
        draft.write_text(text, encoding="utf-8")
        tiles = load_capture(draft, stand=stand)
        told = [warning.sentence.removeprefix(f"{draft.name}: ") for warning in tiles[0].warnings]
        written.unsure += told
        return tiles
    except CaptureError as fault:
        written.missing = written.missing or str(fault).replace(str(draft), str(path))
        return []
    finally:
        draft.unlink(missing_ok=True)


def _examine(tile: Tile, fields: dict[str, str], written: Written) -> None:
    """Look at sizes, depths and EXIF."""
    try:
        info = survey(tile)
        grid = grid_of(tile, info)
    except (NlightsError, OSError) as fault:
        written.missing = written.missing or str(fault)
        return
    written.found.append(f"{info.columns} x {info.rows} px, {info.channels} x {info.dtype}")
    suffixes = {path.suffix.lower() for path in tile.frames.values()}
    if suffixes & {".jpg", ".jpeg"}:
        fields["encoding"] = "{transfer: srgb}"
        written.unsure.append("the tone curve: the photographs are JPEGs, so sRGB is assumed (encoding)")
    elif str(info.dtype) == "uint8":
        written.unsure.append(
            "the tone curve: 8 bits are often sRGB (encoding: {transfer: srgb}), and sometimes linear"
            + ("; or a Bayer mosaic (encoding: {mosaic: RGGB})" if info.channels == 1 else "")
        )
    if grid.unit == "px":
        written.unsure.append("the scale: lengths will be in pixels without pixel_size_mm")
    tell_exposures(list(tile.frames.values()), written.found, written.unsure)


def _see_whether_enough(tile: Tile, wanted: Wanted, recipe: str, look: Look, written: Written) -> None:
    if wanted.recipe:
        lacking = load_recipe(wanted.recipe).lacking(tile)
        written.missing = written.missing or "; ".join(lacking)
    elif not recipe:
        written.missing = written.missing or (
            "where the lamps are: name a stand (--stand; shipped are "
            f"{', '.join(shipped_names('stands'))}), or put a list of their directions or photographs of a chrome "
            "sphere into the folder"
        )


def _header(written: Written) -> str:
    lines = ["What nlights init found here by names, sizes and EXIF.  Correct what is wrong.", "", "Found:"]
    lines += [f"  {sentence}" for sentence in written.found]
    if written.unsure:
        lines += ["It could not tell, or left out:", *(f"  {sentence}" for sentence in written.unsure)]
    if written.missing:
        lines += ["Missing:", f"  {written.missing}"]
    lines += ["Go on with:", *(f"  {command}" for command in written.commands)]
    return (
        "".join(
            f"# {' '.join(line.split()) if not line.startswith('  ') else '  ' + _plain(line)}".rstrip()
            + "\n"
            for line in lines
        )
        + "\n"
    )


def _plain(text: str) -> str:
    """Text on one line, without what a terminal or YAML takes for something else."""
    return "".join(letter for letter in " ".join(text.split()) if letter.isprintable())


def _yaml(fields: Mapping[str, str]) -> str:
    return "".join(
        f"{name}:{value if value.startswith(chr(10)) else ' ' + value}\n"
        for name, value in fields.items()
        if value
    )


def _footer(fields: Mapping[str, str]) -> str:
    """Fields that may be added, as comments."""
    more = {
        "stand": "horizontal  # the stand whose lamps were measured",
        "flats": '"flat/light_{n}.tif"  # photographs of a flat, white, matt board under the same lamps',
        "dark": "dark.tif  # a photograph with the lens covered",
        "mask": "mask.png  # not 0 on the artwork",
        "pixel_size_mm": "0.05  # edge of a pixel on the artwork",
        "encoding": "{transfer: srgb}  # how numbers stand for light",
    }
    lines = [f"# {name}: {value}\n" for name, value in more.items() if not fields.get(name)]
    return "\n# May be added:\n" + "".join(lines) if lines else ""


def _text(text: str) -> str:
    """Text in quotes, as YAML reads it."""
    return json.dumps(text, ensure_ascii=False)


def _write_new(path: Path, text: str) -> None:
    """Write a file that was not there.

    Raises
    ------
    CaptureError
        When it is there, or cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    except OSError as fault:
        raise CaptureError(
            f"{path}: cannot be written ({fault.strerror}); init never writes over a file"
        ) from fault
