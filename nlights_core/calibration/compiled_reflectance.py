"""Compiled loops for surfaces that are not quite matt: their normals, and how samples depend on what all share.

What `nlights_core.calibration.reflectance` says of arrays, for one sample at a time.  Import this only where it is
used: Numba takes half a second.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nlights_core.calibration.reflectance import FLAT_LOBES, KINDS, NORMAL_REFLECTANCE, WHITE
from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel

COUNT = len(KINDS)
GGX, BECKMANN, BLINN = range(3)
FACETS = tuple(("ggx", "beckmann", "blinn").index(kind) for kind in KINDS)
FLAT_COUNT = len(FLAT_LOBES)
OF_FLAT = tuple(roughness for _, roughness in FLAT_LOBES)
LOBE_SCALE = 1 / WHITE
F0 = NORMAL_REFLECTANCE

RAY = 12
"""Numbers of a sample's ray: light (3), its length, its unit vector (3), half vector (3), Fresnel's term, u.v."""


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
def masking_without_tails(cosine: float, alpha: float, slope: Any) -> float:
    """Masking of the facets of Beckmann, as `reflectance.highlights` has it; its derivative into ``slope[0]``."""
    slope[0] = 0.0
    sine = 1 - cosine * cosine
    if sine <= 1e-12:
        return 1.0
    sine = math.sqrt(sine)
    a = cosine / (alpha * sine)
    if a >= 1.6:
        return 1.0
    above, below = a * (3.535 + 2.181 * a), 1 + a * (2.276 + 2.577 * a)
    by_a = (3.535 + 4.362 * a - above / below * (2.276 + 5.154 * a)) / below
    slope[0] = by_a / (alpha * sine * sine * sine)
    return above / below


@inner
def lobe(
    alpha: float, facet: int, upright: float, lit: float, seen: float, fresnel: float, slope: Any
) -> float:
    """Radiance of one highlight, as `reflectance.highlights` has it, where the surface faces lamp and camera.

    ``slope`` receives its derivatives by the cosines between the normal and half vector, light and view.
    """
    square = alpha * alpha
    if facet == BLINN:
        power = 2 / square - 2
        value = math.exp(power * math.log(upright)) / square * fresnel * lit / 4
        slope[0], slope[1], slope[2] = value * power / upright, value / lit, 0.0
        return value
    if facet == BECKMANN:
        flat = upright * upright
        facets = math.exp((1 - 1 / flat) / square) / (square * flat * flat)
        masked = masking_without_tails(lit, alpha, slope)
        by_lit = slope[0] / masked
        hidden = masking_without_tails(seen, alpha, slope)
        by_seen = slope[0] / hidden - 1 / seen
        value = facets * fresnel * masked * hidden / (4 * seen)
        slope[0] = value * (2 / (square * flat * upright) - 4 / upright)
        slope[1], slope[2] = value * by_lit, value * by_seen
        return value
    spread = upright * upright * (square - 1) + 1
    facets = square / (spread * spread)
    steeper = -4 * upright * (square - 1) / spread
    root = math.sqrt(square + (1 - square) * lit * lit)
    masked = 2 * lit / (lit + root)
    far = math.sqrt(square + (1 - square) * seen * seen)
    hidden = 2 / (seen + far)
    value = facets * fresnel * masked * hidden / 4
    slope[0] = value * steeper
    slope[1] = value * square / (root * lit * (lit + root))
    slope[2] = -value * (1 + (1 - square) * seen / far) / (seen + far)
    return value


@inner
def shade(
    b: Any,
    ray: Any,
    vx: float,
    vy: float,
    vz: float,
    gloss: Any,
    alphas: Any,
    departure: float,
    own: Any,
    out: Any,
) -> float:
    """Reading of one sample of a scaled normal, and its derivatives by that, into ``out[:3]``; ``own`` is scratch."""
    bx, by, bz = b[0], b[1], b[2]
    value: float = bx * ray[0] + by * ray[1] + bz * ray[2]
    out[0], out[1], out[2] = ray[0], ray[1], ray[2]
    size = math.sqrt(bx * bx + by * by + bz * bz)
    if size == 0:
        return value
    nx, ny, nz = bx / size, by / size, bz / size
    lit = nx * ray[4] + ny * ray[5] + nz * ray[6]
    seen = nx * vx + ny * vy + nz * vz
    if lit <= 0 or seen <= 0:
        return value
    # Of what is beyond matt paint: derivatives by the cosines to half vector, light and view.
    to_half, to_light, to_view = 0.0, 0.0, 0.0
    upright = nx * ray[7] + ny * ray[8] + nz * ray[9]
    if upright > 0:
        scale = ray[3] * LOBE_SCALE
        for j in range(COUNT):
            if gloss[j] != 0:
                strength = scale * gloss[j]
                value += strength * lobe(alphas[j], FACETS[j], upright, lit, seen, ray[10], own)
                to_half += strength * own[0]
                to_light += strength * own[1]
                to_view += strength * own[2]
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
    alphas: Array,
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
    slope, own, b, trial = np.empty(3), np.empty(3), np.empty(3), np.empty(9)
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
                value = shade(b, ray[k], vx, vy, vz, gloss, alphas, departure, own, slope)
                rest = images[k, p] - value
                w = _precision(value, weight, misfit, floor)
                size = rest * rest * w
                squares += size
                if turn == rounds:
                    continue
                w /= 1 + size / (limit * limit)
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
    alphas: Array,
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
    images, lights, weights, views, gloss, alphas, departure, misfit, first, last
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
    b, own, slope = np.empty(3), np.empty(3), np.empty(3)
    at_lobes = 1 + count
    at_departure = at_lobes + COUNT
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
            value = shade(b, ray, vx, vy, vz, gloss, alphas, departure, own, slopes[p, k])
            above = shade(b, raised, wx, wy, wz, gloss, alphas, departure, own, slope)
            residuals[p, k] = images[k, p] - value
            precisions[p, k] = _precision(value, weight, misfit, floor)
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
                    for j in range(COUNT):
                        shine = lobe(alphas[j], FACETS[j], upright, lit, seen, ray[10], own)
                        of[at_lobes + j] = shine * ray[3] * LOBE_SCALE
                across = ray[11] - lit * seen
                if across > 0:
                    of[at_departure] = size * ray[3] * across / max(lit, seen) * lit
            of[at_departure + 1] = per_flat[k, p] * (1 - value)
            of[at_departure + 2] = per_flat[k, p] * (size - value)
            glossy = 1.0
            for j in range(FLAT_COUNT):
                mirrored = lobe(OF_FLAT[j], GGX, ray[9], ray[6], vz, ray[10], own) / (WHITE * ray[6])
                of[at_departure + 3 + j] = -value * mirrored
                glossy += flat_gloss[j] * mirrored
            for j in range(FLAT_COUNT):
                of[at_departure + 3 + j] /= glossy


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
            w = precisions[p, k]
            x, y, z = slopes[p, k, 0], slopes[p, k, 1], slopes[p, k, 2]
            matrix[0] += w * x * x
            matrix[1] += w * x * y
            matrix[2] += w * x * z
            matrix[3] += w * y * y
            matrix[4] += w * y * z
            matrix[5] += w * z * z
        if not _solve(matrix, none, out):
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
