"""Compiled loop that takes out of developed blocks what is not of a matt surface under a known flat.

What `nlights_core.calibration.correction` says in numpy, a block of pixels after another.  Import this only where it
is used: Numba takes half a second.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration.compiled_highlights import (
    FACE,
    GLANCE,
    HALF,
    HIDDEN,
    LENGTH,
    LIGHT,
    LIT,
    MIRROR,
    NORMAL,
    RAY,
    ROUGH,
    SCALED,
    SEEN,
    SHINE,
    SLOPE,
    TO_HALF,
    TO_LIGHT,
    TO_VIEW,
    TOTAL,
    VIEW,
    WEIGHT,
    WITH_VIEW,
    add_lobes,
    cross_term,
    glance,
    hide_facets,
    turn_faces,
)
from nlights_core.calibration.compiled_reflectance import CLOSE, F0, FACETS, LOBE_SCALE
from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel
from nlights_core.photographs.blocks import BLOCK, ONE, TRIAL, USABLE, VALUE, ZERO, X, Y, Z, inner
from nlights_core.photographs.strips import Blocks, Optics
from nlights_core.solving.compiled_fits import DETERMINANT, FIT, MATRIX, RIGHT, invert_normal_matrices
from nlights_core.solving.compiled_fits import SCALED as STEP

# Of the pixels of a block, in an array (STATE,): point of the surface; value up to which a sample is in shadow; 1
# where a normal was found, and where it still moves; matt light of the samples, and of those of a colour; sum of the
# lights upwards, and of what is taken out.
_X, _Y, _Z, _DARK, _FOUND, _MOVES = range(0, 6 * BLOCK, BLOCK)
_PLAIN, _COLOURED, _UPWARD, _REMOVED, _STATE = range(6 * BLOCK, 11 * BLOCK, BLOCK)

_ALL_PHOTONS = np.float32(PHOTONS)
_SQUARE_CLOSE = np.float32(CLOSE**2)
_MIRROR, _F0, _F90 = np.float32(LOBE_SCALE / 4), np.float32(F0), np.float32(1 - F0)
_FLOOR, _UPRIGHT = np.float32(0.02), np.float32(0.1)
_DARKEST = np.float32(1e-12)
_SINGULAR = np.float32(1e-6)
"""Determinant of a normal matrix of trace 1 up to which single precision does not know it from 0."""


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
    columns = len(x_of)
    across = (columns + BLOCK - 1) // BLOCK
    lobes = np.flatnonzero(gloss)
    strengths, roughnesses = gloss[lobes].astype(np.float32), alphas[lobes].astype(np.float32)
    kinds = FACETS[lobes]
    state, of, own = np.empty(_STATE, np.float32), np.empty(FACE, np.float32), np.empty(GLANCE, np.float32)
    fit = np.empty(FIT, np.float32)
    rays, hidden = np.empty((lamps, RAY), np.float32), np.empty((len(lobes), HIDDEN), np.float32)
    rough = np.float32(departure)
    for block in range(size):
        row, column = block // across, block % across * BLOCK
        removed[block] = ZERO
        samples = blocks.samples[block]
        _stand(x_of, y_of, heights, row, column, optics.camera, state, of)
        if np.isfinite(reach[0]):
            _leave_out(samples, optics.positions, reach, state)
        if len(lobes) == 0 and rough == ZERO:
            continue
        _weigh(samples, np.float32(shadow), rough, state, of, fit, rays)
        # Where no normal can be found, samples stay as they are.
        if not _begin(state, of, fit):
            continue
        for number in range(rounds + 1):
            turn_faces(of)
            hide_facets(of, roughnesses, kinds, hidden)
            _linearise(
                samples, strengths, roughnesses, kinds, hidden, np.float32(misfit), np.float32(1 / limit**2),
                rough, state, of, fit, rays, own,
            )  # fmt: skip
            if number == rounds or not _step(state, of, fit, rays):
                break
        _subtract(samples, blocks.colours[block], rough, state, of, rays, own, removed[block])


@inner
def _stand(
    x_of: Array, y_of: Array, heights: Array, row: int, column: int, camera: Array, state: Array, of: Array
) -> None:
    """Locate the pixels of a block, past the end of the row too, and the camera from there."""
    size = min(len(x_of) - column, BLOCK)
    for p in range(BLOCK):
        state[_X + p], state[_Y + p], state[_Z + p] = x_of[column], y_of[row], ZERO
        of[VIEW + p], of[VIEW + BLOCK + p], of[VIEW + 2 * BLOCK + p] = ZERO, ZERO, ONE
    for p in range(size):
        state[_X + p] = x_of[column + p]
    if heights.size:
        for p in range(size):
            z = heights[row, column + p]
            # Only a number that is known and finite is 0 less itself.
            state[_Z + p] = z if z - z == ZERO else ZERO
    if not np.isfinite(camera[2]):
        return
    for p in range(BLOCK):
        shift = state[_Z + p] / camera[2]
        state[_X + p] += (camera[0] - state[_X + p]) * shift
        state[_Y + p] += (camera[1] - state[_Y + p]) * shift
        x, y, z = camera[0] - state[_X + p], camera[1] - state[_Y + p], camera[2] - state[_Z + p]
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
            stretch = sz / (sz - state[_Z + p])
            missed = (abs(sx - (sx - state[_X + p]) * stretch) > reach[0]) | (
                abs(sy - (sy - state[_Y + p]) * stretch) > reach[1]
            )
            sample[VALUE + p] = ZERO if missed else sample[VALUE + p]
            sample[USABLE + p] = ZERO if missed else sample[USABLE + p]
            sample[TRIAL + p] = ZERO if missed else sample[TRIAL + p]


@inner
def _weigh(
    samples: Array,
    shadow: np.float32,
    departure: np.float32,
    state: Array,
    of: Array,
    fit: Array,
    rays: Array,
) -> None:
    """Fill in what of the samples does not depend on the normal, and the equations of a matt surface."""
    for k in range(MATRIX, DETERMINANT):
        fit[k] = ZERO
    for p in range(BLOCK):
        state[_DARK + p], state[_UPWARD + p] = ZERO, ZERO
    for k in range(len(samples)):
        sample = samples[k]
        for p in range(BLOCK):
            value = sample[VALUE + p] if sample[USABLE + p] > ZERO else ZERO
            state[_DARK + p] = max(state[_DARK + p], value)
    for p in range(BLOCK):
        state[_DARK + p] *= shadow
    for k in range(len(samples)):
        sample, ray = samples[k], rays[k]
        for p in range(BLOCK):
            x, y, z = sample[X + p], sample[Y + p], sample[Z + p]
            vx, vy, vz = of[VIEW + p], of[VIEW + BLOCK + p], of[VIEW + 2 * BLOCK + p]
            state[_UPWARD + p] += z
            length = np.sqrt(x * x + y * y + z * z)
            per_length = ONE / length
            x, y, z = x * per_length, y * per_length, z * per_length
            ray[LIGHT + p], ray[LIGHT + BLOCK + p], ray[LIGHT + 2 * BLOCK + p] = x, y, z
            ray[WITH_VIEW + p] = x * vx + y * vy + z * vz
            x, y, z = x + vx, y + vy, z + vz
            per_size = ONE / np.sqrt(x * x + y * y + z * z)
            x, y, z = x * per_size, y * per_size, z * per_size
            ray[HALF + p], ray[HALF + BLOCK + p], ray[HALF + 2 * BLOCK + p] = x, y, z
            rest = ONE - (x * vx + y * vy + z * vz)
            square = rest * rest
            ray[MIRROR + p] = _MIRROR * length * (_F0 + _F90 * square * square * rest)
            ray[ROUGH + p] = departure * length
        for p in range(BLOCK):
            lit = sample[VALUE + p] > state[_DARK + p]
            ray[WEIGHT + p] = sample[USABLE + p] * _ALL_PHOTONS if lit else ZERO
            x, y, z = sample[X + p], sample[Y + p], sample[Z + p]
            _add(fit, p, ray[WEIGHT + p], sample[VALUE + p], x, y, z)


@inner
def _add(fit: Array, p: int, weight: Any, value: Any, x: Any, y: Any, z: Any) -> None:
    """Add a sample, or its residual, to the equations of its pixel."""
    wx, wy, wz = weight * x, weight * y, weight * z
    fit[MATRIX + p] += wx * x
    fit[MATRIX + BLOCK + p] += wx * y
    fit[MATRIX + 2 * BLOCK + p] += wx * z
    fit[MATRIX + 3 * BLOCK + p] += wy * y
    fit[MATRIX + 4 * BLOCK + p] += wy * z
    fit[MATRIX + 5 * BLOCK + p] += wz * z
    fit[RIGHT + p] += wx * value
    fit[RIGHT + BLOCK + p] += wy * value
    fit[RIGHT + 2 * BLOCK + p] += wz * value


@inner
def _begin(state: Array, of: Array, fit: Array) -> int:
    """Begin with the normals of a matt surface; return how many there are."""
    invert_normal_matrices(fit)
    some = 0
    for p in range(BLOCK):
        x, y, z = fit[STEP + p], fit[STEP + BLOCK + p], fit[STEP + 2 * BLOCK + p]
        there = (
            (fit[DETERMINANT + p] > _SINGULAR)
            & (z > ZERO)
            & (z - z == ZERO)
            & (x - x == ZERO)
            & (y - y == ZERO)
        )
        some += 1 if there else 0
        state[_FOUND + p] = state[_MOVES + p] = ONE if there else ZERO
        of[SCALED + p], of[SCALED + BLOCK + p] = x if there else ZERO, y if there else ZERO
        of[SCALED + 2 * BLOCK + p] = z if there else ONE
    return some


@inner
def _linearise(
    samples: Array,
    gloss: Array,
    alphas: Array,
    kinds: Array,
    hidden: Array,
    misfit: np.float32,
    per_limit: np.float32,
    departure: np.float32,
    state: Array,
    of: Array,
    fit: Array,
    rays: Array,
    own: Array,
) -> None:
    """Equations of a step from the present normals, and what the lobes read there."""
    for k in range(MATRIX, DETERMINANT):
        fit[k] = ZERO
    for k in range(len(samples)):
        sample, ray = samples[k], rays[k]
        glance(of, ray, own)
        add_lobes(gloss, alphas, kinds, hidden, own)
        _slope(state, of, ray, own)
        for p in range(BLOCK):
            x, y, z = sample[X + p], sample[Y + p], sample[Z + p]
            value = x * of[SCALED + p] + y * of[SCALED + BLOCK + p] + z * of[SCALED + 2 * BLOCK + p]
            value += own[TOTAL + p]
            x, y, z = x + own[TO_HALF + p], y + own[TO_LIGHT + p], z + own[TO_VIEW + p]
            if departure != ZERO:
                nx, ny, nz = of[NORMAL + p], of[NORMAL + BLOCK + p], of[NORMAL + 2 * BLOCK + p]
                term, to_light, to_view = cross_term(of, ray, own, p)
                share = ray[ROUGH + p]
                value += share * of[LENGTH + p] * term
                # Along the normal the term grows with the length; across it, as the cosines do.
                along = share * (term - to_light * own[LIT + p] - to_view * of[SEEN + p])
                to_light, to_view = share * to_light, share * to_view
                x += along * nx + to_light * ray[LIGHT + p] + to_view * of[VIEW + p]
                y += along * ny + to_light * ray[LIGHT + BLOCK + p] + to_view * of[VIEW + BLOCK + p]
                z += along * nz + to_light * ray[LIGHT + 2 * BLOCK + p] + to_view * of[VIEW + 2 * BLOCK + p]
            rest = sample[VALUE + p] - value
            missed = misfit * value
            level = max(value, _FLOOR * of[LENGTH + p])
            weight = ray[WEIGHT + p]
            # By the photons of what is predicted and a share of it, with Cauchy's loss.
            weight = weight / (level + weight * (missed * missed + rest * rest * per_limit))
            _add(fit, p, weight, rest, x, y, z)


@inner
def _slope(state: Array, of: Array, ray: Array, own: Array) -> None:
    """Turn derivatives by the cosines into those by the scaled normal; keep them where it still moves."""
    for p in range(BLOCK):
        nx, ny, nz = of[NORMAL + p], of[NORMAL + BLOCK + p], of[NORMAL + 2 * BLOCK + p]
        to_half, to_light, to_view = own[TO_HALF + p], own[TO_LIGHT + p], own[TO_VIEW + p]
        x = to_half * ray[HALF + p] + to_light * ray[LIGHT + p] + to_view * of[VIEW + p]
        y = (
            to_half * ray[HALF + BLOCK + p]
            + to_light * ray[LIGHT + BLOCK + p]
            + to_view * of[VIEW + BLOCK + p]
        )
        z = to_half * ray[HALF + 2 * BLOCK + p] + to_light * ray[LIGHT + 2 * BLOCK + p]
        z += to_view * of[VIEW + 2 * BLOCK + p]
        along = x * nx + y * ny + z * nz
        per_length = ONE / of[LENGTH + p]
        x, y, z = (x - along * nx) * per_length, (y - along * ny) * per_length, (z - along * nz) * per_length
        own[TO_HALF + p], own[TO_LIGHT + p], own[TO_VIEW + p] = x, y, z
        moves = state[_MOVES + p] > ZERO
        ray[SHINE + p] = own[TOTAL + p] if moves else ray[SHINE + p]
        ray[SLOPE + p] = x if moves else ray[SLOPE + p]
        ray[SLOPE + BLOCK + p] = y if moves else ray[SLOPE + BLOCK + p]
        ray[SLOPE + 2 * BLOCK + p] = z if moves else ray[SLOPE + 2 * BLOCK + p]


@inner
def _step(state: Array, of: Array, fit: Array, rays: Array) -> int:
    """Take a step where normals still move; return how many move on."""
    invert_normal_matrices(fit)
    moving = 0
    for p in range(BLOCK):
        dx, dy, dz = fit[STEP + p], fit[STEP + BLOCK + p], fit[STEP + 2 * BLOCK + p]
        bx, by, bz = of[SCALED + p], of[SCALED + BLOCK + p], of[SCALED + 2 * BLOCK + p]
        x, y, z = bx + dx, by + dy, bz + dz
        # A step that turns the normal away is not taken.
        taken = (
            (state[_MOVES + p] > ZERO)
            & (fit[DETERMINANT + p] > _SINGULAR)
            & (z > _UPRIGHT * np.sqrt(x * x + y * y))
        )
        dx, dy, dz = dx if taken else ZERO, dy if taken else ZERO, dz if taken else ZERO
        fit[STEP + p], fit[STEP + BLOCK + p], fit[STEP + 2 * BLOCK + p] = dx, dy, dz
        of[SCALED + p], of[SCALED + BLOCK + p], of[SCALED + 2 * BLOCK + p] = bx + dx, by + dy, bz + dz
        moves = dx * dx + dy * dy + dz * dz > _SQUARE_CLOSE * of[LENGTH + p] * of[LENGTH + p]
        state[_MOVES + p] = ONE if moves else ZERO
        moving += 1 if moves else 0
    # What lobes read after a last, small step follows from their slopes.
    for k in range(len(rays)):
        ray = rays[k]
        for p in range(BLOCK):
            more = ray[SLOPE + p] * fit[STEP + p] + ray[SLOPE + BLOCK + p] * fit[STEP + BLOCK + p]
            ray[SHINE + p] += more + ray[SLOPE + 2 * BLOCK + p] * fit[STEP + 2 * BLOCK + p]
    return moving


@inner
def _subtract(
    samples: Array,
    colours: Array,
    departure: np.float32,
    state: Array,
    of: Array,
    rays: Array,
    own: Array,
    taken: Array,
) -> None:
    """Subtract what was found from samples and colours, and say how much that is of each colour."""
    turn_faces(of)
    for p in range(BLOCK):
        state[_PLAIN + p] = ZERO
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
        state[_COLOURED + p], state[_REMOVED + p] = ZERO, ZERO
    for k in range(len(rays)):
        sample, colour, ray = samples[k], colours[k, at:], rays[k]
        for p in range(BLOCK):
            plain = colour[p] - ray[SHINE + p]
            state[_COLOURED + p] += plain if sample[USABLE + p] > ZERO else ZERO
    for p in range(BLOCK):
        # A channel's albedo is to the grey one as its light is.
        state[_COLOURED + p] *= of[LENGTH + p] / max(state[_PLAIN + p], _DARKEST)
    for k in range(len(rays)):
        colour, ray = colours[k, at:], rays[k]
        for p in range(BLOCK):
            beyond = ray[SHINE + p] + ray[ROUGH + p] * state[_COLOURED + p]
            colour[p] -= beyond
            state[_REMOVED + p] += beyond
    for p in range(BLOCK):
        share = state[_REMOVED + p] / state[_UPWARD + p]
        taken[p] = share if state[_FOUND + p] > ZERO else ZERO


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
        found, used = state[_FOUND + p] > ZERO, sample[USABLE + p] > ZERO
        shine = ray[SHINE + p] if found else ZERO
        rough = ray[ROUGH + p] if found else ZERO
        ray[SHINE + p], ray[ROUGH + p] = shine, rough
        plain = sample[VALUE + p] - shine
        state[_PLAIN + p] += abs(plain) if used else ZERO
        sample[VALUE + p] -= shine + rough * of[LENGTH + p] if used else ZERO
