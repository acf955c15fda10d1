"""Simulated captures with one trouble each: gloss, changed lamps, stray light, a poor flat, moved photographs.

They stand on the simulator (nlights_core.simulation); what it has is used, and what it lacks is here.  Without a
trouble a capture differs from the simulator's in two things: its flats and its dark frame are means of 16 exposures,
and the manifest states the sensor.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
import yaml
from glossy_paint import MATT, Gloss, Paint, reflected
from numpy.random import Generator, default_rng
from scipy.ndimage import binary_dilation

from nlights_core.frames import Array
from nlights_core.simulation.captures import (
    EXPOSURE,
    FLAT_ALBEDO,
    FULL_WELL,
    READ_NOISE,
    Studio,
    expose,
    set_up,
)
from nlights_core.simulation.illumination import Horizon, LampGroup
from nlights_core.simulation.surfaces import Surface, bow, plane, seen_points, wave
from nlights_core.stands import Stand

FLATS_AVERAGED = 16
GOLD = Paint(Gloss("ggx", (1.0, 0.71, 0.29), 0.3))
"""Gold leaf: a rough mirror without a body colour."""


@dataclass(frozen=True)
class Trouble:
    """Trouble of a capture; the defaults are a sound one on matt paint.

    Attributes
    ----------
    paint, flat_paint : Paint
        Of the artwork, and of the flat.
    gilded : float
        Share of the field under gold leaf; the truth leaves it out.
    flat_sag_mm : float
        Bow of the flat over the field.
    level_mm : float
        Of the artwork above the plane of the flat.
    missing, exchanged : bool
        One lamp is not in the manifest; the photographs of two lamps stand under each other's names there.
    drift : float
        Standard deviation of the lamps' factors since the flats; 0.02 is 2 %.
    factors : tuple of float
        The factors themselves, one per lamp; those of the drift and of the brighter lamp come on top.
    brighter : float
        Factor of one lamp since the flats.
    aim_deg : float
        Angle by which every lamp has turned since the flats, each its own way.
    moved_px : float
        Greatest shift of a photograph in each direction, before their mean is taken off.
    additive : float
        Light that the dark frame lacks, in photographs and flats, as a share of the mean flat.
    room : float
        Light of the room on the surface, as a share of the lamps' mean irradiance.
    averaged_stated : bool
        The manifest states that the flats are averaged, instead of the sensor.
    """

    paint: Paint = MATT
    flat_paint: Paint = MATT
    gilded: float = 0.0
    flat_sag_mm: float = 0.0
    level_mm: float = 0.0
    missing: bool = False
    exchanged: bool = False
    drift: float = 0.0
    factors: tuple[float, ...] = ()
    brighter: float = 1.0
    aim_deg: float = 0.0
    moved_px: float = 0.0
    additive: float = 0.0
    room: float = 0.0
    averaged_stated: bool = False


class LampNow(NamedTuple):
    """A lamp when the artwork is photographed.

    Attributes
    ----------
    group : LampGroup
        How it shines but for its strength.
    shadows : Horizon
        What the artwork casts.
    factor : float
        Of its strength since the flats.
    shift_px : (2,) float64 array
        Of its photograph, to the right and down.
    """

    group: LampGroup
    shadows: Horizon
    factor: float
    shift_px: Array


class View(NamedTuple):
    """The artwork as the camera sees it.

    Attributes
    ----------
    points, normals : (3, h, w) float64 arrays
        mm; unit.
    x, y : (h, w) float64 arrays
        Where on the artwork these points are, mm.
    albedo : (h, w, 3) float64 array
        There.
    """

    points: Array
    normals: Array
    x: Array
    y: Array
    albedo: Array


class Photograph(NamedTuple):
    """A lamp's photograph before exposure, (h, w, 3) float64: all its light, and that of body colours alone."""

    light: Array
    body: Array


def simulate_troubled(
    folder: Path, stand: Stand, *, scene: str, width: int, seed: int, trouble: Trouble
) -> Path:
    """Write a capture with a trouble: photographs, flats, dark frame, manifest and truth.

    Parameters
    ----------
    folder : Path
        Where to; absent.
    stand : Stand
        One that is shipped.
    scene : str
        One of `nlights_core.simulation.scenes.SCENES`.
    width : int
        Columns of the photographs.
    seed : int
        The same seed gives the same files.  Scene and lamps are those of `simulate` with this seed.
    trouble : Trouble
        What is wrong.

    Returns
    -------
    Path
        The manifest.
    """
    studio = set_up(stand, scene, width, False, seed)
    artwork = studio.scene.surface + plane(level=trouble.level_mm)
    studio = replace(studio, scene=replace(studio.scene, surface=artwork))
    leaf = gilding(trouble.gilded, stand.field_mm, seed) if trouble.gilded else None
    flats, mean = _flats(studio, trouble)
    room, veil = trouble.room * mean / FLAT_ALBEDO, trouble.additive * mean
    still = look(studio, np.zeros(2))
    frames = []
    for lamp in changed_lamps(studio, trouble, seed):
        view = look(studio, lamp.shift_px) if trouble.moved_px else still
        frames.append(photograph(studio, lamp, view, trouble.paint, leaf, room))
    folder.mkdir(parents=True)
    _write_photographs(folder, frames, flats, veil, seed)
    _write_truth(still, leaf, folder / "truth")
    text = yaml.safe_dump(_manifest(stand, scene, trouble, seed), sort_keys=False)
    (folder / "artwork.yaml").write_text(text, encoding="utf-8")
    return folder / "artwork.yaml"


def _write_photographs(
    folder: Path, frames: list[Photograph], flats: list[Array], veil: float, seed: int
) -> None:
    """Expose all for the brightest matt pixel; the veil lies on all but the dark frame."""
    brightest = max(*(float(f.body.max()) for f in frames), *(float(f.max()) for f in flats))
    gain = EXPOSURE / (brightest + veil)
    (folder / "flat").mkdir()
    for k, (frame, flat) in enumerate(zip(frames, flats, strict=True)):
        taken = _exposed(frame.light + veil, gain, _chance(seed, f"frame {k}"))
        tifffile.imwrite(folder / f"light_{k + 1}.tif", taken, photometric="rgb")
        taken = _exposed(flat + veil, gain, _chance(seed, f"flat {k}"), FLATS_AVERAGED)
        tifffile.imwrite(folder / "flat" / f"light_{k + 1}.tif", taken, photometric="rgb")
    dark = _exposed(np.zeros_like(flats[0]), gain, _chance(seed, "dark"), FLATS_AVERAGED)
    tifffile.imwrite(folder / "dark.tif", dark, photometric="rgb")


def _chance(seed: int, purpose: str) -> Generator:
    """Random numbers for one purpose, independent of all others."""
    return default_rng([seed, zlib.crc32(purpose.encode())])


def changed_lamps(studio: Studio, trouble: Trouble, seed: int) -> list[LampNow]:
    """The lamps and the photographs' shifts, as the trouble changes them after the flats."""
    groups, count = studio.groups, len(studio.groups)
    factors = np.array(trouble.factors or (1.0,) * count)
    factors = factors * (1 + trouble.drift * _chance(seed, "drift").standard_normal(count))
    factors[_chance(seed, "brighter").integers(count)] *= trouble.brighter
    # Shifts have the mean 0, for the truth is the artwork where it was.
    shifts = _chance(seed, "moved").uniform(-1, 1, (count, 2)) * trouble.moved_px
    shifts -= shifts.mean(axis=0)
    if trouble.aim_deg:
        random = _chance(seed, "aim")
        groups = [_turned(group, trouble.aim_deg, random) for group in groups]
    return [LampNow(*lamp) for lamp in zip(groups, studio.horizons, factors, shifts, strict=True)]


def _turned(group: LampGroup, degrees: float, random: Generator) -> LampGroup:
    """The group with its four lamps' axes turned by an angle in a random direction."""
    side = np.cross(-group.centre, random.normal(size=3))
    side *= np.tan(np.radians(degrees)) / np.linalg.norm(side)
    axes = group.axes + side
    return replace(group, axes=axes / np.linalg.norm(axes, axis=1, keepdims=True))


def shifted(surface: Surface, across: float, up: float) -> Surface:
    """A surface moved in its plane, mm."""
    return Surface(
        lambda x, y: surface.height(x - across, y - up), lambda x, y: surface.slopes(x - across, y - up)
    )


def gilding(share: float, size: tuple[float, float], seed: int) -> Surface:
    """Patches of gold leaf, some centimetres wide: gilded where this surface is above 0.

    Parameters
    ----------
    share : float
        Of the field.
    size : tuple of 2 floats
        Of the field, mm.
    seed : int
        Where chance enters.
    """
    random = _chance(seed, "gold")
    waves = reduce(
        add,
        (wave(1.0, random.uniform(60, 250), random.uniform(0, 360), random.uniform(0, 6)) for _ in range(6)),
    )
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, 200) * edge for edge in size))
    return waves + plane(level=-float(np.quantile(waves.height(x, y), 1 - share)))


def look(studio: Studio, shift_px: Array) -> View:
    """The artwork as the camera sees it, moved in its plane by so many pixels to the right and down."""
    across, up = shift_px * (studio.grid.pixel_size, -studio.grid.pixel_size)
    points, normals = _seen(shifted(studio.scene.surface, across, up), studio)
    x, y = points[0] - across, points[1] - up
    return View(points, normals, x, y, studio.scene.albedo(x, y))


def photograph(
    studio: Studio,
    lamp: LampNow,
    view: View,
    paint: Paint = MATT,
    leaf: Surface | None = None,
    room: float = 0.0,
) -> Photograph:
    """The artwork under one lamp, as the lens receives it.

    Parameters
    ----------
    studio : Studio
        The artwork and the camera.
    lamp : LampNow
        As it is now.
    view : View
        The artwork where it was for this photograph.
    paint : Paint
        Of the artwork.
    leaf : Surface, optional
        Where it is gilded.
    room : float
        Irradiance by the light of the room.
    """
    camera = np.array(studio.grid.camera)
    # A cast shadow moves with the artwork: for a lamp, a pixel is no other direction.
    skyline = lamp.shadows.at(view.x, view.y)
    lit = (lamp.group, view.points, view.normals, camera, skyline)
    matt, gloss = reflected(paint, *lit)
    body = matt * view.albedo
    light = body + gloss
    if leaf is not None:
        gilded = (leaf.height(view.x, view.y) > 0)[..., None]
        light = np.where(gilded, reflected(GOLD, *lit)[1], light)
        body = np.where(gilded, 0, body)
    lens = studio.vignetting(0, studio.grid.rows)
    around = room * _openness(view.normals) * view.albedo * lens
    return Photograph(light * lens * lamp.factor + around, body * lens * lamp.factor + around)


def _seen(surface: Surface, studio: Studio) -> tuple[Array, Array]:
    """Points and normals of a surface in the pixels, (3, h, w) each."""
    points = seen_points(surface, studio.grid)
    return points, np.moveaxis(surface.normals(points[0], points[1]), -1, 0)


def _openness(normals: Array) -> Array:
    """Share of a hemisphere, as bright everywhere, that shines on a surface, (h, w, 1)."""
    return np.asarray((1 + normals[2]) / 2)[..., None]


def _flats(studio: Studio, trouble: Trouble) -> tuple[list[Array], float]:
    """The flat under each lamp and the room, as the lens receives it, (h, w, 3) each; mean of the lamps' light."""
    grid = studio.grid
    sag = trouble.flat_sag_mm
    points, normals = _seen(bow(sag, grid.columns * grid.pixel_size, grid.rows * grid.pixel_size), studio)
    camera, lens = np.array(grid.camera), studio.vignetting(0, grid.rows)
    flats = []
    for group in studio.groups:
        matt, gloss = reflected(trouble.flat_paint, group, points, normals, camera)
        flats.append((matt * np.full(3, FLAT_ALBEDO) + gloss) * lens)
    mean = float(np.mean(flats))
    around = trouble.room * mean * _openness(normals) * lens
    return [flat + around for flat in flats], mean


def _exposed(light: Array, gain: float, random: Generator, count: int = 1) -> Array:
    """The mean of some exposures, in whole numbers."""
    light = light.astype(np.float32)
    total = sum(expose(light, gain, random).astype(np.uint32) for _ in range(count))
    return np.asarray(np.rint(total / count), np.uint16)


def _write_truth(view: View, leaf: Surface | None, folder: Path) -> None:
    """Normals and heights of the artwork; NaN on gold and within two pixels of it."""
    height, normals = view.points[2].copy(), np.moveaxis(view.normals, 0, -1).copy()
    if leaf is not None:
        aside = binary_dilation(leaf.height(view.x, view.y) > 0, iterations=2)
        height[aside], normals[aside] = np.nan, np.nan
    folder.mkdir()
    tifffile.imwrite(folder / "height.tif", height.astype(np.float32))
    tifffile.imwrite(folder / "normals.tif", normals.astype(np.float32), photometric="rgb")


def _manifest(stand: Stand, scene: str, trouble: Trouble, seed: int) -> dict[str, Any]:
    """The manifest, which leaves a lamp out or exchanges two where that is the trouble."""
    random = _chance(seed, "manifest")
    files = {lamp: f"light_{n}.tif" for n, lamp in enumerate(stand.lamps, 1)}
    if trouble.missing:
        del files[random.choice(list(files))]
    frames, flats = dict(files), {lamp: f"flat/{name}" for lamp, name in files.items()}
    if trouble.exchanged:
        one, other = random.choice(list(files), 2, replace=False)
        frames[one], frames[other] = frames[other], frames[one]
    sensor = {"electrons_at_saturation": FULL_WELL, "read_noise_electrons": READ_NOISE}
    noise = {"flats_averaged": FLATS_AVERAGED} if trouble.averaged_stated else {"sensor": sensor}
    return {
        "artwork": {"id": f"troubled-{scene}", "title": f"Troubled {scene}, seed {seed}"},
        "stand": stand.name,
        "frames": frames,
        "flats": flats,
        "dark": "dark.tif",
        "white_reflectance": FLAT_ALBEDO,
        **noise,
        "tiles": [{"name": "r0c0", "origin_mm": [0, 0]}],
    }
