"""Compiled loops of the integration: what slopes ask of the height, its waves, its weighted steps.

Import this only where it is used: Numba takes half a second.  Every loop writes each of its
results once and in the same order, so that they are the same with any number of threads.
"""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

Float = np.float32
"""Single precision: constants of double precision would make it that."""


HALO = 3
"""Rows beyond a band that its steps depend on."""

STRIP = 32
"""Waves that are solved together: two cache lines of a row of single precision."""

_ROWS = 2 * HALO + 1
"""Rows of slopes that are kept: as many as the steps above and below one row depend on."""


@inner
def _slopes(
    normals: Array,
    x: Array,
    lean: Float,
    pixel: Float,
    limit: Float,
    tilt: Array,
    across: Array,
    down: Array,
    facing: Array,
) -> int:
    """Steps of one row of normals, less the plane's, NaN where unknown; how many are unknown.

    As `nlights_core.integration.sight_lines.seen_gradient` gives them.  All is float32.
    """
    # Loops as plain as these become vector instructions; one that counts as well does not.
    for j in range(x.size):
        facing[j] = normals[j, 2] - normals[j, 0] * x[j] - normals[j, 1] * lean
        scale = pixel / facing[j]
        across[j] = -normals[j, 0] * scale - tilt[0]
        down[j] = normals[j, 1] * scale - tilt[1]
    one = np.float32(1)
    too_steep = np.int32(0)
    for j in range(x.size):
        squared_sine = one + x[j] * x[j] + lean * lean - facing[j] * facing[j]
        # So asked that NaN, of which every comparison is false, is too steep as well.
        too_steep += np.int32(not facing[j] * abs(facing[j]) > squared_sine * limit)
    unknown = 0
    if too_steep > 0:
        for j in range(x.size):
            if facing[j] > 0:
                squared_sine = one + x[j] * x[j] + lean * lean - facing[j] * facing[j]
                scale = pixel / max(facing[j], np.sqrt(max(squared_sine * limit, np.float32(0))))
            else:
                scale = np.float32(np.nan)
                unknown += 1
            across[j] = -normals[j, 0] * scale - tilt[0]
            down[j] = normals[j, 1] * scale - tilt[1]
    return unknown


@inner
def _step(a: Float, b: Float, c: Float, d: Float, e: Float, f: Float, six: bool) -> Float:
    """The step from c to d by the formulas of `nlights_core.integration.poisson.height_steps`; 0 if unknown."""
    # A sum with NaN is NaN: so each formula tells by itself whether all of its pixels are known.
    step = np.float32(0.5) * (c + d)
    if step != step:
        return np.float32(0)
    if six:
        wide = (802 * (c + d) - 93 * (b + e) + 11 * (a + f)) / 1440
        if wide != wide:
            wide = (13 * (c + d) - (b + e)) / 24
        if wide != wide:
            wide = (9 * c + 19 * d - 5 * e + f) / 24
        if wide != wide:
            wide = (9 * d + 19 * c - 5 * b + a) / 24
        if wide == wide:
            step = np.float32(wide)
    return step


@inner
def _steps(
    a: Array, b: Array, c: Array, d: Array, e: Array, f: Array, known: bool, six: bool, out: Array
) -> None:
    """Steps from c to d, pixel by pixel, out of six rows; ``known``: all of them are."""
    if known and six:
        outer, inner, middle = np.float32(11 / 1440), np.float32(-93 / 1440), np.float32(802 / 1440)
        for j in range(out.size):
            out[j] = middle * (c[j] + d[j]) + inner * (b[j] + e[j]) + outer * (a[j] + f[j])
    else:
        for j in range(out.size):
            out[j] = _step(a[j], b[j], c[j], d[j], e[j], f[j], six)


@inner
def _steps_along(slope: Array, known: bool, six: bool, out: Array) -> None:
    """Steps along a row whose slopes have margins of NaN, `HALO` wide."""
    n = out.size
    # The outermost two steps reach into the margins, which are not known.
    for first, last, inside in ((0, 2, False), (2, n - 2, known), (max(n - 2, 2), n, False)):
        s = slope[first + 1 : last + HALO + 3]
        m = max(min(last, n) - first, 0)
        _steps(
            s[:m],
            s[1 : m + 1],
            s[2 : m + 2],
            s[3 : m + 3],
            s[4 : m + 4],
            s[5 : m + 5],
            inside,
            six,
            out[first : first + m],
        )


@kernel
def divergence(
    normals: Array,
    first: int,
    x: Array,
    y: Array,
    pixel: Float,
    limit: Float,
    tilt: Array,
    six: bool,
    out: Array,
) -> int:
    """Laplacian of the height that the normals of a band of rows ask for; how many are unknown.

    ``normals`` (H, W, 3) is the whole field, ``out`` (h, W) its rows from ``first`` on; ``x`` (W,)
    and ``y`` (H,) say how far the rays lean, ``limit`` is 1 / tan^2 of the greatest angle to the
    ray, the two of ``tilt`` are taken off every step.  All is float32.
    """
    rows, columns = normals.shape[:2]
    nothing = np.float32(np.nan)
    # Margins of NaN: beyond the border nothing is known.
    # Rings of rows: row i of the field is in slot i % _ROWS, until the row `_ROWS` further takes its place.
    across = np.full((_ROWS, columns + 2 * HALO), nothing, np.float32)
    down = np.full((_ROWS, columns), nothing, np.float32)
    known = np.zeros(_ROWS, np.bool_)
    facing = np.empty(columns, np.float32)
    # Two of the steps of a row are those across the border: 0.
    step = np.zeros(columns + 1, np.float32)
    above, below = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    unknown = 0
    for i in range(first - HALO, first + len(out) + HALO):
        last = i % _ROWS
        known[last] = False
        down[last] = nothing
        if 0 <= i < rows:
            along = across[last, HALO : HALO + columns]
            lost = _slopes(normals[i], x, y[i], pixel, limit, tilt, along, down[last], facing)
            known[last] = lost == 0
            if first <= i < first + len(out):
                unknown += lost
        # Now all is there that the step from row r to the next depends on.
        r = i - HALO
        if r < first - 1:
            continue
        # Slots of rows r - 2 to r + 2; row r + 3 is the last one.
        a, b, c, d, e = (r - 2) % _ROWS, (r - 1) % _ROWS, r % _ROWS, (r + 1) % _ROWS, (r + 2) % _ROWS
        whole = known[a] and known[b] and known[c] and known[d] and known[e] and known[last]
        _steps(down[a], down[b], down[c], down[d], down[e], down[last], whole, six, below)
        if r >= first:
            _steps_along(across[c], known[c], six, step[1:-1])
            line = out[r - first]
            for j in range(columns):
                line[j] = step[j + 1] - step[j] + (below[j] - above[j])
        # This row's step down is the next row's step from above; the other buffer is free again.
        above, below = below, above
    return unknown


@kernel
def solve_strip(spectrum: Array, eigenvalues: Array, first: int) -> None:
    """Solve, for `STRIP` waves along the rows, what is left of the Poisson equation down the columns.

    ``spectrum`` (H, W) holds the amplitude of wave k in column k, and in the end the solution's.
    Column k obeys ``z[i-1] - 2 z[i] + z[i+1] - eigenvalues[k] z[i] = f[i]`` with free ends: a
    tridiagonal system, solved by elimination in double precision.  Where the eigenvalue is 0 the
    last of z is 0.
    """
    rows = spectrum.shape[0]
    width = min(STRIP, spectrum.shape[1] - first)
    # Of each row and wave: eliminated right-hand side, and one over the pivot.
    height = np.empty((rows, STRIP))
    factor = np.empty((rows, STRIP))
    # Of the row before: one over the pivot, and the eliminated right-hand side, on the way back the solution.
    before, found = np.zeros(STRIP), np.zeros(STRIP)
    # Pivots converge: from this row on they are the same to the last bit, but for the last row's.
    settled = rows
    for i in range(rows):
        line = spectrum[i, first : first + width]
        # Neighbours of the row: one at either border, where the ends are free.
        own = 1.0 * (i > 0) + 1.0 * (i < rows - 1)
        if i <= settled or i == rows - 1:
            change = 0.0
            for k in range(width):
                diagonal = -own - eigenvalues[first + k] - before[k]
                # Only the last pivot of the constant wave is 0: its height is free, and becomes 0.
                value = 1 / diagonal if diagonal != 0 else 0.0
                change = max(change, abs(value - before[k]))
                before[k] = value
                factor[i, k] = value
            if change == 0 and settled == rows:
                settled = i
        for k in range(width):
            found[k] = (line[k] - found[k]) * before[k]
            height[i, k] = found[k]
    for k in range(width):
        spectrum[rows - 1, first + k] = found[k]
    for i in range(rows - 2, -1, -1):
        line = spectrum[i, first : first + width]
        ratio = factor[min(i, settled)]
        for k in range(width):
            found[k] = height[i, k] - ratio[k] * found[k]
            line[k] = found[k]


@inner
def _excess(height: Array, across: Array, down: Array, i: int, step: Array, line: Array) -> None:
    """Row i of `nlights_core.integration.multigrid.weighted_laplacian`; ``step`` (W + 1,) begins and ends with 0."""
    rows, columns = height.shape
    own, weight = height[i], across[i]
    for j in range(columns - 1):
        step[j + 1] = (own[j + 1] - own[j]) * weight[j]
    for j in range(columns):
        line[j] = step[j] - step[j + 1]
    # Each step counts for its two pixels with the same rounding, so that the sum stays 0.
    if i > 0:
        other, weight = height[i - 1], down[i - 1]
        for j in range(columns):
            line[j] += (own[j] - other[j]) * weight[j]
    if i < rows - 1:
        other, weight = height[i + 1], down[i]
        for j in range(columns):
            line[j] -= (other[j] - own[j]) * weight[j]


@kernel
def subtract_laplacian_rows(
    residual: Array, length: float, height: Array, across: Array, down: Array, first: int, out: Array
) -> None:
    """Rows of a residual, from ``first`` on, less ``length`` times the weighted Laplacian of a height."""
    columns = height.shape[1]
    step, line = np.zeros(columns + 1), np.empty(columns)
    for i in range(len(out)):
        _excess(height, across, down, first + i, step, line)
        for j in range(columns):
            out[i, j] = residual[i, j] - length * line[j]


@kernel
def laplacian_product_of_rows(
    other: Array, height: Array, across: Array, down: Array, first: int, last: int
) -> float:
    """Sum of ``other`` times the weighted Laplacian of a height, over rows ``first`` to ``last``."""
    columns = height.shape[1]
    step, line = np.zeros(columns + 1), np.empty(columns)
    total = 0.0
    for i in range(first, last):
        _excess(height, across, down, i, step, line)
        for j in range(columns):
            total += other[i, j] * line[j]
    return total
