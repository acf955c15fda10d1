"""Compiled loops by which normals are eliminated from the equations of what all pixels of a tile share.

What each does to a sample is in `nlights_core.calibration.compiled_reflectance`.  Import this only where it is used:
Numba takes half a second.
"""

from __future__ import annotations

import numba
import numpy as np

from nlights_core.calibration.compiled_reflectance import (
    COUNT,
    FACE,
    FACETS,
    GGX,
    LOBE_SCALE,
    RAY,
    add_square,
    lobe,
    precision,
    prepare,
    shade,
    solve,
    turn,
)
from nlights_core.calibration.reflectance import FLAT_LOBES, WHITE
from nlights_core.frames import Array
from nlights_core.machine.compiling import kernel

FLAT_ALPHAS = np.array([roughness for _, roughness in FLAT_LOBES])
FLAT_FACETS = np.full(len(FLAT_LOBES), GGX)


@kernel
def linearise_samples(
    images: Array,
    lights: Array,
    weights: Array,
    views: Array,
    raised_lights: Array,
    raised_views: Array,
    dimmer: Array,
    per_flat: Array,
    scaled: Array,
    gloss: Array,
    alphas: Array,
    grazing: float,
    departure: float,
    flat_gloss: Array,
    sought: Array,
    misfit: float,
    step: float,
    first: int,
    last: int,
    columns: Array,
    slopes: Array,
    residuals: Array,
    precisions: Array,
) -> None:
    """Derivatives of the samples by what all pixels share, and by the pixel's own scaled normal.

    Parameters
    ----------
    images, lights, weights, views, gloss, alphas, grazing, departure, misfit, first, last
        As for `solve_normals`.
    raised_lights, raised_views : arrays of their shapes
        At a height larger by ``step``, mm.
    dimmer : (L, N) float32 array
        By which factor a reading changes there, because its flat field is read elsewhere.
    per_flat : (L, N) float32 array
        What light of 1 that is always there adds to a reading.
    scaled : (N, 3) float64 array
        Scaled normals, NaN where not known.
    flat_gloss : (F,) float64 array
        Strengths of the lobes of the flat.
    sought : (S,) int array
        Places of the lobes of the surface whose derivatives are wanted; those of the others stay 0.
    columns : (N, L, 1 + L + K + 3 + F) float64 array
        Receives, for what is predicted less what is observed: per mm of level; per unit of the logarithm of each
        lamp's strength; per lobe; per departure; per additive light; per light of the room; per lobe of the flat.
    slopes : (N, L, 3) float64 array
        Receives the derivatives by the scaled normal.
    residuals, precisions : (N, L) float64 arrays
        Receive what was observed less what is predicted, and one over its variance; 0 where not used.
    """
    count = len(images)
    ray, raised = np.empty(RAY), np.empty(RAY)
    b, own, slope, upwards = np.empty(3), np.empty(2), np.empty(3), np.array([0.0, 0.0, 1.0])
    lobes, of_flat = np.flatnonzero(gloss), np.arange(len(FLAT_ALPHAS))
    # Of the normal, of the normal seen from a raised point, and of the flat.
    face, raised_face, flat_face = np.empty(FACE), np.empty(FACE), np.empty(FACE)
    hidden, raised_hidden = np.empty((len(lobes), 2)), np.empty((len(lobes), 2))
    sought_hidden, flat_hidden = np.empty((len(sought), 2)), np.empty((len(FLAT_ALPHAS), 2))
    additive = 1 + count + COUNT + 1
    for p in range(first, last):
        b[0], b[1], b[2] = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        columns[p] = 0
        slopes[p] = 0
        residuals[p] = 0
        precisions[p] = 0
        if not b[2] > 0:
            continue
        (vx, vy, vz), (wx, wy, wz) = _vector(views, p), _vector(raised_views, p)
        turn(b, vx, vy, vz, sought, alphas, FACETS, face, sought_hidden)
        turn(b, vx, vy, vz, lobes, alphas, FACETS, face, hidden)
        turn(b, wx, wy, wz, lobes, alphas, FACETS, raised_face, raised_hidden)
        turn(upwards, vx, vy, vz, of_flat, FLAT_ALPHAS, FLAT_FACETS, flat_face, flat_hidden)
        size = face[3]
        for k in range(count):
            weight = np.float64(weights[k, p])
            if not weight > 0:
                continue
            prepare(*_vector(lights[k], p), vx, vy, vz, grazing, ray)
            prepare(*_vector(raised_lights[k], p), wx, wy, wz, grazing, raised)
            value = shade(
                b, ray, vx, vy, vz, lobes, gloss, alphas, departure, face, hidden, own, slopes[p, k]
            )
            above = shade(
                b, raised, wx, wy, wz, lobes, gloss, alphas, departure, raised_face, raised_hidden, own, slope
            )  # fmt: skip
            residuals[p, k] = images[k, p] - value
            precisions[p, k] = precision(value, weight, misfit, 0.02 * size)
            of = columns[p, k]
            # What is observed would bring its noise into residual and derivative alike, and their product has a
            # mean: so the change of the predicted reading is taken.
            of[0] = (above - value * dimmer[k, p]) / step
            of[1 + k] = value
            _derive_by_surface(sought, alphas, ray, face, sought_hidden, own, of, 1 + count)
            of[additive] = per_flat[k, p] * (1 - value)
            of[additive + 1] = per_flat[k, p] * (size - value)
            _derive_by_flat(flat_gloss, value, ray, flat_hidden, own, of, additive + 2)


@kernel
def read_surface(
    lights: Array,
    views: Array,
    scaled: Array,
    gloss: Array,
    alphas: Array,
    grazing: float,
    departure: float,
    first: int,
    last: int,
    readings: Array,
) -> None:
    """Predict the readings of some pixels.

    Parameters
    ----------
    lights, views, scaled, gloss, alphas, grazing, departure, first, last
        As for `linearise_samples`.
    readings : (L, N) float64 array
        Receives them; NaN where the normal is not known.
    """
    ray, face, b, own, slope = np.empty(RAY), np.empty(FACE), np.empty(3), np.empty(2), np.empty(3)
    lobes = np.flatnonzero(gloss)
    hidden = np.empty((len(lobes), 2))
    for p in range(first, last):
        readings[:, p] = np.nan
        b[0], b[1], b[2] = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        if not b[2] > 0:
            continue
        vx, vy, vz = _vector(views, p)
        turn(b, vx, vy, vz, lobes, alphas, FACETS, face, hidden)
        for k in range(len(lights)):
            prepare(*_vector(lights[k], p), vx, vy, vz, grazing, ray)
            readings[k, p] = shade(
                b, ray, vx, vy, vz, lobes, gloss, alphas, departure, face, hidden, own, slope
            )


@numba.njit(inline="always")
def _vector(of: Array, p: int) -> tuple[float, float, float]:
    """Components of one of the vectors, in double precision."""
    return np.float64(of[p, 0]), np.float64(of[p, 1]), np.float64(of[p, 2])


@numba.njit(inline="always")
def _derive_by_surface(
    sought: Array, alphas: Array, ray: Array, face: Array, hidden: Array, own: Array, out: Array, at: int
) -> None:
    """Fill in a sample's derivatives by the lobes and by the departure, one after the other; 0 stays where it is."""
    nx, ny, nz, size, seen = face[0], face[1], face[2], face[3], face[4]
    lit = nx * ray[4] + ny * ray[5] + nz * ray[6]
    if not (lit > 0 and seen > 0):
        return
    upright = nx * ray[7] + ny * ray[8] + nz * ray[9]
    if upright > 0:
        for h in range(len(sought)):
            j = sought[h]
            shine = lobe(alphas[j], FACETS[j], upright, lit, ray[10], hidden[h, 0], own)
            out[at + j] = shine * ray[3] * LOBE_SCALE
    across = ray[11] - lit * seen
    if across > 0:
        out[at + COUNT] = size * ray[3] * across / max(lit, seen) * lit


@numba.njit(inline="always")
def _derive_by_flat(
    flat_gloss: Array, value: float, ray: Array, hidden: Array, own: Array, out: Array, at: int
) -> None:
    """Fill in a sample's derivatives by the lobes of the flat, ``value`` being what is predicted."""
    glossy = 1.0
    for j in range(len(FLAT_ALPHAS)):
        mirrored = lobe(FLAT_ALPHAS[j], GGX, ray[9], ray[6], ray[12], hidden[j, 0], own)
        mirrored /= WHITE * ray[6]
        out[at + j] = -value * mirrored
        glossy += flat_gloss[j] * mirrored
    for j in range(len(FLAT_ALPHAS)):
        out[at + j] /= glossy


@kernel
def eliminate_normals(
    columns: Array,
    slopes: Array,
    precisions: Array,
    scaled: Array,
    first: int,
    last: int,
    inverses: Array,
    tilts: Array,
) -> None:
    """Find what a unit of each shared unknown does to the slopes of the surface.

    Parameters
    ----------
    columns, slopes, precisions : arrays
        Of `linearise_samples`; precisions become 0 in pixels that are not known.
    scaled : (N, 3) float64 array
        Scaled normals.
    first, last : int
        Pixels.
    inverses : (N, 6) float64 array
        Receives the upper triangle of the scaled normals' covariance.
    tilts : (2, M, N) float64 array
        Receives the changes of dz/dx and of dz/dy.
    """
    count, unknowns = columns.shape[1], columns.shape[2]
    matrix, none, out = np.empty(6), np.zeros(3), np.empty(9)
    turned = np.empty((3, unknowns))
    for p in range(first, last):
        matrix[:] = 0
        for k in range(count):
            add_square(precisions[p, k], slopes[p, k], matrix)
        if not solve(matrix, none, out):
            precisions[p] = 0
            inverses[p] = 0
            tilts[:, :, p] = 0
            continue
        for k in range(6):
            inverses[p, k] = out[3 + k]
        turned[:] = 0
        for k in range(count):
            w = precisions[p, k]
            x, y, z = w * slopes[p, k, 0], w * slopes[p, k, 1], w * slopes[p, k, 2]
            for m in range(unknowns):
                turned[0, m] += x * columns[p, k, m]
                turned[1, m] += y * columns[p, k, m]
                turned[2, m] += z * columns[p, k, m]
        bx, by, bz = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        for m in range(unknowns):
            # A change of the unknown turns the normal the other way.
            x = -(out[3] * turned[0, m] + out[4] * turned[1, m] + out[5] * turned[2, m])
            y = -(out[4] * turned[0, m] + out[6] * turned[1, m] + out[7] * turned[2, m])
            z = -(out[5] * turned[0, m] + out[7] * turned[1, m] + out[8] * turned[2, m])
            tilts[0, m, p] = -(x - bx / bz * z) / bz
            tilts[1, m, p] = -(y - by / bz * z) / bz


@kernel
def add_equations(
    columns: Array,
    slopes: Array,
    precisions: Array,
    residuals: Array,
    inverses: Array,
    bends: Array,
    first: int,
    last: int,
    matrix: Array,
    scores: Array,
) -> None:
    """Add the pixels' share of the normal equations, the normals eliminated.

    Parameters
    ----------
    columns, slopes, precisions, residuals : arrays
        Of `linearise_samples`.
    inverses : (N, 6) float64 array
        Of `eliminate_normals`.
    bends : (N, M) float64 array
        What a unit of each unknown does to the height here, mm.
    first, last : int
        Pixels.
    matrix : (M, M) float64 array
        Its upper triangle is added to.
    scores : (N, M) float64 array
        Receives each pixel's share of the right-hand side.
    """
    count, unknowns = columns.shape[1], columns.shape[2]
    seen = np.empty((count, unknowns))
    turned, x = np.empty((3, unknowns)), np.empty(3)
    for p in range(first, last):
        scores[p] = 0
        if inverses[p, 0] == 0:
            continue
        turned[:] = 0
        for k in range(count):
            w = precisions[p, k]
            raised = columns[p, k, 0]
            x[0], x[1], x[2] = w * slopes[p, k, 0], w * slopes[p, k, 1], w * slopes[p, k, 2]
            for m in range(unknowns):
                value = columns[p, k, m] + raised * bends[p, m]
                seen[k, m] = value
                turned[0, m] += x[0] * value
                turned[1, m] += x[1] * value
                turned[2, m] += x[2] * value
        a, b, c = inverses[p, 0], inverses[p, 1], inverses[p, 2]
        d, e, f = inverses[p, 3], inverses[p, 4], inverses[p, 5]
        for m in range(unknowns):
            t, u, v = turned[0, m], turned[1, m], turned[2, m]
            turned[0, m] = a * t + b * u + c * v
            turned[1, m] = b * t + d * u + e * v
            turned[2, m] = c * t + e * u + f * v
        for k in range(count):
            w = precisions[p, k]
            if w == 0:
                continue
            sx, sy, sz = slopes[p, k, 0], slopes[p, k, 1], slopes[p, k, 2]
            for m in range(unknowns):
                seen[k, m] -= sx * turned[0, m] + sy * turned[1, m] + sz * turned[2, m]
            rest = w * residuals[p, k]
            for m in range(unknowns):
                value = seen[k, m]
                scores[p, m] += rest * value
                weighted = w * value
                for n in range(m, unknowns):
                    matrix[m, n] += weighted * seen[k, n]
