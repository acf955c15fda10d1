"""Compiled loops for surfaces that are not quite matt: their normals, and how samples depend on what all share.

What `nlights_core.calibration.reflectance` says of arrays, for one sample at a time.  Import this only where it is
used: Numba takes half a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nlights_core.calibration.reflectance import NORMAL_REFLECTANCE, ROUGHNESS, WHITE
from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

LOBES = len(ROUGHNESS)
SQUARES = tuple(roughness**2 for roughness in ROUGHNESS)
LOBE_SCALE = 1 / WHITE
F0 = NORMAL_REFLECTANCE

# Of a sample, in an array (L, RAY): light; its length and unit vector; half vector; Fresnel's term; u.v.
LIGHT, LENGTH, UNIT, HALF, FRESNEL, ALONG, RAY = 0, 3, 4, 7, 10, 11, 12

STEP = 1e-3
"""Share of the scaled normal by which it is changed for derivatives."""


@inner
def prepare(x: float, y: float, z: float, vx: float, vy: float, vz: float, ray: Any) -> None:
    """Fill in what of a sample does not depend on the normal."""
    length = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / length, y / length, z / length
    hx, hy, hz = ux + vx, uy + vy, uz + vz
    size = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / size, hy / size, hz / size
    rest = 1 - (hx * vx + hy * vy + hz * vz)
    ray[0], ray[1], ray[2], ray[3] = x, y, z, length
    ray[4], ray[5], ray[6] = ux, uy, uz
    ray[7], ray[8], ray[9] = hx, hy, hz
    ray[10] = F0 + (1 - F0) * rest**5
    ray[11] = ux * vx + uy * vy + uz * vz


@inner
def lobe(square: float, upright: float, lit: float, seen: float, fresnel: float) -> float:
    """Radiance of one highlight, as `reflectance.highlights` has it, where the surface faces lamp and camera."""
    spread = upright * upright * (square - 1) + 1
    masked = 2 * lit / (lit + math.sqrt(square + (1 - square) * lit * lit))
    hidden = 2 * seen / (seen + math.sqrt(square + (1 - square) * seen * seen))
    return square / (spread * spread) * fresnel * masked * hidden / (4 * seen)


@inner
def shade(
    bx: float, by: float, bz: float, ray: Any, vx: float, vy: float, vz: float, gloss: Any, departure: float
) -> float:
    """Reading of one sample of a scaled normal."""
    value = bx * ray[0] + by * ray[1] + bz * ray[2]
    size = math.sqrt(bx * bx + by * by + bz * bz)
    if size == 0:
        return value
    nx, ny, nz = bx / size, by / size, bz / size
    lit = nx * ray[4] + ny * ray[5] + nz * ray[6]
    seen = nx * vx + ny * vy + nz * vz
    if lit <= 0 or seen <= 0:
        return value
    if departure != 0:
        across = ray[11] - lit * seen
        if across > 0:
            value += departure * size * ray[3] * across / max(lit, seen) * lit
    upright = nx * ray[7] + ny * ray[8] + nz * ray[9]
    if upright > 0:
        shine = 0.0
        for j in range(LOBES):
            if gloss[j] != 0:
                shine += gloss[j] * lobe(SQUARES[j], upright, lit, seen, ray[10])
        value += shine * ray[3] * LOBE_SCALE
    return value


@inner
def _solve(m: Any, right: Any, out: Any) -> bool:
    """Solve a symmetric 3 x 3 system, upper triangle given; also the inverse into ``out[3:9]``."""
    a, b, c, d, e, f = m[0], m[1], m[2], m[3], m[4], m[5]
    ixx, ixy, ixz = d * f - e * e, c * e - b * f, b * e - c * d
    iyy, iyz, izz = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * ixx + b * ixy + c * ixz
    trace = a + d + f
    if not determinant > 1e-9 * trace * trace * trace:
        return False
    inv = 1 / determinant
    out[3], out[4], out[5], out[6], out[7], out[8] = (
        ixx * inv, ixy * inv, ixz * inv, iyy * inv, iyz * inv, izz * inv,
    )  # fmt: skip
    out[0] = out[3] * right[0] + out[4] * right[1] + out[5] * right[2]
    out[1] = out[4] * right[0] + out[6] * right[1] + out[7] * right[2]
    out[2] = out[5] * right[0] + out[7] * right[1] + out[8] * right[2]
    return True


@inner
def _gradient(
    b: Any, ray: Any, vx: float, vy: float, vz: float, gloss: Any, departure: float, value: float, out: Any
) -> None:
    """Derivatives of one sample by the scaled normal, (3,): through lobes and cross term."""
    step = STEP * math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    out[0] = (shade(b[0] + step, b[1], b[2], ray, vx, vy, vz, gloss, departure) - value) / step
    out[1] = (shade(b[0], b[1] + step, b[2], ray, vx, vy, vz, gloss, departure) - value) / step
    out[2] = (shade(b[0], b[1], b[2] + step, ray, vx, vy, vz, gloss, departure) - value) / step


@inner
def _precision(predicted: float, weight: float, misfit: float, floor: float) -> float:
    """One over the variance of a sample, by the photons of what is predicted and a share of it."""
    level = max(predicted, floor)
    return 1 / (level / weight + (misfit * predicted) ** 2)


@kernel
def solve_normals(
    images: Array,
    lights: Array,
    weights: Array,
    views: Array,
    gloss: Array,
    departure: float,
    misfit: float,
    limit: float,
    rounds: int,
    first: int,
    last: int,
    scaled: Array,
    surprise: Array,
) -> None:
    """Improve the scaled normals of some pixels, by Gauss and Newton with Cauchy's loss.

    Parameters
    ----------
    images, weights : (L, N) float32 arrays
        Samples, and one over the variance of one that reads 1; 0: not used.
    lights : (L, N, 3) float32 array
        Relative to the flat.
    views : (N, 3) float32 array
        Unit vectors to the camera.
    gloss : (K,) float64 array
    departure : float
    misfit : float
        Share of a reading that the model may miss.
    limit : float
        Of Cauchy's loss, in standard deviations.
    rounds : int
    first, last : int
        Pixels.
    scaled : (N, 3) float64 array
        Where to begin; receives what was found.  NaN stays.
    surprise : (N,) float64 array
        Receives the root mean square residual over the lamps, in standard deviations.
    """
    count = len(images)
    ray = np.empty((count, RAY))
    slope, b, trial = np.empty(3), np.empty(3), np.empty(9)
    matrix, right = np.empty(6), np.empty(3)
    for p in range(first, last):
        b[0], b[1], b[2] = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        if not b[2] > 0:
            surprise[p] = np.nan
            continue
        vx, vy, vz = np.float64(views[p, 0]), np.float64(views[p, 1]), np.float64(views[p, 2])
        for k in range(count):
            prepare(
                np.float64(lights[k, p, 0]), np.float64(lights[k, p, 1]), np.float64(lights[k, p, 2]),
                vx, vy, vz, ray[k],
            )  # fmt: skip
        for turn in range(rounds + 1):
            matrix[:] = 0
            right[:] = 0
            squares, used = 0.0, 0
            floor = 0.02 * math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
            for k in range(count):
                weight = np.float64(weights[k, p])
                if not weight > 0:
                    continue
                used += 1
                value = shade(b[0], b[1], b[2], ray[k], vx, vy, vz, gloss, departure)
                rest = images[k, p] - value
                w = _precision(value, weight, misfit, floor)
                size = rest * rest * w
                squares += size
                if turn == rounds:
                    continue
                w /= 1 + size / (limit * limit)
                _gradient(b, ray[k], vx, vy, vz, gloss, departure, value, slope)
                x, y, z = slope[0], slope[1], slope[2]
                matrix[0] += w * x * x
                matrix[1] += w * x * y
                matrix[2] += w * x * z
                matrix[3] += w * y * y
                matrix[4] += w * y * z
                matrix[5] += w * z * z
                right[0] += w * x * rest
                right[1] += w * y * rest
                right[2] += w * z * rest
            surprise[p] = math.sqrt(squares / max(used, 1))
            if turn == rounds or used < 3 or not _solve(matrix, right, trial):
                break
            # A step that turns the normal away is not taken.
            if b[2] + trial[2] > 0.1 * math.hypot(b[0] + trial[0], b[1] + trial[1]):
                b[0] += trial[0]
                b[1] += trial[1]
                b[2] += trial[2]
            else:
                break
        scaled[p, 0], scaled[p, 1], scaled[p, 2] = b[0], b[1], b[2]


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
    departure: float,
    flat_gloss: Array,
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
    images, lights, weights, views, gloss, departure, misfit, first, last
        As for `solve_normals`.
    raised_lights, raised_views : arrays of their shapes
        At a height larger by ``step``, mm.
    dimmer : (L, N) float32 array
        By which factor a reading changes there, because its flat field is read elsewhere.
    per_flat : (L, N) float32 array
        What light of 1 that is always there adds to a reading.
    scaled : (N, 3) float64 array
        Scaled normals, NaN where not known.
    flat_gloss : (K,) float64 array
        Strengths of the lobes of the flat.
    columns : (N, L, 1 + L + K + 3 + K) float64 array
        Receives, for what is predicted less what is observed: per mm of level; per unit of the logarithm of each
        lamp's strength; per lobe; per departure; per additive light; per light of the room; per lobe of the flat.
    slopes : (N, L, 3) float64 array
        Receives the derivatives by the scaled normal.
    residuals, precisions : (N, L) float64 arrays
        Receive what was observed less what is predicted, and one over its variance; 0 where not used.
    """
    count = len(images)
    ray, raised = np.empty(RAY), np.empty(RAY)
    b = np.empty(3)
    at_lobes = 1 + count
    at_departure = at_lobes + LOBES
    for p in range(first, last):
        b[0], b[1], b[2] = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        columns[p] = 0
        slopes[p] = 0
        residuals[p] = 0
        precisions[p] = 0
        if not b[2] > 0:
            continue
        size = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
        nx, ny, nz = b[0] / size, b[1] / size, b[2] / size
        floor = 0.02 * size
        vx, vy, vz = np.float64(views[p, 0]), np.float64(views[p, 1]), np.float64(views[p, 2])
        wx, wy, wz = (
            np.float64(raised_views[p, 0]), np.float64(raised_views[p, 1]), np.float64(raised_views[p, 2]),
        )  # fmt: skip
        for k in range(count):
            weight = np.float64(weights[k, p])
            if not weight > 0:
                continue
            prepare(
                np.float64(lights[k, p, 0]), np.float64(lights[k, p, 1]), np.float64(lights[k, p, 2]),
                vx, vy, vz, ray,
            )  # fmt: skip
            prepare(
                np.float64(raised_lights[k, p, 0]), np.float64(raised_lights[k, p, 1]),
                np.float64(raised_lights[k, p, 2]), wx, wy, wz, raised,
            )  # fmt: skip
            value = shade(b[0], b[1], b[2], ray, vx, vy, vz, gloss, departure)
            above = shade(b[0], b[1], b[2], raised, wx, wy, wz, gloss, departure)
            residuals[p, k] = images[k, p] - value
            precisions[p, k] = _precision(value, weight, misfit, floor)
            _gradient(b, ray, vx, vy, vz, gloss, departure, value, slopes[p, k])
            of = columns[p, k]
            # What is observed would bring its noise into residual and derivative alike, and their product has a
            # mean: so the change of the predicted reading is taken.
            of[0] = (above - value * dimmer[k, p]) / step
            of[1 + k] = value
            lit = nx * ray[4] + ny * ray[5] + nz * ray[6]
            seen = nx * vx + ny * vy + nz * vz
            upright = nx * ray[7] + ny * ray[8] + nz * ray[9]
            if lit > 0 and seen > 0:
                if upright > 0:
                    for j in range(LOBES):
                        of[at_lobes + j] = (
                            lobe(SQUARES[j], upright, lit, seen, ray[10]) * ray[3] * LOBE_SCALE
                        )
                across = ray[11] - lit * seen
                if across > 0:
                    of[at_departure] = size * ray[3] * across / max(lit, seen) * lit
            of[at_departure + 1] = per_flat[k, p] * (1 - value)
            of[at_departure + 2] = per_flat[k, p] * (size - value)
            shine = 1.0
            for j in range(LOBES):
                mirrored = lobe(SQUARES[j], ray[9], ray[6], vz, ray[10]) / (WHITE * ray[6])
                of[at_departure + 3 + j] = -value * mirrored
                shine += flat_gloss[j] * mirrored
            for j in range(LOBES):
                of[at_departure + 3 + j] /= shine
