"""Compiled means over blocks of pixels, of maps and of photographs.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel


@kernel
def block_means(array: Array, factor: int, out: Array) -> None:
    """Means of what is known in blocks of pixels (n * factor, W, C), NaN where under half of a block is."""
    rows, width, channels = out.shape
    # Down first, along the memory: so a core adds several neighbours at once.
    # By column and channel, over the rows of a block: sum of the known values, and their number.
    total, known = np.empty(width * factor * channels), np.empty(width * factor * channels)
    for k in range(rows):
        total[:] = 0
        known[:] = 0
        for i in range(k * factor, (k + 1) * factor):
            line = array[i].reshape(-1)
            for j in range(total.size):
                value = np.float64(line[j])
                valid = abs(value) < np.inf
                total[j] += value if valid else 0.0
                known[j] += 1.0 if valid else 0.0
        for m in range(width):
            for channel in range(channels):
                mean = count = 0.0
                for j in range(m * factor, (m + 1) * factor):
                    mean += total[j * channels + channel]
                    count += known[j * channels + channel]
                out[k, m, channel] = mean / count if 2 * count >= factor * factor else np.nan


@kernel
def line_means(
    numbers: Array, block: int, scale: float, level: float, largest: float, means: Array, saturated: Array
) -> None:
    """Means of the light of some lines of a photograph, block by block.

    Parameters
    ----------
    numbers : (n, W, C) array of uint8 or uint16
        What the file holds; columns that fill no block are left out.
    block : int
        Columns of a block.
    scale, level, largest : float
        Light per number, the number at which the sensor saturates, the largest light there is.
    means : (w, C) float32 array
        Receives them.
    saturated : (w,) float32 array
        Receives the share of pixels of which any colour is saturated.
    """
    lines, count = numbers.shape[0], means.shape[0]
    sums = np.zeros(numbers.shape[2])
    for m in range(count):
        sums[:] = 0
        over = 0
        for i in range(lines):
            for j in range(m * block, (m + 1) * block):
                # The brightest colour: one saturated colour makes the pixel saturated.
                high = 0.0
                for channel in range(sums.size):
                    number = np.float64(numbers[i, j, channel])
                    sums[channel] += min(number * scale, largest)
                    high = max(high, number)
                over += high >= level
        means[m] = sums / (lines * block)
        saturated[m] = over / (lines * block)
