"""Memory: what a step needs against what there is, said before it starts."""

from __future__ import annotations

import os

from nlights_core.errors import TileError

GIB = 1 << 30


def budget() -> int:
    """Half of the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


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
    if need > budget():
        raise TileError(
            f"{what}: needs {need / GIB:.1f} GiB of memory, but half of this machine's is "
            f"{budget() / GIB:.1f} GiB; choose an integrator that needs less, or a larger machine"
        )
