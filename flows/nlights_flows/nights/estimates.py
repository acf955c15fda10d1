"""Estimates of what a tile will take: seconds, by what earlier tiles took, and bytes on the disks."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from time import monotonic

import numpy as np

from nlights_core.errors import CaptureError, TileError

SECONDS = (15.0, 1.1)
"""Seconds of a tile, and per megapixel, before any was timed: above every figure of docs/performance.md
(measured on 2 cores)."""

UNCHANGED_SECONDS = 1.0
"""What a tile takes of which the store has everything (docs/performance.md: 0.6 to 0.7 s)."""

TRUST = 0.5
"""What `SECONDS` counts beside a tile that was timed."""

TIMED = 5
"""So many tiles must have been timed before their scatter is believed."""

STORE_BYTES = (30e6, 130.0)
"""Bytes in the store of a tile, and per pixel, default recipe, 8 lamps in colour.  Measured: 16 MB at 0.03
megapixels and 761 MB at 6 megapixels, products included, of which 93 per pixel are products."""

PRODUCT_BYTES = (10e6, 97.0)
"""Bytes of the products of a tile, and per pixel: from the same runs.  They are hard links into the store and
take no place of their own, unless they are on another disk."""


@dataclass(frozen=True)
class Estimate:
    """Seconds of a tile by its size: ``constant + slope * megapixels``."""

    constant: float
    slope: float

    def seconds(self, megapixels: float) -> float:
        """Seconds that a tile will take."""
        return self.constant + self.slope * megapixels


def learn_estimate(timed: Sequence[tuple[float, float]]) -> Estimate:
    """Learn from tiles how long one takes.

    Parameters
    ----------
    timed : sequence of (float, float)
        Megapixels and seconds of tiles that were made.

    Returns
    -------
    Estimate
        Least squares of the relative errors, with two tiles that take what `SECONDS` says among
        them, so that the first few tiles do not mean too much.  From `TIMED` tiles on it is raised
        until nine tiles in ten take no longer.

    Examples
    --------
    >>> learn_estimate([]) == Estimate(*SECONDS)
    True
    """
    from scipy.optimize import nnls

    assumed = [(size, SECONDS[0] + SECONDS[1] * size) for size in (1.0, 100.0)]
    size, seconds = np.array([*assumed, *timed], float).T
    seconds = np.maximum(seconds, 1e-3)
    trust = np.ones(len(size))
    trust[: len(assumed)] = TRUST
    rows = np.stack([trust / seconds, trust * size / seconds], axis=1)
    (constant, slope), _ = nnls(rows, trust)
    if len(timed) >= TIMED:
        own = slice(len(assumed), None)
        late = np.quantile(seconds[own] / (constant + slope * size[own]), 0.9)
        constant, slope = constant * max(late, 1.0), slope * max(late, 1.0)
    return Estimate(round(float(constant), 6), round(float(slope), 6))


@dataclass(frozen=True)
class Deadline:
    """Time when a night must be over; it is counted by a clock that nobody sets.

    Attributes
    ----------
    at : datetime or None
        For people.  None: never.
    ends : float
        By `time.monotonic`.
    """

    at: datetime | None
    ends: float

    @classmethod
    def of(cls, until: str | None, now: datetime | None = None) -> Deadline:
        """Find the next time of the day that ``until`` names.

        Raises
        ------
        CaptureError
            When it is no time of the day.

        Examples
        --------
        >>> Deadline.of("06:30", datetime(2026, 3, 2, 22, 0)).at.strftime("%d %H:%M")
        '03 06:30'
        """
        if not until:
            return cls(None, float("inf"))
        try:
            clock = datetime.strptime(until, "%H:%M").time()
        except ValueError:
            raise CaptureError(f"--until: '{until}' is no time of the day; write it as 06:30") from None
        now = (now or datetime.now()).astimezone()
        day = now.date()
        at = datetime.combine(day, clock).astimezone()
        if at <= now:
            # The next day's, not 24 hours later: clocks may be changed for summer in between.
            at = datetime.combine(day + timedelta(days=1), clock).astimezone()
        return cls(at, monotonic() + (at - now).total_seconds())

    @property
    def left(self) -> float:
        """Seconds until then."""
        return self.ends - monotonic()


def require_disk(pixels: int, store: Path, out: Path, where: str) -> None:
    """Refuse a tile for which there is no room.

    Raises
    ------
    TileError
        With need, room and remedy.
    """
    needs = {store: (STORE_BYTES, "--store")}
    if store.stat().st_dev != out.stat().st_dev:
        needs[out] = (PRODUCT_BYTES, "--out")
    for folder, ((constant, slope), option) in needs.items():
        need, free = constant + slope * pixels, shutil.disk_usage(folder).free
        if need > free:
            raise TileError(
                f"{where}: needs about {format_bytes(need)} in {folder}, where {format_bytes(free)} are free; "
                f"free some space or choose another {option}; finished work is kept"
            )


def format_bytes(size: float) -> str:
    """Bytes as a person writes them.

    Examples
    --------
    >>> format_bytes(3.2e9), format_bytes(1.25e12)
    ('3.2 GB', '1.2 TB')
    """
    for unit, scale in (("TB", 1e12), ("GB", 1e9)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}"
    return f"{size / 1e6:.0f} MB"
