"""Errors of a stand's measurement, made on purpose: displaced lamps, changed strengths."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from nlights_core.capture import Tile
from nlights_core.configurations import load_stand
from nlights_core.errors import NlightsError
from nlights_core.frames import Array
from nlights_core.simulation.captures import BLACK_LEVEL, SATURATION
from nlights_core.stands import Stand

AXES = ("x", "y", "z", "-x", "-y", "-z")
"""Directions of the plane frame."""

SHARES = (0.125, 0.25, 0.5, 1.0)
"""How much of the way to another stand is tried."""

FARTHEST_MM = 100.0
"""Stands whose lamps are farther apart in the mean are different stands, or number their lamps
differently; the paper's largest displacement is 19 mm (Table 20)."""

COUNT = 10
"""Errors in a range that does not say how many."""


@dataclass(frozen=True)
class Sweep:
    """A kind of error, its sizes, and how to make it.

    Parameters
    ----------
    what : str
        What is wrong, for people.
    unit : {"mm", "%"}
        Of the errors.
    errors : tuple of float
        Positive, ascending.
    disturb : callable
        ``disturb(tile, error, draw, folder)``: the tile as it is believed to be, or, for errors of
        strength, with photographs that it writes to ``folder``.
    draws : int
        How often chance is asked; 1 where the error has no chance in it.
    """

    what: str
    unit: str
    errors: tuple[float, ...]
    disturb: Callable[[Tile, float, int, Path], Tile]
    draws: int = 1


_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


def parse_errors(text: str, option: str = "--errors") -> tuple[float, ...]:
    """Read a range or a list of error sizes.

    Parameters
    ----------
    text : str
        ``0.1..100`` (10 sizes, logarithmically spaced), ``0.1..100:13`` or ``0.5,1,5``.
    option : str
        Named in the faults.

    Returns
    -------
    tuple of float
        Ascending.

    Raises
    ------
    NlightsError
        When it is neither, or a size is not positive.

    Examples
    --------
    >>> parse_errors("5,0.5,1")
    (0.5, 1.0, 5.0)
    >>> [round(size, 6) for size in parse_errors("0.1..100:4")]
    [0.1, 1.0, 10.0, 100.0]
    """
    found = re.fullmatch(rf"\s*({_NUMBER})\.\.({_NUMBER})(?::(\d+))?\s*", text)
    if found:
        first, last, count = float(found[1]), float(found[2]), int(found[3] or COUNT)
        if not 0 < first < last < np.inf or not 2 <= count <= 200:
            raise NlightsError(
                f"{option}: '{text}' is no range; it goes from a size above 0 to a larger one, "
                "with 2 to 200 sizes: 0.1..100 or 0.1..100:13"
            )
        return tuple(float(size) for size in np.geomspace(first, last, count))
    parts = [part.strip() for part in text.split(",")]
    if not all(re.fullmatch(_NUMBER, part) and 0 < float(part) < np.inf for part in parts):
        raise NlightsError(
            f"{option}: '{text}' is neither a range (0.1..100, 0.1..100:13) nor a list (0.5,1,5) of "
            "sizes above 0"
        )
    return tuple(sorted({float(part) for part in parts}))


def along_axis(errors: Sequence[float], axis: str) -> Sweep:
    """All lamps believed to be displaced alike, as in the paper's Figure 2.

    Parameters
    ----------
    errors : sequence of float
        mm.
    axis : str
        One of `AXES`; z is towards the camera.

    Raises
    ------
    NlightsError
        For another axis.
    """
    if axis not in AXES:
        raise NlightsError(f"--axis: '{axis}' is no axis; choose one of {', '.join(AXES)}")
    direction = np.zeros(3)
    direction["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0

    def disturb(tile: Tile, error: float, draw: int, folder: Path) -> Tile:
        return _displaced(tile, np.tile(error * direction, (len(tile.lamps), 1)))

    return Sweep(f"displacement of all lamps along {axis}", "mm", tuple(errors), disturb)


def at_random(errors: Sequence[float], draws: int, seed: int) -> Sweep:
    """Every lamp believed to be elsewhere by chance, independently along x, y and z.

    Parameters
    ----------
    errors : sequence of float
        Standard deviations of the Gaussian error per axis, mm, like a stand's ``uncertainty_mm``.
    draws, seed : int
        The same draw gives the same pattern at every size.
    """

    def disturb(tile: Tile, error: float, draw: int, folder: Path) -> Tile:
        pattern = np.random.default_rng([seed, draw]).standard_normal((len(tile.lamps), 3))
        return _displaced(tile, error * pattern)

    what = "random displacement of each lamp, standard deviation per axis"
    return Sweep(what, "mm", tuple(errors), disturb, draws)


def towards(stand: Stand, other: Stand) -> Sweep:
    """Lamps and camera believed to be on the way to another stand, and there (Table 20's shift).

    Parameters
    ----------
    stand, other : Stand
        That took the photographs; that is believed to have taken them.

    Returns
    -------
    Sweep
        Its sizes are the mean distance of the lamps from where they are, mm; the largest is the
        whole shift.

    Raises
    ------
    NlightsError
        When the stands differ in their lamps' names or their fields, in nothing, or by more than
        `FARTHEST_MM`.
    """
    if set(stand.lamps) != set(other.lamps) or stand.field_mm != other.field_mm:
        raise NlightsError(
            f"--against: '{other.name}' has other lamps or another field than '{stand.name}'; give a "
            "second measurement of the same stand"
        )
    names = tuple(stand.lamps)
    shift = other.lamp_positions(names) - stand.lamp_positions(names)
    whole = float(np.linalg.norm(shift, axis=1).mean())
    if whole == 0:
        raise NlightsError(f"--against: the lamps of '{other.name}' are where those of '{stand.name}' are")
    if whole > FARTHEST_MM:
        raise NlightsError(
            f"--against: the lamps of '{other.name}' are {whole:.0f} mm from those of '{stand.name}' in the "
            "mean; give a second measurement of the same stand, with the same names of the lamps"
        )
    camera = other.camera_position - stand.camera_position

    def disturb(tile: Tile, error: float, draw: int, folder: Path) -> Tile:
        share = error / whole
        order = [names.index(lamp) for lamp in tile.lamps]
        return _displaced(tile, share * shift[order], share * camera)

    what = f"mean displacement of the lamps towards {other.name}"
    return Sweep(what, "mm", tuple(share * whole for share in SHARES), disturb)


def of_strength(errors: Sequence[float], draws: int, seed: int) -> Sweep:
    """Every lamp's light differs by chance from what it was when the flat was photographed.

    Parameters
    ----------
    errors : sequence of float
        Standard deviations of the logarithm of the strength; 0.01 is 1 %.
    draws, seed : int
        The same draw gives the same pattern at every size.

    Returns
    -------
    Sweep
        Its sizes are in per cent.

    Raises
    ------
    NlightsError
        For a size of 1 or more.
    """
    if max(errors) >= 1:
        raise NlightsError(f"--strength: {max(errors):g} is too much; give shares below 1: 0.01 is 1 %")

    def disturb(tile: Tile, error: float, draw: int, folder: Path) -> Tile:
        pattern = np.random.default_rng([seed, draw]).standard_normal(len(tile.lamps))
        frames = {}
        for (lamp, path), factor in zip(tile.frames.items(), np.exp(error / 100 * pattern), strict=True):
            light = tifffile.imread(path).astype(np.float64) - BLACK_LEVEL
            numbers = np.clip(np.rint(BLACK_LEVEL + factor * light), 0, SATURATION)
            frames[lamp] = folder / path.name
            tifffile.imwrite(frames[lamp], numbers.astype(np.uint16), photometric="rgb")
        return tile.model_copy(update={"frames": frames})

    what = "random change of each lamp's strength, standard deviation"
    return Sweep(what, "%", tuple(100 * error for error in errors), disturb, draws)


def choose_sweep(
    stand: str,
    axis: str | None,
    errors: str | None,
    random: bool,
    strength: str | None,
    against: str | None,
    draws: int,
    seed: int,
) -> Sweep:
    """The sweep that the options of the command line ask for.

    Parameters
    ----------
    stand, against : str, str or None
        Names or files of stands.
    axis, errors, strength : str or None
        As typed.
    random : bool
        Chance instead of an axis.
    draws, seed : int
        For chance.

    Raises
    ------
    NlightsError
        When an option is out of range, or two options contradict each other.
    """
    given = {"--axis": axis, "--random": random, "--strength": strength, "--against": against}
    kinds = [name for name, value in given.items() if value]
    if len(kinds) > 1:
        raise NlightsError(f"{' and '.join(kinds)}: each is a study of its own; give one of them")
    if errors and (strength or against):
        raise NlightsError(f"--errors: {kinds[0]} says itself how large its errors are; leave --errors out")
    measured = load_stand(stand)
    if against:
        return towards(measured, load_stand(against))
    if strength:
        return of_strength(parse_errors(strength, "--strength"), draws, seed)
    sizes = parse_errors(errors or "0.1..100")
    return at_random(sizes, draws, seed) if random else along_axis(sizes, axis or "z")


def _displaced(tile: Tile, shift: Array, camera: Array | None = None) -> Tile:
    """The tile with its lamps, and its camera, moved by (L, 3) and (3,) mm of the plane frame."""
    assert tile.stand is not None
    # The rows of a rotation's matrix are its inverse's columns: back to the measured axes.
    rotation = tile.stand.axes.matrix()
    moved = (tile.stand.lamp_positions(tile.lamps) + shift) @ rotation
    changes: dict[str, Any] = {"lamps": dict(zip(tile.lamps, map(tuple, moved.tolist()), strict=True))}
    if camera is not None:
        changes["camera"] = tuple(((tile.stand.camera_position + camera) @ rotation).tolist())
    return tile.model_copy(update={"stand": tile.stand.model_copy(update=changes)})
