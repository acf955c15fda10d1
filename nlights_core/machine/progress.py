"""Progress: how long work tells how far it is, and what it says of itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[float], None]
"""Called with the share done, from 0 to 1."""

Listener = Callable[[str], None]
"""Called with a sentence."""

_progress: ContextVar[Progress] = ContextVar("_progress", default=lambda share: None)
_listener: ContextVar[Listener] = ContextVar("_listener", default=lambda sentence: None)


def tell(share: float) -> None:
    """Tell whoever waits which share of the work at hand is done, from 0 to 1.

    For what is called without a `Progress`, such as the verb of an algorithm.
    """
    _progress.get()(min(max(share, 0.0), 1.0))


@contextmanager
def telling(progress: Progress, first: float = 0.0, last: float = 1.0) -> Iterator[None]:
    """Hear what `tell` says while the block lasts, as going from ``first`` to ``last``."""
    before = _progress.set(lambda share: progress(first + share * (last - first)))
    try:
        yield
    finally:
        _progress.reset(before)


@contextmanager
def part(first: float, last: float) -> Iterator[None]:
    """Make what `tell` says while the block lasts a part of the work around it.

    Examples
    --------
    >>> with telling(print), part(0.5, 0.75):
    ...     tell(0.5)
    0.625
    """
    with telling(_progress.get(), first, last):
        yield


def note(sentence: str) -> None:
    """Say a sentence to whoever looks on: what is about to take long, what was given up."""
    _listener.get()(sentence)


@contextmanager
def noting(listener: Listener) -> Iterator[None]:
    """Hear what `note` says while the block lasts."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)
