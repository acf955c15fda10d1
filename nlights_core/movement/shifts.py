"""Shifts: how far every photograph of a tile lies from the others, to be taken out when it is developed.

`nlights_core.movement.moves` says which photograph was touched, by the fewest that explain what is seen.  Here
all may have moved, each in its own way, by a part of a pixel.  All are fitted together from coarse details to fine
ones, what three numbers a place explain being left out; and all are taken out, or none.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.movement.details import LEAST, LEVELS, Detail, Surroundings, read_details
from nlights_core.movement.fine_structure import FineStructure, brought_back, fine_structure, join
from nlights_core.movement.moves import FINAL, ROUNDS, SETTLED, TILES
from nlights_core.movement.weighed_structures import Known, clearest_structures, misfit_of, weighed_structure
from nlights_core.photographs.shifted import FILE, Shift, light_at, shifts_by_lamp
from nlights_core.reduced_light.places import places, unexplained
from nlights_core.reduced_light.relative_light import FEWEST, RelativeLight, relate_samples
from nlights_core.reduced_light.samples import sample_photographs

CERTAIN = 5.0
"""How many times their standard error the shifts must be, rms over the photographs.  Sound captures reach 1 to 2.5
(gloss), paintings moved by 0.3 px have 60, varnished ones moved by 1 px 11."""

SMALLEST = 0.02
"""Shifts below this, rms over the photographs, do no harm, px."""

SAME = 0.98
"""What bringing the photographs back must leave of their disagreement in some size of details, at most."""

STILL = 3.0
"""Standard errors within which photographs are taken to lie on each other."""

STARTED = 6
"""Tiles of a size of details from which on it has a say alone."""

DEGREE = 4
"""Of the polynomial that the logarithm of a lamp's light is over the field: it leaves 0.1 % or less."""

HALF = 0.5
"""Share of what a camera's movement does to the light, from which on it was the camera."""


@dataclass(frozen=True)
class Shifts:
    """Shifts of the photographs of a tile, px.

    Attributes
    ----------
    shifts : dict of Shift
        By lamp; 0 where nothing is taken out.  Against the photographs that lie on each other where
        these are more than half, else against the mean of all.
    found : float or None
        Largest shift that was measured, taken out or not; None: nothing could be measured.
    error : float or None
        Standard error of a shift in one direction.
    left : tuple of str
        Lamps whose photographs had no say, because something else is wrong with them.
    artwork : bool
        Whether it moved, and not the camera: the light stayed where it was.
    """

    shifts: dict[str, Shift]
    found: float | None
    error: float | None
    left: tuple[str, ...] = ()
    artwork: bool = False

    @property
    def believed(self) -> bool:
        """Test whether any photograph is brought back."""
        return any(any(shift[:2]) for shift in self.shifts.values())


def find_shifts(tile: Tile, lights: LightField, scratch: Path, lamps: Sequence[str]) -> Shifts:
    """Measure how far the photographs lie from each other.

    Parameters
    ----------
    tile : Tile
        With photographs of the flat.
    lights : LightField
    scratch : Path
        Folder for what must be kept decoded.
    lamps : sequence of str
        Whose photographs can be trusted otherwise.

    Raises
    ------
    TileError
        When a photograph cannot be read.
    """
    left = tuple(lamp for lamp in tile.lamps if lamp not in lamps)
    nothing = Shifts(dict.fromkeys(tile.lamps, Shift(0.0, 0.0)), None, None, left)
    if len(lamps) < FEWEST:
        return nothing
    samples = sample_photographs(tile, True, scratch)
    relative = relate_samples(samples, lamps, lights)
    details, around = read_details(tile, samples, relative, lights, scratch)
    moves, error = measure_shifts(details, around)
    if moves is None or error is None:
        return nothing
    largest = float(np.hypot(*moves.T).max())
    if _size(moves) <= max(SMALLEST, CERTAIN * error):
        return replace(nothing, found=largest, error=error)
    light = fit_light(relative)
    artwork = light_stayed(relative, moves / samples.block, light)
    kept = [tuple(map(tuple, one.tolist())) if artwork else () for one in light]
    found = {
        lamp: Shift(float(x), float(y), own) for lamp, (x, y), own in zip(lamps, moves, kept, strict=True)
    }
    return Shifts(nothing.shifts | found, largest, error, left, artwork)


def fit_light(relative: RelativeLight) -> Array:
    """Logarithm of the light of each lamp over the field, (L, 5, 5): a polynomial as of `Shift`."""
    divisors = relative.smooth_divisors
    _, rows, columns = divisors.shape
    y, x = ((2 * np.arange(count) + 1) / count - 1 for count in (rows, columns))
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    terms = np.stack([np.outer(y**i, x**j).ravel() for i, j in powers], axis=1)
    out = np.zeros((len(divisors), DEGREE + 1, DEGREE + 1))
    for found, one in zip(out, divisors, strict=True):
        known = np.isfinite(one.ravel())
        fitted = np.linalg.lstsq(terms[known], np.log(one.ravel()[known]), rcond=None)[0]
        for (i, j), value in zip(powers, fitted, strict=True):
            found[i, j] = value
    return out


def light_stayed(relative: RelativeLight, moves: Array, light: Array) -> bool:
    """Test whether the light stayed where it was, as if the artwork had moved, or moved along, as if the camera had.

    ``moves`` are in samples.  What shifts of the light would change is smooth over the field, and no gain of a lamp;
    as much of it as the photographs show, 1 or 0, tells.
    """
    back = brought_back(Detail(relative.light, 1, 0, 0), moves).images
    y, x, seen, vectors, weights = places(replace(relative, light=back))
    shape = relative.light.shape[1:]
    rows, columns = np.arange(shape[0]), np.arange(shape[1])
    changes = np.empty(seen.shape)
    for found, own, (right, down) in zip(changes, light, moves, strict=True):
        here = light_at(own, rows, columns, shape)
        found[:] = (here - light_at(own, rows + down, columns + right, shape))[y, x]
    free = unexplained(vectors, weights).astype(float)
    count = len(seen)
    # Gains, and the shift of the light: what is left of each, of what is left of the photographs.
    parts = free[:, :, :, None] * np.eye(count)[None, None] * seen.T[:, None, :, None]
    # All gains alike are no disagreement.
    gains = parts.sum(axis=2) @ (np.eye(count) - 1 / count)[:, 1:]
    change = np.einsum("nij,jn->ni", free, seen * changes)
    rest = np.einsum("nij,jn->ni", free, seen)
    size = np.maximum(seen.sum(axis=0), 1e-9)
    size = np.maximum(size, 0.1 * np.median(size))[:, None]
    columns_of = np.concatenate([gains, change[:, :, None]], axis=2) / size[..., None]
    matrix, right_side = columns_of.reshape(-1, count), (rest / size).ravel()
    trust = np.ones(len(right_side))
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(matrix * trust[:, None], right_side * trust, rcond=1e-6)[0]
        left = right_side - matrix @ found
        spread = max(1.4826 * float(np.median(np.abs(left))), 1e-12)
        trust = 1 / np.sqrt(1 + (left / (2.4 * spread)) ** 2)
    return bool(found[-1] < HALF)


def measure_shifts(details: Sequence[Detail], around: Surroundings) -> tuple[Array | None, float | None]:
    """Measure the shifts (L, 2) in details, px right and down, and their standard error; None: nothing says it."""
    levels = [list(details)]
    while len(levels) < LEVELS and min(min(one.images.shape[1:]) for one in levels[-1]) >= 2 * LEAST:
        levels.append([one.halved() for one in levels[-1]])
    moves = _followed(levels, around)
    parts: list[FineStructure] = []
    for _ in range(ROUNDS):
        parts = clearest_structures(levels, around, moves)
        structure = join(parts)
        if np.count_nonzero(structure.left() > 0) < TILES:
            return None, None
        step = _step(structure)
        moves = moves + step
        if np.abs(step).max() < FINAL:
            break
    if moves.any() and not _agree_better(levels, around, moves):
        return None, None
    quarters = [structure.part(structure.quarters == quarter) for quarter in range(4)]
    sizes = [one for one in parts if len(one.sizes) >= TILES][:2]
    errors = [
        _size(np.concatenate([_step(one) for one in some])) for some in (quarters, *([one] for one in sizes))
    ]
    error = max(errors)
    return _against_the_still(moves, error), error


def _followed(levels: Sequence[Sequence[Detail]], around: Surroundings) -> Array:
    """Shifts of all photographs, followed from coarse details to fine ones."""
    moves = np.zeros((len(around.relative.lamps), 2))
    known: Known = {}
    for level in reversed(range(len(levels))):
        for _ in range(ROUNDS):
            structure = weighed_structure(levels[level:], around, moves, known)
            if np.count_nonzero(structure.left() > 0) < STARTED:
                break
            step = _step(structure)
            moves = moves + step
            if np.abs(step).max() < SETTLED * levels[level][0].scale:
                break
    return moves


def _step(structure: FineStructure) -> Array:
    """Shifts that structures want beside, (L, 2); their mean is 0, since nobody can tell it."""
    count = structure.lamps
    if not len(structure.sizes):
        return np.full((count, 2), np.inf)
    still = np.zeros((count, 2))
    found = misfit_of(structure, still).least(range(count))[1]
    return np.asarray(found - found.mean(axis=0))


def _agree_better(levels: Sequence[Sequence[Detail]], around: Surroundings, moves: Array) -> bool:
    """Test whether the photographs agree better when they are brought back."""
    still = np.zeros_like(moves)
    return any(
        fine_structure(one, around, moves).share() < SAME * fine_structure(one, around, still).share()
        for one in levels[:3]
    )


def _size(shifts: Array) -> float:
    """Root mean square over photographs and directions."""
    return float(np.sqrt(np.mean(shifts**2)))


def _against_the_still(moves: Array, error: float) -> Array:
    """Shifts against the photographs that lie on each other, if these are more than half; else against the mean."""
    apart = np.hypot(*(moves - np.median(moves, axis=0)).T)
    still = apart < max(SMALLEST, STILL * error)
    if 2 * np.count_nonzero(still) <= len(moves):
        return moves
    return np.where(still[:, None], 0.0, moves - moves[still].mean(axis=0))


def warn_of_shifts(shifts: Shifts, tile: Tile) -> list[CaptureWarning]:
    """Say what was taken out; an empty list where nothing was."""
    if not shifts.believed:
        return []
    moved = {lamp: shift[:2] for lamp, shift in shifts.shifts.items() if any(shift[:2])}
    each = ", ".join(f"{lamp} {right:+.2f} {-down:+.2f}" for lamp, (right, down) in moved.items())
    error = f"{shifts.error:.2g} px each" if shifts.error else "px"
    who = "artwork" if shifts.artwork else "camera"
    sentence = (
        f"the photographs do not lie on each other; their shifts were taken out (lamp, dx, dy in px; x right, y up; "
        f"+- {error}): {each}. The {who} was touched: fix it before the next capture"
    )
    largest = max(float(np.hypot(*pair)) for pair in moved.values())
    return [
        CaptureWarning(
            "moved", f"{tile.artwork}/{tile.name}: {sentence}", tuple(moved), round(largest, 2), "px"
        )
    ]


def write_shifts(folder: Path, shifts: Shifts) -> None:
    """Write ``shifts.json``."""
    (folder / FILE).write_text(json.dumps(asdict(shifts), indent=1) + "\n", encoding="utf-8")


def read_shifts(folder: Path) -> Shifts:
    """Read what `write_shifts` wrote."""
    record = json.loads((folder / FILE).read_text(encoding="utf-8"))
    return Shifts(
        shifts_by_lamp(folder), record["found"], record["error"], tuple(record["left"]), record["artwork"]
    )
