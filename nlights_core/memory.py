"""Memory: what a step needs against what it may take, said before it starts."""

from __future__ import annotations

import os
import re

from nlights_core.errors import TileError
from nlights_core.machine.band_threads import cores

GIB = 1 << 30
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": GIB, "T": 1 << 40}

VARIABLE = "NLIGHTS_MEMORY"
"""Environment variable that sets the budget, so that processes started for a run keep to it too."""


ANY_TILE = 256 << 20
"""What Python, its libraries and the smallest bands take, bytes, however small a tile is."""


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
    """What may be used, bytes: the variable `VARIABLE`, or else half of the machine's memory."""
    said = os.environ.get(VARIABLE)
    if said:
        return parse_size(said)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def band_memory() -> int:
    """What one core's band of rows may take, bytes, so that those of all cores take an eighth of the budget."""
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
    allowed = budget()
    if need > allowed:
        whose = "--memory allows" if os.environ.get(VARIABLE) else "half of this machine's memory is"
        raise TileError(
            f"{what}: needs {_said(need)} of memory, but {whose} {_said(allowed)}; allow more with "
            "--memory, choose an integrator that needs less, or use a larger machine"
        )


def _said(size: int) -> str:
    return f"{size / GIB:.1f} GiB" if size >= GIB / 10 else f"{size / (1 << 20):.1f} MiB"
