"""Height straight from normals that all count the same, band by band, so that little is held at once."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.cost import announce
from nlights_core.integration.masked_integration import solve_masked
from nlights_core.integration.masked_poisson import MOST_ITERATIONS
from nlights_core.integration.poisson import (
    BAND,
    Stencil,
    add_divergence,
    mean_steps,
    row_slices,
    solve_poisson,
)
from nlights_core.integration.sight_lines import ALL, facing_rays, ray_slopes, seen_gradient, seen_surface
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import available, read_only

HALO = 3
"""Rows beyond a band that its steps depend on."""

PLAIN, MASKED = 12, 24
"""Bytes a pixel that integration takes at the most where all normals are known, and where not."""

SAMPLE = 1_000_000
"""Pixels, about, from which means and medians are taken: on evenly spread rows."""


def least_squares_height(
    normals: Array, grid: PixelGrid, *, stencil: Stencil = "6-point", steepest_deg: float = 70.0
) -> Array:
    """The height whose steps from pixel to pixel are closest to the normals', all counting the same.

    As `nlights_core.integration.poisson.simchony` where all normals are known, else as
    `nlights_core.integration.masked_integration.masked_least_squares`, in single precision.

    Parameters
    ----------
    normals : (H, W, 3) float32 array
        Unit vectors in the plane frame, NaN where not known.  They are read in bands, so that a
        memory map stays one.
    grid : PixelGrid
        With a camera its rays are followed.
    stencil : {"6-point", "trapezoid"}
        See `nlights_core.integration.poisson.height_steps`.
    steepest_deg : float
        Slopes are limited to this angle to the ray, degrees.

    Returns
    -------
    (H, W) float32 array
        z in the grid's unit, mean 0 on each island of known pixels; NaN where not known.

    Raises
    ------
    TileError
        When unknown parts of the field make it need more memory than there is.
    """
    tilt = sampled_tilt(normals, grid, steepest_deg)
    height, unknown = _divergence(normals, grid, stencil, steepest_deg, tilt)
    if unknown == 0:
        height = solve_poisson(height, overwrite=True)
    elif unknown == height.size:
        return np.full(grid.shape, np.nan, np.float32)
    else:
        announce("a field with unknown parts", height.size, MASKED, MOST_ITERATIONS, 0)
        known = np.empty(grid.shape, bool)
        for lines in row_slices(grid.rows):
            known[lines] = np.isfinite(facing_rays(normals[lines], grid, lines))
        height = solve_masked(height, known)
        height[~known] = np.nan
    seen_surface(height, tilt, None if grid.camera is None else grid.camera[2])
    return height


def sample_rows(grid: PixelGrid) -> slice:
    """Evenly spread rows of about `SAMPLE` pixels."""
    return slice(0, grid.rows, -(-grid.rows * grid.columns // SAMPLE))


def sampled_tilt(normals: Array, grid: PixelGrid, steepest_deg: float) -> tuple[float, float]:
    """Mean steps per column and per row of `sample_rows`, 0 where nothing is known there.

    The plane of them is integrated apart, and any plane near the mean serves for that.
    """
    rows = sample_rows(grid)
    some = normals[rows]
    facing = facing_rays(some, grid, rows)
    if not np.isfinite(facing).any():
        return 0.0, 0.0
    return mean_steps(*seen_gradient(some, facing, grid, steepest_deg, rows))


def _divergence(
    normals: Array, grid: PixelGrid, stencil: Stencil, steepest_deg: float, tilt: tuple[float, float]
) -> tuple[Array, int]:
    """Right-hand side of the Poisson equation, float32, and how many normals are unknown."""
    source = np.empty(grid.shape, np.float32)

    def by_formulas(lines: slice) -> int:
        around = slice(max(lines.start - HALO, 0), min(lines.stop + HALO, grid.rows))
        facing = facing_rays(normals[around], grid, around)
        across, down = seen_gradient(normals[around], facing, grid, steepest_deg, around)
        share = np.zeros_like(facing)
        add_divergence(share.T, down.T, stencil, tilt[1])
        own = slice(lines.start - around.start, lines.stop - around.start)
        add_divergence(share[own], across[own], stencil, tilt[0])
        source[lines] = share[own]
        return int(np.isnan(facing[own]).sum())

    if not available():
        return source, sum(in_order(by_formulas, row_slices(grid.rows)))
    from nlights_core.integration import compiled_integration

    x, y = ray_slopes(grid, ALL, np.float32)
    limit = np.float32(1 / np.tan(np.radians(steepest_deg)) ** 2)
    size, plane = np.float32(grid.pixel_size), np.array(tilt, np.float32)
    # A memory map is none to Numba, but its plain view is.
    field = read_only(np.ascontiguousarray(normals, np.float32))

    def by_loops(lines: slice) -> int:
        return compiled_integration.divergence(
            field, lines.start, x, y.ravel(), size, limit, plane, stencil == "6-point", source[lines]
        )

    return source, sum(in_order(by_loops, row_slices(grid.rows, 2 * BAND)))
