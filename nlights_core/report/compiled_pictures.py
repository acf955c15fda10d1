"""Compiled loops over the pixels of the pictures of a report.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel


@kernel
def levels(values: Array, low: float, high: float, span: float, out: Array) -> None:
    """Places of values (h, w) on a scale of 256 steps from ``low`` to ``high``, ``span`` apart; not known: 0."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            share = (min(max(value, low), high) - low) / span
            out[i, j] = np.uint8(share * 255 + 0.5) if abs(value) < np.inf else np.uint8(0)


@kernel
def hatched(colours: Array, known: Array, times: int, out: Array) -> None:
    """Colours (h, w, 3), each ``times`` x ``times`` pixels of ``out``, and grey stripes where not known."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            # By place in the enlarged picture, so that stripes run on from pixel to pixel.
            stripe = np.uint8(196 if (i + j) // 5 % 2 else 164)
            valid = known[i // times, j // times]
            for k in range(3):
                out[i, j, k] = colours[i // times, j // times, k] if valid else stripe
