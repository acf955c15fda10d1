"""Ranges of numbers: where a sensor's end seems to be another than the capture says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.photographs.development import Darkroom
from nlights_core.photographs.images import Photograph

ROWS = 64
"""Rows of a photograph that are looked at, evenly spread."""

COLUMNS = 4000
"""Columns of it, about, at the most."""

CLIPPED = 1e-3
"""Share of the pixels that hold the very same largest number before it is told."""

CROWD = 10
"""By how much more pixels hold that number than each of those below it: light thins out towards its brightest
number, so without an end of the range fewer pixels hold the largest than the one below it."""

BELOW = 16
"""Numbers below the largest that are compared with it."""

VARIED = 64
"""Different numbers that a channel holds at the least: fewer are no photograph of light."""

BEYOND = 1e-3
"""Share of a float file's pixels above saturation, of many different numbers, before the range is doubted."""

NEGATIVE = -0.01
"""Light below this is no noise about a subtracted offset."""


@dataclass
class _Seen:
    """A number of one photograph: the one that many pixels share, or the farthest beyond the range."""

    code: str
    number: float
    share: float


def range_warnings(room: Darkroom) -> list[CaptureWarning]:
    """Warn where the numbers of photographs seem to end elsewhere than at the saturation level.

    Parameters
    ----------
    room : Darkroom
        The open photographs; `ROWS` rows of each are read.

    Returns
    -------
    list of CaptureWarning
        Code ``clipped``: many pixels hold the very same largest number, below the level.  Code ``range``:
        that number is the largest of fewer bits, as 12 in 16, or a float file holds numbers above the
        level, or negative ones.  The value is the number.

    Raises
    ------
    TileError
        When a photograph cannot be read.
    """
    lamps = list(room.photographs)
    seen = list(in_order(_seen_in, [room.photographs[lamp] for lamp in lamps]))
    groups: dict[tuple[str, float], list[tuple[str, _Seen]]] = {}
    for lamp, found in zip(lamps, seen, strict=True):
        for one in found:
            # Numbers above the range, and below 0, differ from one photograph to the next.
            shared = one.number if one.share > 0 else np.sign(one.number)
            groups.setdefault((one.code, shared), []).append((lamp, one))
    return [_warning(room, members) for members in groups.values()]


def _seen_in(photograph: Photograph) -> list[_Seen]:
    """Look at one photograph."""
    numbers, level = _sample(photograph), photograph.info.saturation
    found = []
    if photograph.info.dtype.kind == "f":
        found += _beyond(numbers, level)
    if np.isfinite(level) and not found:
        found += _clipped(numbers, level)
    return found


def _sample(photograph: Photograph) -> Array:
    """Numbers of some rows of a photograph as its file has them, (n, C)."""
    rows, columns, channels = photograph.stored_shape
    count = min(ROWS, rows)
    # Odd, so that every colour of a mosaic is among them.
    step = columns // COLUMNS // 2 * 2 + 1
    line = np.empty((1, columns, channels), photograph.info.dtype)
    out = []
    for row in np.linspace(0, rows - 1, count).astype(int):
        photograph.numbers(int(row), int(row) + 1, line)
        out.append(line[0, ::step].copy())
    return np.concatenate(out)


def _clipped(numbers: Array, level: float) -> list[_Seen]:
    """The number at which most pixels of a channel are crowded together, below the level."""
    found: list[_Seen] = []
    for channel in range(numbers.shape[1]):
        values, counts = _counted(numbers[:, channel])
        share = counts[-1] / len(numbers)
        if values[-1] >= level or share < CLIPPED or len(values) < VARIED:
            continue
        if counts[-1] > CROWD * counts[-1 - BELOW : -1].max():
            number = float(values[-1])
            found.append(_Seen("range" if _is_whole_range(number) else "clipped", number, float(share)))
    return sorted(found, key=lambda one: -one.share)[:1]


def _counted(numbers: Array) -> tuple[Array, Array]:
    """Numbers that occur, from the smallest, and how often."""
    if numbers.dtype.kind == "u" and numbers.dtype.itemsize <= 2:
        counts = np.bincount(numbers)
        values = np.flatnonzero(counts)
        return values, counts[values]
    return np.unique(numbers, return_counts=True)


def _is_whole_range(number: float) -> bool:
    """Test whether a number is the largest of 8 to 15 bits."""
    return number.is_integer() and number >= 255 and not int(number) & (int(number) + 1)


def _beyond(numbers: Array, level: float) -> list[_Seen]:
    """Numbers of a float file above the level, or below 0 by more than noise."""
    found = []
    highest, lowest = float(numbers.max()), float(numbers.min())
    above = numbers[numbers > level]
    if above.size > BEYOND * numbers.size and len(np.unique(above[:: max(1, above.size // 10_000)])) > BELOW:
        found.append(_Seen("range", highest, 0.0))
    unit = level if np.isfinite(level) else highest
    if np.count_nonzero(numbers < NEGATIVE * unit) > BEYOND * numbers.size:
        found.append(_Seen("range", lowest, 0.0))
    return found


def _warning(room: Darkroom, members: Sequence[tuple[str, _Seen]]) -> CaptureWarning:
    """Warning about photographs in which the same is seen."""
    lamp, worst = max(members, key=lambda member: (member[1].share, abs(member[1].number)))
    lamps = tuple(lamp for lamp, _ in members)
    kind, level = room.info.dtype, room.info.saturation
    if worst.share > 0:
        said = (
            f"{worst.share:.1%} of the pixels hold the very same largest number, {worst.number:.10g}, below the "
            f"saturation level of {level:.10g}: the numbers seem to end there, and nothing is counted as saturated"
        )
        if worst.code == "range":
            said += f" (numbers of {int(worst.number).bit_length()} bits in files of {8 * kind.itemsize})"
        remedy = f"state encoding: {{saturation: {worst.number:.10g}}} in the manifest"
    elif worst.number < 0:
        said = f"its numbers go down to {worst.number:.4g}, and light is not negative"
        remedy = (
            "export it without subtracting or stretching, and check encoding.saturation and encoding.transfer"
        )
    else:
        said = f"its numbers go up to {worst.number:.6g}, above {level:.6g}, from which on they count as saturated"
        remedy = "state the number at which the sensor saturates in encoding.saturation (none: nothing is saturated)"
    others = f" (so {len(lamps) - 1} lamps more)" if len(lamps) > 1 else ""
    return CaptureWarning(
        worst.code,
        f"{room.paths[lamp].name}: {room.subject}.{lamp}{others}: {said}; {remedy}",
        lamps,
        worst.number,
    )
