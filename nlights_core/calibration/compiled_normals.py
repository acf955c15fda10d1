"""Compiled loop that finds the normals of a block whose surface is not quite matt, by Gauss and Newton.

What `nlights_core.calibration.linearisation.improve_normals` does with all samples of a pixel in double precision,
for a block of pixels at a time.  Import this only where it is used: Numba takes half a second.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration.compiled_highlights import (
    HALF,
    LENGTH,
    LIGHT,
    LIT,
    MIRROR,
    NORMAL,
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
from nlights_core.calibration.compiled_reflectance import CLOSE, F0, LOBE_SCALE
from nlights_core.frames import Array
from nlights_core.photographs.blocks import BLOCK, ONE, USABLE, VALUE, ZERO, X, Y, Z, inner
from nlights_core.solving.compiled_fits import DETERMINANT, MATRIX, RIGHT, add_square, invert_normal_matrices
from nlights_core.solving.compiled_fits import SCALED as STEP

# Of the pixels of a block, in an array (STATE,): point of the surface; value up to which a sample is in shadow; 1
# where a normal was found, and where it still moves; matt light of the samples, and of those of a colour; sum of the
# lights upwards, and of what is taken out.
POINT = 0
DARK, FOUND, MOVES, PLAIN, COLOURED, UPWARD, REMOVED, STATE = range(3 * BLOCK, 11 * BLOCK, BLOCK)

_ALL_PHOTONS = np.float32(PHOTONS)
_SQUARE_CLOSE = np.float32(CLOSE**2)
_MIRROR, _F0 = np.float32(LOBE_SCALE / 4), np.float32(F0)
_FLOOR, _UPRIGHT = np.float32(0.02), np.float32(0.1)
_SINGULAR = np.float32(1e-6)
"""Determinant of a normal matrix of trace 1 up to which single precision does not know it from 0."""


class Gloss(NamedTuple):
    """Lobes of a surface, and its departure from Lambert's law.

    Attributes
    ----------
    strengths, roughnesses : (K,) float32 arrays
        Of the lobes that there are.
    kinds : (K,) int64 array
        Of their facets.
    grazing : float32
        See `nlights_core.calibration.reflectance.grazing`.
    departure : float32
        From Lambert's law.
    """

    strengths: Array
    roughnesses: Array
    kinds: Array
    grazing: np.float32
    departure: np.float32


class Criteria(NamedTuple):
    """Criteria of a search for normals.

    Attributes
    ----------
    shadow : float32
        Share of the brightest sample below which one is not used.
    misfit : float32
        Share of a reading that the model may miss.
    per_limit : float32
        One over the square of the limit of Cauchy's loss, in standard deviations.
    rounds : int
        At the most.
    """

    shadow: np.float32
    misfit: np.float32
    per_limit: np.float32
    rounds: int


class Search(NamedTuple):
    """State of a search for the normals of a block, and room to work in.

    Attributes
    ----------
    state : (STATE,) float32 array
        See above.
    of : (FACE,) float32 array
    rays : (L, RAY) float32 array
    hidden : (K, HIDDEN) float32 array
    own : (GLANCE,) float32 array
        See `nlights_core.calibration.compiled_highlights`.
    fit : (FIT,) float32 array
        Equations of a step, see `nlights_core.solving.compiled_fits`.
    """

    state: Array
    of: Array
    rays: Array
    hidden: Array
    own: Array
    fit: Array


@inner
def find_normals(samples: Array, gloss: Gloss, criteria: Criteria, search: Search) -> bool:
    """Find scaled normals and what lobes read there; False, and nothing is known, where no pixel has any.

    The points of the surface and the views must have been filled in.
    """
    state, of, rays, fit = search.state, search.of, search.rays, search.fit
    _weigh(samples, criteria.shadow, gloss.grazing, gloss.departure, state, of, fit, rays)
    if not _begin(state, of, fit):
        return False
    for number in range(criteria.rounds + 1):
        turn_faces(of)
        hide_facets(of, gloss.roughnesses, gloss.kinds, search.hidden)
        _linearise(samples, gloss, criteria, search)
        if number == criteria.rounds or not _step(state, of, fit, rays):
            break
    return True


@inner
def _weigh(
    samples: Array,
    shadow: np.float32,
    grazing: np.float32,
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
        state[DARK + p], state[UPWARD + p] = ZERO, ZERO
    for k in range(len(samples)):
        sample = samples[k]
        for p in range(BLOCK):
            value = sample[VALUE + p] if sample[USABLE + p] > ZERO else ZERO
            state[DARK + p] = max(state[DARK + p], value)
    for p in range(BLOCK):
        state[DARK + p] *= shadow
    for k in range(len(samples)):
        sample, ray = samples[k], rays[k]
        for p in range(BLOCK):
            x, y, z = sample[X + p], sample[Y + p], sample[Z + p]
            vx, vy, vz = of[VIEW + p], of[VIEW + BLOCK + p], of[VIEW + 2 * BLOCK + p]
            state[UPWARD + p] += z
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
            ray[MIRROR + p] = _MIRROR * length * (_F0 + grazing * square * square * rest)
            ray[ROUGH + p] = departure * length
        for p in range(BLOCK):
            lit = sample[VALUE + p] > state[DARK + p]
            ray[WEIGHT + p] = sample[USABLE + p] * _ALL_PHOTONS if lit else ZERO
            x, y, z = sample[X + p], sample[Y + p], sample[Z + p]
            _add(fit, p, ray[WEIGHT + p], sample[VALUE + p], x, y, z)


@inner
def _add(fit: Array, p: int, weight: Any, value: Any, x: Any, y: Any, z: Any) -> None:
    """Add a sample, or its residual, to the equations of its pixel."""
    # `add_sample` multiplies the right-hand side in another order: so only the matrix is shared with it.
    wx, wy, wz = weight * x, weight * y, weight * z
    add_square(fit, p, wx, wy, wz, x, y, z)
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
        state[FOUND + p] = state[MOVES + p] = ONE if there else ZERO
        of[SCALED + p], of[SCALED + BLOCK + p] = x if there else ZERO, y if there else ZERO
        of[SCALED + 2 * BLOCK + p] = z if there else ONE
    return some


@inner
def _linearise(samples: Array, gloss: Gloss, criteria: Criteria, search: Search) -> None:
    """Equations of a step from the present normals, and what the lobes read there."""
    state, of, fit, rays, own = search.state, search.of, search.fit, search.rays, search.own
    departure, misfit, per_limit = gloss.departure, criteria.misfit, criteria.per_limit
    for k in range(MATRIX, DETERMINANT):
        fit[k] = ZERO
    for k in range(len(samples)):
        sample, ray = samples[k], rays[k]
        glance(of, ray, own)
        add_lobes(gloss.strengths, gloss.roughnesses, gloss.kinds, search.hidden, own)
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
        moves = state[MOVES + p] > ZERO
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
            (state[MOVES + p] > ZERO)
            & (fit[DETERMINANT + p] > _SINGULAR)
            & (z > _UPRIGHT * np.sqrt(x * x + y * y))
        )
        dx, dy, dz = dx if taken else ZERO, dy if taken else ZERO, dz if taken else ZERO
        fit[STEP + p], fit[STEP + BLOCK + p], fit[STEP + 2 * BLOCK + p] = dx, dy, dz
        of[SCALED + p], of[SCALED + BLOCK + p], of[SCALED + 2 * BLOCK + p] = bx + dx, by + dy, bz + dz
        moves = dx * dx + dy * dy + dz * dz > _SQUARE_CLOSE * of[LENGTH + p] * of[LENGTH + p]
        state[MOVES + p] = ONE if moves else ZERO
        moving += 1 if moves else 0
    # What lobes read after a last, small step follows from their slopes.
    for k in range(len(rays)):
        ray = rays[k]
        for p in range(BLOCK):
            more = ray[SLOPE + p] * fit[STEP + p] + ray[SLOPE + BLOCK + p] * fit[STEP + BLOCK + p]
            ray[SHINE + p] += more + ray[SLOPE + 2 * BLOCK + p] * fit[STEP + 2 * BLOCK + p]
    return moving
