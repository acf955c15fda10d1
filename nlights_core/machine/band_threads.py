"""Bands worked on by all cores at once, their results in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Band = TypeVar("Band")
Result = TypeVar("Result")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(work: Callable[[Band], Result], bands: Iterable[Band]) -> Iterator[Result]:
    """Work on bands in threads, one a core, and give the results in the order of the bands.

    At most one result a core waits to be taken, so that memory stays bounded.  It helps where the
    work leaves Python's lock alone: compiled loops, NumPy, compression.

    Parameters
    ----------
    work : callable
        Called with each band, in any thread.
    bands : iterable
        What to work on.

    Yields
    ------
    object
        What ``work`` returned.

    Raises
    ------
    Exception
        Whatever ``work`` raises, when the result is due.

    Examples
    --------
    >>> list(in_order(abs, [-3, 2, -1]))
    [3, 2, 1]
    """
    waiting: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(cores())
    try:
        for band in bands:
            waiting.append(pool.submit(work, band))
            if len(waiting) > cores():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
