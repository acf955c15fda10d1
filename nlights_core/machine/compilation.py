"""Messages about compiling while it goes on: it takes half a minute, once per machine.

Apart from `nlights_core.machine.compiling`, since whoever wants to be told must not import numba.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

Told = Callable[["Compilation"], None]


@dataclass
class Compilation:
    """Record of what this process has compiled so far.

    Attributes
    ----------
    names : list of str
        Loops that were not found compiled.
    lost : Path or None
        The folder that could not be written, so that the next process compiles them again.
    """

    names: list[str] = field(default_factory=list)
    lost: Path | None = None


_so_far = Compilation()
_listeners: list[Told] = []


def begin(name: str) -> None:
    """Tell that a loop is about to be compiled."""
    _so_far.names.append(name)
    _tell()


def not_kept(folder: Path) -> None:
    """Tell that what was compiled could not be kept."""
    _so_far.lost = folder
    _tell()


def so_far() -> Compilation:
    """Say what this process has compiled."""
    return _so_far


@contextmanager
def call_on_compiling(listener: Told) -> Iterator[None]:
    """Call a function, from any thread, whenever a loop is about to be compiled while the block lasts."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def _tell() -> None:
    for listener in list(_listeners):
        listener(_so_far)
