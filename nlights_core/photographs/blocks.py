"""Blocks of pixels, as compiled development and compiled fits have them.

Pixels are taken in blocks of `BLOCK`.  The loop over the lights is outside and the loop over the
pixels of a block inside, so that the compiler makes vector instructions of it, and all that a
block needs stays in the processor's cache.  A block is a row of numbers (float32), in which each
quantity has its place, `BLOCK` numbers long; the constants below are where the places begin.  A
pixel's result does not depend on the block that it is in.

Import this module only from compiled ones: it needs numba.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import compiling

BLOCK = 128
"""Pixels of a block."""

# Of a sample, in an array (L, SAMPLE):
VALUE, USABLE, TRIAL, X, Y, Z, SAMPLE = range(0, 7 * BLOCK, BLOCK)
"""Grey, 0 where not usable; weight of a usable sample; weight in the fit; light; size of them all."""

TINY = np.float32(np.finfo(np.float32).tiny)
ZERO, ONE = np.float32(0), np.float32(1)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function when it is first called; kept on disk for the next process.

    A product and a sum may be rounded once instead of twice (`contract`); nothing else that changes
    a result is allowed, least of all a guess about NaN.  What is compiled makes no arrays, and so
    needs not count who uses them (`_nrt`): that counting took half of the time.
    """
    # numba goes by the date of a function's own file, but what is compiled holds code and constants
    # of others too.  Where the folder cannot be written, numba takes the user's cache.
    settings: Any = numba.config
    chosen = settings.CACHE_DIR
    settings.CACHE_DIR = str(Path(chosen or Path(__file__).parent / "__pycache__") / f"kernels-{_SOURCES}")
    try:
        made: Callable[..., Any] = compiling(fastmath={"contract"}, _nrt=False)(function)
    finally:
        settings.CACHE_DIR = chosen
    return made


def _digest() -> str:
    """Of all that compiled code is made from."""
    core = Path(__file__).parents[1]
    files = [
        core / "algorithms.py",
        *sorted((core / "photographs").glob("*.py")),
        *sorted((core / "solving").glob("*.py")),
    ]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


_SOURCES = _digest()


@compiled
def copy(source: Array, target: Array) -> None:
    """Copy one row of numbers to another; an assignment of slices would make an array in between."""
    for p in range(len(target)):
        target[p] = source[p]
