"""Compiled loops for surfaces that are not quite matt: their reflectance, and the normals that fit samples best.

What `nlights_core.calibration.reflectance` says of arrays, for one sample at a time.  Import this only where it is
used: Numba takes half a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nlights_core.calibration.reflectance import KINDS, NORMAL_REFLECTANCE, WHITE
from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

COUNT = len(KINDS)
GGX, BECKMANN, BLINN = range(3)
FACETS = np.array([("ggx", "beckmann", "blinn").index(kind) for kind in KINDS])
LOBE_SCALE = 1 / WHITE
F0 = NORMAL_REFLECTANCE

CLOSE = 5e-5
"""Step of a scaled normal, as a share of its length (0.003 degrees), after which no other is made."""

FAINT = -30.0
"""Exponent below which a highlight without tails is none: at its peak it is 10^13 times as bright."""

SCRATCH = 24
"""Numbers that `improve` needs room for."""

RAY = 13
"""Numbers of a sample's ray, which do not depend on the normal: 0-2 the light, 3 its length, 4-6 its unit vector,
7-9 the half vector, 10 Fresnel's term, 11 the cosine between light and view, 12 Fresnel's term of a reflectance of
`F0`."""

FACE = 5
"""Numbers of a pixel's face: 0-2 the unit normal, 3 the length of the scaled one, 4 the cosine between normal
and view."""


@inner
def prepare(x: float, y: float, z: float, vx: float, vy: float, vz: float, grazing: float, ray: Any) -> None:
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
    rest = rest * rest * rest * rest * rest
    ray[10] = F0 + grazing * rest
    ray[12] = F0 + (1 - F0) * rest
    ray[11] = ux * vx + uy * vy + uz * vz


@inner
def unmasked(cosine: float, alpha: float, facet: int, slope: Any) -> float:
    """Share of the facets that is not masked towards lamp or camera, over the cosine of that.

    ``slope[0]`` receives its derivative by the cosine, as a share of it.
    """
    if facet == BLINN:
        slope[0] = 0.0
        return 1.0
    if facet == GGX:
        square = alpha * alpha
        root = math.sqrt(square + (1 - square) * cosine * cosine)
        slope[0] = -(1 + (1 - square) * cosine / root) / (cosine + root)
        return 2 / (cosine + root)
    slope[0] = -1 / cosine
    sine = math.sqrt(max(1 - cosine * cosine, 1e-12))
    a = cosine / (alpha * sine)
    if a >= 1.6:
        return 1 / cosine
    above, below = a * (3.535 + 2.181 * a), 1 + a * (2.276 + 2.577 * a)
    by_a = (3.535 + 4.362 * a) / above - (2.276 + 5.154 * a) / below
    slope[0] += by_a / (alpha * sine * sine * sine)
    return above / below / cosine


@inner
def turn(
    b: Any, vx: float, vy: float, vz: float, lobes: Any, alphas: Any, facets: Any, face: Any, hidden: Any
) -> None:
    """Fill in what all samples of a pixel have in common: its face, and how much of each lobe the camera sees.

    ``hidden[i]`` receives for lobe ``lobes[i]``: 0 the share that is not masked, over the cosine; 1 its derivative by
    the cosine, as a share of it.
    """
    size = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    face[0], face[1], face[2], face[3] = b[0] / size, b[1] / size, b[2] / size, size
    seen = face[0] * vx + face[1] * vy + face[2] * vz
    face[4] = seen
    if seen <= 0:
        return
    for i in range(len(lobes)):
        hidden[i, 0] = unmasked(seen, alphas[lobes[i]], facets[lobes[i]], hidden[i, 1:])


@inner
def lobe(
    alpha: float, facet: int, upright: float, lit: float, fresnel: float, hidden: float, slope: Any
) -> float:
    """Radiance of one highlight, as `reflectance.highlights` has it, where the surface faces lamp and camera.

    ``slope`` receives its derivatives by the cosines between the normal and 0 half vector, 1 light.
    """
    square, flat = alpha * alpha, upright * upright
    if facet == GGX:
        narrow = 1 / (flat * (square - 1) + 1)
        facets = square * narrow * narrow
        steeper = -4 * upright * (square - 1) * narrow
    else:
        power = 2 / square - 2
        exponent = power * math.log(upright) if facet == BLINN else (1 - 1 / flat) / square
        if exponent < FAINT:
            slope[0], slope[1] = 0.0, 0.0
            return 0.0
        if facet == BLINN:
            facets = math.exp(exponent) / square
            steeper = power / upright
        else:
            facets = math.exp(exponent) / (square * flat * flat)
            steeper = (2 / (square * flat) - 4) / upright
    even = facets * fresnel * unmasked(lit, alpha, facet, slope) * hidden / 4
    by_light = slope[0]
    slope[0] = even * lit * steeper
    slope[1] = even * (1 + lit * by_light)
    return even * lit


@inner
def shade(
    b: Any,
    ray: Any,
    vx: float,
    vy: float,
    vz: float,
    lobes: Any,
    gloss: Any,
    alphas: Any,
    departure: float,
    face: Any,
    hidden: Any,
    own: Any,
    out: Any,
) -> float:
    """Reading of one sample of a scaled normal, and its derivatives by that, into ``out[:3]``.

    ``lobes`` are those of which there is some, ``face`` and ``hidden`` what `turn` filled in for them; ``own`` is
    scratch.
    """
    value: float = b[0] * ray[0] + b[1] * ray[1] + b[2] * ray[2]
    out[0], out[1], out[2] = ray[0], ray[1], ray[2]
    if len(lobes) == 0 and departure == 0:
        return value
    nx, ny, nz, size, seen = face[0], face[1], face[2], face[3], face[4]
    lit = nx * ray[4] + ny * ray[5] + nz * ray[6]
    if lit <= 0 or seen <= 0:
        return value
    # Of what is beyond matt paint: derivatives by the cosines to half vector, light and view.
    to_half, to_light, to_view = 0.0, 0.0, 0.0
    upright = nx * ray[7] + ny * ray[8] + nz * ray[9]
    if upright > 0:
        scale = ray[3] * LOBE_SCALE
        for i in range(len(lobes)):
            j = lobes[i]
            strength = scale * gloss[j]
            shine = strength * lobe(alphas[j], FACETS[j], upright, lit, ray[10], hidden[i, 0], own)
            value += shine
            to_half += strength * own[0]
            to_light += strength * own[1]
            to_view += shine * hidden[i, 1]
    to_half, to_light, to_view = to_half / size, to_light / size, to_view / size
    across = ray[11] - lit * seen
    if departure != 0 and across > 0:
        share = departure * ray[3]
        if lit >= seen:
            term, by_light, by_view = across, -seen, -lit
        else:
            term = across * lit / seen
            by_light, by_view = across / seen - lit, -lit * lit / seen - across * lit / (seen * seen)
        value += share * size * term
        out[0] += share * term * nx
        out[1] += share * term * ny
        out[2] += share * term * nz
        to_light += share * by_light
        to_view += share * by_view
    gx = to_half * ray[7] + to_light * ray[4] + to_view * vx
    gy = to_half * ray[8] + to_light * ray[5] + to_view * vy
    gz = to_half * ray[9] + to_light * ray[6] + to_view * vz
    along = gx * nx + gy * ny + gz * nz
    out[0] += gx - along * nx
    out[1] += gy - along * ny
    out[2] += gz - along * nz
    return value


@inner
def solve(m: Any, right: Any, out: Any) -> bool:
    """Solve a symmetric 3 x 3 system, of which ``m`` is the upper triangle, row by row.

    ``out`` receives 0-2 the solution, 3-8 the upper triangle of the inverse.  False: it cannot be solved.
    """
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
def precision(predicted: float, weight: float, misfit: float, floor: float) -> float:
    """One over the variance of a sample, by the photons of what is predicted and a share of it."""
    level = max(predicted, floor)
    return 1 / (level / weight + (misfit * predicted) ** 2)


@inner
def add_square(weight: float, slope: Any, matrix: Any) -> None:
    """Add a sample to the normal equations' matrix of a pixel, ``matrix`` being its upper triangle, row by row."""
    x, y, z = slope[0], slope[1], slope[2]
    matrix[0] += weight * x * x
    matrix[1] += weight * x * y
    matrix[2] += weight * x * z
    matrix[3] += weight * y * y
    matrix[4] += weight * y * z
    matrix[5] += weight * z * z


@inner
def improve(
    b: Any,
    images: Any,
    weights: Any,
    rays: Any,
    vx: float,
    vy: float,
    vz: float,
    lobes: Any,
    gloss: Any,
    alphas: Any,
    departure: float,
    misfit: float,
    limit: float,
    rounds: int,
    face: Any,
    hidden: Any,
    scratch: Any,
) -> float:
    """Improve the scaled normal ``b`` of one pixel, as `solve_normals` does; return its residual.

    ``images`` and ``weights`` (L,) are its samples and ``rays`` (L, RAY) what `prepare` filled in.  Of ``scratch``
    (SCRATCH,) 0-2 are a sample's derivatives by the normal, 3-5 those of a lobe, 6-11 the matrix, 12-14 the
    right-hand side, 15-23 what `solve` finds.
    """
    slope, own, matrix = scratch[:3], scratch[3:6], scratch[6:12]
    right, trial = scratch[12:15], scratch[15:24]
    surprise = 0.0
    for number in range(rounds + 1):
        matrix[:] = 0
        right[:] = 0
        squares, used = 0.0, 0
        turn(b, vx, vy, vz, lobes, alphas, FACETS, face, hidden)
        floor = 0.02 * face[3]
        for k in range(len(images)):
            weight = weights[k]
            if not weight > 0:
                continue
            used += 1
            value = shade(b, rays[k], vx, vy, vz, lobes, gloss, alphas, departure, face, hidden, own, slope)
            rest = images[k] - value
            w = precision(value, weight, misfit, floor)
            size = rest * rest * w
            squares += size
            if number == rounds:
                continue
            w /= 1 + size / (limit * limit)
            add_square(w, slope, matrix)
            right[0] += w * slope[0] * rest
            right[1] += w * slope[1] * rest
            right[2] += w * slope[2] * rest
        surprise = math.sqrt(squares / max(used, 1))
        if number == rounds or used < 3 or not solve(matrix, right, trial):
            break
        # A step that turns the normal away is not taken.
        if b[2] + trial[2] > 0.1 * math.hypot(b[0] + trial[0], b[1] + trial[1]):
            b[0] += trial[0]
            b[1] += trial[1]
            b[2] += trial[2]
        else:
            break
        step = trial[0] * trial[0] + trial[1] * trial[1] + trial[2] * trial[2]
        if step < (CLOSE * face[3]) ** 2:
            break
    return surprise


@kernel
def solve_normals(
    images: Array,
    lights: Array,
    weights: Array,
    views: Array,
    gloss: Array,
    alphas: Array,
    grazing: float,
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
    gloss, alphas : (K,) float64 arrays
        Strength and roughness of each lobe.
    grazing : float
        See `nlights_core.calibration.reflectance.grazing`.
    departure : float
    misfit : float
        Share of a reading that the model may miss.
    limit : float
        Of Cauchy's loss, in standard deviations.
    rounds : int
        At the most; a pixel whose step is `CLOSE` to nothing is done.
    first, last : int
        Pixels.
    scaled : (N, 3) float64 array
        Where to begin; receives what was found.  NaN stays.
    surprise : (N,) float64 array
        Receives the root mean square residual over the lamps, in standard deviations, before the last step if that
        was `CLOSE`.
    """
    count = len(images)
    ray = np.empty((count, RAY))
    image, weight, b, scratch = np.empty(count), np.empty(count), np.empty(3), np.empty(SCRATCH)
    lobes = np.flatnonzero(gloss)
    face, hidden = np.empty(FACE), np.empty((len(lobes), 2))
    for p in range(first, last):
        b[0], b[1], b[2] = scaled[p, 0], scaled[p, 1], scaled[p, 2]
        if not b[2] > 0:
            surprise[p] = np.nan
            continue
        vx, vy, vz = np.float64(views[p, 0]), np.float64(views[p, 1]), np.float64(views[p, 2])
        for k in range(count):
            image[k], weight[k] = np.float64(images[k, p]), np.float64(weights[k, p])
            prepare(
                np.float64(lights[k, p, 0]), np.float64(lights[k, p, 1]), np.float64(lights[k, p, 2]),
                vx, vy, vz, grazing, ray[k],
            )  # fmt: skip
        surprise[p] = improve(
            b, image, weight, ray, vx, vy, vz, lobes, gloss, alphas, departure, misfit, limit, rounds, face, hidden,
            scratch,
        )  # fmt: skip
        scaled[p, 0], scaled[p, 1], scaled[p, 2] = b[0], b[1], b[2]
