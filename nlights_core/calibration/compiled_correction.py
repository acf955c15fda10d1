"""Compiled loop that takes out of developed blocks what is not of a matt surface under a known flat.

What `nlights_core.calibration.correction` says in numpy, pixel after pixel.  Import this only where it is used: Numba
takes half a second.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration.compiled_reflectance import (
    FACE,
    FACETS,
    RAY,
    SCRATCH,
    add_square,
    improve,
    prepare,
    shade,
    solve,
    turn,
)
from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel
from nlights_core.photographs.blocks import BLOCK, TRIAL, USABLE, VALUE, X, Y, Z
from nlights_core.photographs.strips import Blocks, Optics

_ALL_PHOTONS = float(PHOTONS)


@inner
def _rough(face: Array, ray: Array, departure: float) -> float:
    """Departure of a sample from matt paint, for an albedo of 1."""
    lit: float = face[0] * ray[4] + face[1] * ray[5] + face[2] * ray[6]
    across: float = ray[11] - lit * face[4]
    if lit <= 0 or face[4] <= 0 or across <= 0:
        return 0.0
    rough: float = departure * ray[3] * across * lit / max(lit, face[4])
    return rough


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
    matt = len(lobes) == 0 and departure == 0
    face, hidden = np.empty(FACE), np.empty((len(lobes), 2))
    rays, scratch, b = np.empty((lamps, RAY)), np.empty(SCRATCH), np.empty(3)
    image, weight, shine = np.empty(lamps), np.empty(lamps), np.empty(lamps)
    for block in range(size):
        row, column = block // across, block % across * BLOCK
        samples, colours = blocks.samples[block], blocks.colours[block]
        removed[block] = 0
        for p in range(min(columns - column, BLOCK)):
            x, y, z = np.float64(x_of[column + p]), np.float64(y_of[row]), 0.0
            if heights.size and math.isfinite(heights[row, column + p]):
                z = np.float64(heights[row, column + p])
            vx, vy, vz = 0.0, 0.0, 1.0
            if math.isfinite(optics.camera[2]):
                x += (optics.camera[0] - x) * z / optics.camera[2]
                y += (optics.camera[1] - y) * z / optics.camera[2]
                vx, vy, vz = optics.camera[0] - x, optics.camera[1] - y, optics.camera[2] - z
                far = math.sqrt(vx * vx + vy * vy + vz * vz)
                vx, vy, vz = vx / far, vy / far, vz / far
            brightest = 0.0
            for k in range(lamps):
                sx, sy, sz = optics.positions[k, 0], optics.positions[k, 1], optics.positions[k, 2]
                stretch = sz / (sz - z)
                if abs(sx - (sx - x) * stretch) > reach[0] or abs(sy - (sy - y) * stretch) > reach[1]:
                    samples[k, VALUE + p] = samples[k, USABLE + p] = samples[k, TRIAL + p] = 0
                if samples[k, USABLE + p] > 0:
                    brightest = max(brightest, samples[k, VALUE + p])
            if matt:
                continue
            scratch[:] = 0
            for k in range(lamps):
                image[k] = samples[k, VALUE + p]
                lit = image[k] > shadow * brightest
                weight[k] = samples[k, USABLE + p] * _ALL_PHOTONS if lit else 0.0
                prepare(
                    np.float64(samples[k, X + p]), np.float64(samples[k, Y + p]), np.float64(samples[k, Z + p]),
                    vx, vy, vz, rays[k],
                )  # fmt: skip
                if weight[k] > 0:
                    add_square(weight[k], rays[k], scratch[6:12])
                    for c in range(3):
                        scratch[12 + c] += weight[k] * image[k] * rays[k, c]
            # Where no normal can be found, samples stay as they are.
            if not solve(scratch[6:12], scratch[12:15], scratch[15:24]):
                continue
            for c in range(3):
                b[c] = scratch[15 + c]
            if not b[2] > 0:
                continue
            improve(
                b, image, weight, rays, vx, vy, vz, lobes, gloss, alphas, departure, misfit, limit, rounds, face,
                hidden, scratch,
            )  # fmt: skip
            turn(b, vx, vy, vz, lobes, alphas, FACETS, face, hidden)
            albedo, plain, upward = face[3], 0.0, 0.0
            for k in range(lamps):
                upward += rays[k, 2]
                whole = shade(
                    b, rays[k], vx, vy, vz, lobes, gloss, alphas, 0.0, face, hidden, scratch[3:6], scratch[:3]
                )
                shine[k] = whole - (b[0] * rays[k, 0] + b[1] * rays[k, 1] + b[2] * rays[k, 2])
                if samples[k, USABLE + p] > 0:
                    plain += abs(image[k] - shine[k])
            for c in range(3):
                # A channel's albedo is to the grey one as its light is.
                coloured, total = 0.0, 0.0
                for k in range(lamps):
                    if samples[k, USABLE + p] > 0:
                        coloured += colours[k, c * BLOCK + p] - shine[k]
                coloured *= albedo / max(plain, 1e-12)
                for k in range(lamps):
                    rough = 0.0
                    if departure != 0:
                        rough = _rough(face, rays[k], departure)
                    colours[k, c * BLOCK + p] -= shine[k] + rough * coloured
                    total += shine[k] + rough * coloured
                    if c == 0 and samples[k, USABLE + p] > 0:
                        samples[k, VALUE + p] -= shine[k] + rough * albedo
                removed[block, c * BLOCK + p] = total / upward
