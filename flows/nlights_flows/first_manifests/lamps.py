"""Lamps of a folder: lists of lights that fit its photographs, and Selene's four."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nlights_core.algorithms import LightModel
from nlights_core.capture import GivenLights, Tile
from nlights_core.errors import NlightsError
from nlights_core.frames import Array
from nlights_core.names.listed import match_listed
from nlights_core.registry import installed
from nlights_flows.first_manifests.looking import Look

SELENE = ("1.tif", "2.tif", "3.tif", "4.tif")
"""Photographs of Selene: lit from the top, right, bottom and left, at 45 degrees."""

SELENE_LIST = "selene-lights.lp"

SELENE_LIGHTS = "4\n" + "".join(
    f"{name} {x} {y} 0.707107\n"
    for name, x, y in zip(
        SELENE, ("0", "0.707107", "0", "-0.707107"), ("0.707107", "0", "-0.707107", "0"), strict=True
    )
)


@dataclass
class Given:
    """A list of lights that fits.

    Attributes
    ----------
    directions, intensities : str or None
        Files of the capture.
    chosen : list of int or None
        Photographs that it names, where it does not name all.
    notes : list of str
        Lists that do not fit, with the reason.
    """

    directions: str | None = None
    intensities: str | None = None
    chosen: list[int] | None = None
    notes: list[str] = field(default_factory=list)


def find_lights(look: Look) -> Given:
    """Find the list of lights that fits a folder's photographs."""
    frames = [look.folder / path for path in look.frames.paths]
    given = Given()
    for path in look.lists:
        if given.directions is not None:
            given.notes.append(f"{path}: another list of lights, not used")
            continue
        fault = _fault(frames, look.folder / path)
        if fault is None:
            given.directions = path
        elif chosen := _named(look.folder / path, frames):
            given.directions, given.chosen = path, chosen
        else:
            given.notes.append(
                f"{path}: no list of these photographs' lights: {fault.replace(str(look.folder), '.')}"
            )
    if given.directions:
        kept = frames if given.chosen is None else [frames[i] for i in given.chosen]
        fitting = (
            path
            for path in look.intensities
            if _fault(kept, look.folder / given.directions, look.folder / path) is None
        )
        given.intensities = next(fitting, None)
    return given


def selene_scale(look: Look) -> float | None:
    """Edge of a pixel in a Selene set, mm; 0 where it does not say it, None where this is none.

    A set is four photographs ``1.tif`` to ``4.tif``, with Selene's maps or a world file (``.tfw``, metres) below.
    """
    if tuple(look.frames.series.names) != SELENE or look.tiles:
        return None
    worlds = sorted(look.folder.glob("*.tfw")) + sorted(look.folder.glob("*/*.tfw"))
    if not worlds and not (look.folder / look.frames.path("Selene_Output")).is_dir():
        return None
    try:
        edge = float(worlds[0].read_text(encoding="utf-8").split()[0]) if worlds else 0.0
    except (OSError, ValueError, IndexError):
        return 0.0
    return 1000 * edge if 0 < edge < 1 else 0.0


def _fault(frames: Sequence[Path], directions: Path, intensities: Path | None = None) -> str | None:
    """Reason why a list does not fit; None where it does."""
    offer = installed().get("light_model", "given-directions")
    assert offer is not None
    model = offer.algorithm()
    assert isinstance(model, LightModel)
    tile = Tile(
        artwork="a",
        name="t",
        frames={str(i): path for i, path in enumerate(frames)},
        lights=GivenLights(directions=directions, intensities=intensities),
    )
    try:
        model.locate(tile, _read_nothing)
    except (NlightsError, OSError) as fault:
        return str(fault)
    return None


def _read_nothing(path: Path, *, reduce: int = 1) -> Array:
    raise AssertionError(f"{path}: a list of lights needs no photograph")


def _named(path: Path, frames: Sequence[Path]) -> list[int]:
    """Photographs that a list with names names, where it names at least three, and the list fits those."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()[1:]
    except (OSError, UnicodeDecodeError):
        return []
    names = [row[0] for line in lines if len(row := line.rsplit(maxsplit=3)) == 4]
    chosen = (
        [i for i, line in enumerate(match_listed(names, frames).lines) if line is not None] if names else []
    )
    if len(chosen) < 3 or _fault([frames[i] for i in chosen], path) is not None:
        return []
    return chosen
