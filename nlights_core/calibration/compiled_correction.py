"""Compiled loop that takes out of developed blocks what is not of a matt surface under a known flat.

What `nlights_core.calibration.correction` says in numpy, a block of pixels after another.  Import this only where it
is used: Numba takes half a second.
"""

from __future__ import annotations

import numpy as np

from nlights_core.calibration.compiled_highlights import (
    FACE,
    GLANCE,
    HIDDEN,
    LENGTH,
    RAY,
    ROUGH,
    SHINE,
    VIEW,
    cross_term,
    glance,
    turn_faces,
)
from nlights_core.calibration.compiled_normals import (
    COLOURED,
    FOUND,
    PLAIN,
    POINT,
    REMOVED,
    STATE,
    UPWARD,
    Criteria,
    Gloss,
    Search,
    find_normals,
)
from nlights_core.calibration.compiled_reflectance import FACETS
from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel
from nlights_core.photographs.blocks import BLOCK, ONE, TRIAL, USABLE, VALUE, ZERO, inner
from nlights_core.photographs.strips import Blocks, Optics
from nlights_core.solving.compiled_fits import FIT

_DARKEST = np.float32(1e-12)


@kernel
def correct_blocks(
    x_of: Array,
    y_of: Array,
    heights: Array,
    optics: Optics,
    blocks: Blocks,
    reach: Array,
    gloss: Array,
    alphas: Array,
    grazing: float,
    departure: float,
    shadow: float,
    misfit: float,
    limit: float,
    rounds: int,
    removed: Array,
) -> None:
    """Subtract gloss and departure from the samples of a strip's blocks; leave out rays that miss the flat.

    Parameters
    ----------
    x_of, y_of, heights : (w,), (h,), and (h, w) or (0, 0) float32 arrays
        Of the strip, as `nlights_core.photographs.strips.Strip` has them: its numbers are of many types.
    optics : Optics
    blocks : Blocks
        All of the strip, developed; changed in place.
    reach : (2,) float64 array
        How far from the middle of the field, across and up, a ray may meet the plane, mm.
    gloss, alphas : (K,) float64 arrays
        Strength and roughness of each lobe.
    grazing : float
        See `nlights_core.calibration.reflectance.grazing`.
    departure : float
        This and all strengths 0: nothing is subtracted.
    shadow : float
        Share of the brightest sample below which one is not used to find the normal.
    misfit, limit, rounds
        As for `nlights_core.calibration.compiled_reflectance.solve_normals`.
    removed : (S, 3 BLOCK) float32 array
        Receives what was subtracted of each colour, in the sum over the lamps, as a share of what a flat white
        surface would show.
    """
    size, lamps, _ = blocks.samples.shape
    across = (len(x_of) + BLOCK - 1) // BLOCK
    lobes = np.flatnonzero(gloss)
    beyond = Gloss(
        gloss[lobes].astype(np.float32), alphas[lobes].astype(np.float32), FACETS[lobes], np.float32(grazing),
        np.float32(departure),
    )  # fmt: skip
    criteria = Criteria(np.float32(shadow), np.float32(misfit), np.float32(1 / limit**2), rounds)
    search = Search(
        np.empty(STATE, np.float32), np.empty(FACE, np.float32), np.empty((lamps, RAY), np.float32),
        np.empty((len(lobes), HIDDEN), np.float32), np.empty(GLANCE, np.float32), np.empty(FIT, np.float32),
    )  # fmt: skip
    for block in range(size):
        row, column = block // across, block % across * BLOCK
        removed[block] = ZERO
        samples = blocks.samples[block]
        _stand(x_of, y_of, heights, row, column, optics.camera, search.state, search.of)
        if np.isfinite(reach[0]):
            _leave_out(samples, optics.positions, reach, search.state)
        if len(lobes) == 0 and beyond.departure == ZERO:
            continue
        # Where no normal can be found, samples stay as they are.
        if find_normals(samples, beyond, criteria, search):
            _subtract(samples, blocks.colours[block], beyond.departure, search, removed[block])


@inner
def _stand(
    x_of: Array, y_of: Array, heights: Array, row: int, column: int, camera: Array, state: Array, of: Array
) -> None:
    """Locate the pixels of a block, past the end of the row too, and the camera from there."""
    size = min(len(x_of) - column, BLOCK)
    for p in range(BLOCK):
        state[POINT + p], state[POINT + BLOCK + p] = x_of[column], y_of[row]
        state[POINT + 2 * BLOCK + p] = ZERO
        of[VIEW + p], of[VIEW + BLOCK + p], of[VIEW + 2 * BLOCK + p] = ZERO, ZERO, ONE
    for p in range(size):
        state[POINT + p] = x_of[column + p]
    if heights.size:
        for p in range(size):
            z = heights[row, column + p]
            # Only a number that is known and finite is 0 less itself.
            state[POINT + 2 * BLOCK + p] = z if z - z == ZERO else ZERO
    if not np.isfinite(camera[2]):
        return
    for p in range(BLOCK):
        shift = state[POINT + 2 * BLOCK + p] / camera[2]
        state[POINT + p] += (camera[0] - state[POINT + p]) * shift
        state[POINT + BLOCK + p] += (camera[1] - state[POINT + BLOCK + p]) * shift
        x, y, z = (
            camera[0] - state[POINT + p],
            camera[1] - state[POINT + BLOCK + p],
            camera[2] - state[POINT + 2 * BLOCK + p],
        )
        nearness = ONE / np.sqrt(x * x + y * y + z * z)
        of[VIEW + p], of[VIEW + BLOCK + p], of[VIEW + 2 * BLOCK + p] = (
            x * nearness,
            y * nearness,
            z * nearness,
        )


@inner
def _leave_out(samples: Array, positions: Array, reach: Array, state: Array) -> None:
    """Leave out samples whose ray meets the plane further out than the flat reaches."""
    for k in range(len(samples)):
        sample = samples[k]
        sx, sy, sz = np.float64(positions[k, 0]), np.float64(positions[k, 1]), np.float64(positions[k, 2])
        for p in range(BLOCK):
            stretch = sz / (sz - state[POINT + 2 * BLOCK + p])
            missed = (abs(sx - (sx - state[POINT + p]) * stretch) > reach[0]) | (
                abs(sy - (sy - state[POINT + BLOCK + p]) * stretch) > reach[1]
            )
            sample[VALUE + p] = ZERO if missed else sample[VALUE + p]
            sample[USABLE + p] = ZERO if missed else sample[USABLE + p]
            sample[TRIAL + p] = ZERO if missed else sample[TRIAL + p]


@inner
def _subtract(samples: Array, colours: Array, departure: np.float32, search: Search, taken: Array) -> None:
    """Subtract what was found from samples and colours, and say how much that is of each colour."""
    state, of, rays, own = search.state, search.of, search.rays, search.own
    turn_faces(of)
    for p in range(BLOCK):
        state[PLAIN + p] = ZERO
    for k in range(len(samples)):
        ray = rays[k]
        if departure != ZERO:
            glance(of, ray, own)
            _roughen(of, ray, own)
        _subtract_grey(samples[k], state, of, ray)
    for c in range(0, 3 * BLOCK, BLOCK):
        _subtract_colour(samples, colours, c, state, of, rays, taken[c:])


@inner
def _subtract_colour(
    samples: Array, colours: Array, at: int, state: Array, of: Array, rays: Array, taken: Array
) -> None:
    """Subtract what was found from a colour."""
    for p in range(BLOCK):
        state[COLOURED + p], state[REMOVED + p] = ZERO, ZERO
    for k in range(len(rays)):
        sample, colour, ray = samples[k], colours[k, at:], rays[k]
        for p in range(BLOCK):
            plain = colour[p] - ray[SHINE + p]
            state[COLOURED + p] += plain if sample[USABLE + p] > ZERO else ZERO
    for p in range(BLOCK):
        # A channel's albedo is to the grey one as its light is.
        state[COLOURED + p] *= of[LENGTH + p] / max(state[PLAIN + p], _DARKEST)
    for k in range(len(rays)):
        colour, ray = colours[k, at:], rays[k]
        for p in range(BLOCK):
            beyond = ray[SHINE + p] + ray[ROUGH + p] * state[COLOURED + p]
            colour[p] -= beyond
            state[REMOVED + p] += beyond
    for p in range(BLOCK):
        share = state[REMOVED + p] / state[UPWARD + p]
        taken[p] = share if state[FOUND + p] > ZERO else ZERO


@inner
def _roughen(of: Array, ray: Array, own: Array) -> None:
    """Make of the strength of the departure what a sample has of it, for an albedo of 1."""
    for p in range(BLOCK):
        term, _, _ = cross_term(of, ray, own, p)
        ray[ROUGH + p] *= term


@inner
def _subtract_grey(sample: Array, state: Array, of: Array, ray: Array) -> None:
    """Subtract what was found from a sample, and add up what is left."""
    for p in range(BLOCK):
        found, used = state[FOUND + p] > ZERO, sample[USABLE + p] > ZERO
        shine = ray[SHINE + p] if found else ZERO
        rough = ray[ROUGH + p] if found else ZERO
        ray[SHINE + p], ray[ROUGH + p] = shine, rough
        plain = sample[VALUE + p] - shine
        state[PLAIN + p] += abs(plain) if used else ZERO
        sample[VALUE + p] -= shine + rough * of[LENGTH + p] if used else ZERO
