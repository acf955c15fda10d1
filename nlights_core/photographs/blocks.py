"""Blocks of pixels, as compiled development and compiled fits have them.

Pixels are taken in blocks of `BLOCK`.  The loop over the lights is outside and the loop over the
pixels of a block inside, so that the compiler makes vector instructions of it, and all that a
block needs stays in the processor's cache.  A block is a row of numbers (float32), in which each
quantity has its place, `BLOCK` numbers long; the constants below are where the places begin.  A
pixel's result does not depend on the block that it is in.

Import this module only from compiled ones: it needs numba.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import decorators

BLOCK = 128
"""Pixels of a block."""

# Of a sample, in an array (L, SAMPLE):
VALUE, USABLE, TRIAL, X, Y, Z, SAMPLE = range(0, 7 * BLOCK, BLOCK)
"""Grey, 0 where not usable; weight of a usable sample; weight in the fit; light; size of them all."""

TINY = np.float32(np.finfo(np.float32).tiny)
ZERO, ONE = np.float32(0), np.float32(1)


# A product and a sum may be rounded once instead of twice (`contract`); nothing else that changes a result is
# allowed, least of all a guess about NaN.  What is compiled makes no arrays, and so needs not count who uses them
# (`_nrt`): that counting took half of the time.
kernel, inner = decorators(fastmath={"contract"}, _nrt=False)
"""Decorators of loops over blocks."""


@inner
def copy(source: Array, target: Array) -> None:
    """Copy one row of numbers to another; an assignment of slices would make an array in between."""
    for p in range(len(target)):
        target[p] = source[p]
