"""Memory: what a step needs against what it may take, said before it starts."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager

from nlights_core.errors import TileError
from nlights_core.machine.band_threads import cores
from nlights_core.machine.containers import memory_limit

GIB = 1 << 30
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": GIB, "T": 1 << 40}

VARIABLE = "NLIGHTS_MEMORY"
"""Environment variable that sets the budget where nothing else does, as ``6GiB``."""

ANY_TILE = 256 << 20
"""What Python, its libraries and the smallest bands take, bytes, however small a tile is."""

ASSUMED = 8 * GIB
"""Memory of a machine that does not say how much it has (Windows)."""

_allowed: int | None = None


def parse_size(text: str) -> int:
    """A size in bytes, as people write it.

    Raises
    ------
    ValueError
        Naming what was found and what is allowed.

    Examples
    --------
    >>> parse_size("6GiB") == parse_size("6 G") == 6 * 1024**3
    True
    """
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([KMGT]?)(?:i?B)?\s*", text, re.IGNORECASE)
    size = int(float(match[1]) * UNITS[match[2].upper()]) if match else 0
    if size < 1 << 20:
        raise ValueError(
            f"'{text}' is no amount of memory; write for instance 6GiB or 800MiB (1 MiB at least)"
        )
    return size


def budget() -> int:
    """Memory that a tile may take, bytes: what is `allowed`, or `VARIABLE`, or half of the machine's memory."""
    if _allowed is not None:
        return _allowed
    said = os.environ.get(VARIABLE)
    return parse_size(said) if said else machine_memory() // 2


@contextmanager
def allowed(size: int | None) -> Iterator[None]:
    """Set the budget of this process while the block lasts.

    Parameters
    ----------
    size : int or None
        Bytes; None leaves it as it is.
    """
    global _allowed
    before = _allowed
    _allowed = before if size is None else size
    try:
        yield
    finally:
        _allowed = before


def machine_memory() -> int:
    """Memory of this machine, bytes, or of the container in which this process runs."""
    pages = os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    whole = os.sysconf("SC_PAGE_SIZE") * pages if pages > 0 else ASSUMED
    return min(whole, memory_limit() or whole)


def band_memory() -> int:
    """Memory for one core's band of rows, bytes, so that those of all cores take an eighth of the budget."""
    return budget() // (8 * (cores() + 1))


def require(need: int, what: str) -> None:
    """Refuse a step that does not fit the budget.

    Parameters
    ----------
    need : int
        Bytes.
    what : str
        Who needs them, for the sentence.

    Raises
    ------
    TileError
        With need, budget and remedy.
    """
    most = budget()
    if need > most:
        raise TileError(
            f"{what}: needs {_said(need)} of memory, but {_whose_budget()} {_said(most)}; allow more with "
            "--memory, choose an integrator that needs less, or use a larger machine"
        )


def _whose_budget() -> str:
    if _allowed is not None:
        return "--memory allows"
    if os.environ.get(VARIABLE):
        return f"{VARIABLE} allows"
    return f"half of this {'container' if memory_limit() else 'machine'}'s memory is"


def _said(size: int) -> str:
    return f"{size / GIB:.1f} GiB" if size >= GIB / 10 else f"{size / (1 << 20):.1f} MiB"
