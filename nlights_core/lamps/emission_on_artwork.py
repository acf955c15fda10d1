"""Emission of each lamp, fitted to photographs of the artwork itself, where there is no flat.

Averaged over blocks an artwork is nearly flat, but of unknown albedo.  Block j reads under lamp i

    log I_ij = lamp_i(P_j) + c_j - p_j Lx/Lz - q_j Ly/Lz

with lamp_i of `nlights_core.lamps.lobes` (power, aim, exponent), c_j the albedo and the lens, and
p_j, q_j the slope.  Eight lamps leave five equations per block, the same three unknowns of
which are eliminated.  What a lamp's emission and a slope of the whole artwork have in common
cannot be told apart: there the priors decide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.lamps.lobes import (
    UNKNOWNS,
    Readings,
    differentiate_readings,
    optical_axes,
    predict_readings,
    prior_deviations,
)

STRENGTH_DEVIATION = 0.1
"""Of the logarithm of a lamp's strength about the given one, as in `nlights_core.lamps.strengths`."""
POSITION_MM = 1.0
"""Standard deviation of a lamp's coordinates."""
WARP_DEG = 0.5
"""Slope that the artwork as a whole may have at its border, per term: it hangs on the plane of the
stand, or lies on it, and canvases bow by a millimetre over some hundred."""
LEAST_SLOPE_DEG = 0.3
"""Slope of blocks against that warp, if the photographs do not show more."""
LEAST_RESIDUAL = 0.003
"""Lamps are not ideal: groups of four depart by this share from their lobe."""
INDEPENDENT = 75
"""As how many independent blocks the artwork counts: paper and canvas bend over some 50 mm."""
ALBEDO_DEVIATION = 3.0
"""Of its logarithm: anything from black to white."""
FALSE_ALARM = 0.001
"""How often given values that are right may be changed."""
TUNING = 2.385
"""Cauchy's loss, as in `nlights_core.lamps.lobes`, of a block's whole disagreement."""
LEAST_BLOCKS = 100
"""Fewer blocks than these say nothing about a lamp."""
FREE = np.ones(UNKNOWNS, bool)
"""All of a lamp's unknowns are fitted; `LobeFit` lists them."""
ROUNDS = 15


def fit_emission_on_artwork(images: Array, lights: LightField, x: Array, y: Array) -> LightField:
    """Fit powers, axes and exponents to an artwork.

    Parameters
    ----------
    images : (L, h, w) array
        Means over blocks of some 10 mm of linear grey photographs, divided by the given power;
        NaN where not known.
    lights : LightField
        The given near lamps, with axes and exponents.
    x, y : (w,) and (h,) arrays
        Centres of the blocks, mm.

    Returns
    -------
    LightField
        Powers times what was found (of mean 1), axes and exponents.  The given field, unchanged,
        where the photographs do not contradict it: what is right is not made worse.

    Raises
    ------
    TileError
        When fewer than 100 blocks are lit by all lamps.

    Notes
    -----
    Gauss-Newton on the logarithm.  Besides axes, exponents and powers it fits what it does not
    return: departures from the ideal lobe, positions within a millimetre, and a tilt, bow and twist
    of the whole artwork.  The unknowns of a block are eliminated by counting them to its
    noise: the covariance of its L readings is ``s^2 + A^2 1 1^T + g^2 T T^T``, with s the residual,
    A the deviation of albedo, g that of slopes and T = (Lx/Lz, Ly/Lz).  s and g are learnt from the
    blocks, so that a relief (steep blocks) holds the lamps to nothing that slopes could explain.
    """
    assert lights.exponents is not None
    data = _readings(images, lights, x, y)
    count = len(lights.lamps)
    scale = prior_deviations(POSITION_MM)
    scale[0] = STRENGTH_DEVIATION
    warp = np.full(5, np.radians(WARP_DEG))
    deviations = np.concatenate([np.tile(scale, count), warp])
    lean = _leaning(data)
    state, matrix = np.zeros(len(deviations)), np.diag(deviations**-2)
    # `LightField.vectors` counts a lamp's power by its light at the origin.
    given = np.zeros((count, len(FREE)))
    given[:, 0] = np.log(np.sum(data.positions**2, axis=1))
    given[:, 3] = np.log(lights.exponents / data.exponent)
    lamps = given.copy()
    slope, spread = np.radians(2.0), 0.01
    bent = np.einsum("lnk,nkt->lnt", lean, _warps(data))
    for _ in range(ROUNDS):
        now = predict_readings(lamps, data)
        residual = data.logarithm - now - bent @ state[-5:]
        weights, share, (slope, spread) = _weights(residual, lean, slope, spread)
        columns = _columns(differentiate_readings(lamps, data, now, FREE), bent)
        # Newton's matrix with the full covariance of each block's readings.
        turned = np.einsum("nij,jna->ina", weights * share[:, None, None], columns)
        matrix = np.einsum("ina,inb->ab", columns, turned, optimize=True) + np.diag(deviations**-2)
        right = np.einsum("ina,in->a", turned, residual) - state / deviations**2
        step = np.linalg.solve(matrix, right)
        step *= min(1.0, 2 / float(np.max(np.abs(step / deviations))))
        state = state + step
        lamps[:, FREE] = given[:, FREE] + state[:-5].reshape(count, -1)
        if np.max(np.abs(step / deviations)) < 0.01:
            break
    if not _contradicted(state[:-5].reshape(count, -1), matrix):
        return lights
    power = np.exp(lamps[:, 0] - given[:, 0])
    return replace(
        lights,
        power=lights.power * (power / power.mean())[:, None],
        axes=optical_axes(lamps, data),
        exponents=data.exponent * np.exp(lamps[:, 3]),
    )


def _readings(images: Array, lights: LightField, x: Array, y: Array) -> Readings:
    """Logarithms of the blocks that every lamp lights, and the given lamps."""
    assert lights.positions is not None
    assert lights.axes is not None
    values = images.reshape(len(images), -1).astype(np.float64)
    known = np.all(np.isfinite(values) & (values > 0), axis=0)
    if np.count_nonzero(known) < LEAST_BLOCKS:
        raise TileError(
            f"refine: only {np.count_nonzero(known)} blocks of the photographs are lit by all lamps and "
            f"{LEAST_BLOCKS} are needed; set 'refine: false' or photograph a flat"
        )
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)[known]
    first = np.cross([0.0, 0.0, 1.0], lights.axes)
    first[np.linalg.norm(first, axis=1) < 1e-6] = [1.0, 0.0, 0.0]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    sides = first, np.cross(lights.axes, first)
    assert lights.exponents is not None
    exponent = float(np.exp(np.mean(np.log(lights.exponents))))
    dark = np.zeros(len(points)), np.zeros((len(points), 2))
    return Readings(np.log(values[:, known]), points, lights.positions, lights.axes, sides, exponent, *dark)


def _leaning(data: Readings) -> Array:
    """Change of the logarithm by a slope of 1 across and up the picture, (L, N, 2)."""
    ray = data.positions[:, None, :] - data.points
    return np.asarray(-ray[..., :2] / ray[..., 2:])


def _warps(data: Readings) -> Array:
    """Slopes (N, 2, 5) of an artwork tilted, bowed and twisted as a whole, 1 at its border."""
    x, y = (data.points[:, :2] / np.abs(data.points[:, :2]).max(axis=0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    return np.stack([[one, zero, x, zero, y], [zero, one, zero, y, x]]).transpose(2, 0, 1)


def _columns(by_lamp: Array, bent: Array) -> Array:
    """Derivatives of all readings by all unknowns, (L, N, 4 L + 5)."""
    count, samples, terms = by_lamp.shape
    out = np.zeros((count, samples, count * terms + bent.shape[2]))
    for i in range(count):
        out[i, :, i * terms : (i + 1) * terms] = by_lamp[i]
    out[..., count * terms :] = bent
    return out


def _weights(
    residual: Array, lean: Array, slope: float, spread: float
) -> tuple[Array, Array, tuple[float, float]]:
    """Inverse covariance of each block's readings, (N, L, L), share of each block (N,), new (g, s)."""
    count, samples = residual.shape
    nuisance = np.concatenate([np.ones((samples, count, 1)), np.moveaxis(lean, 0, 1)], axis=2)
    prior = np.array([ALBEDO_DEVIATION, slope, slope]) ** -2
    normal = np.einsum("nlk,nlm->nkm", nuisance, nuisance) / spread**2 + np.diag(prior)
    inverse = np.linalg.inv(normal)
    found = np.einsum("nkm,nlm,ln->nk", inverse, nuisance, residual) / spread**2
    left = residual - np.einsum("nlk,nk->ln", nuisance, found)
    chi = np.sum(left**2, axis=0) / spread**2 + np.sum(found[:, 1:] ** 2, axis=1) / slope**2
    trust = 1 / (1 + chi / (TUNING**2 * count))
    weights = (
        np.eye(count) / spread**2
        - np.einsum("nik,nkm,njm->nij", nuisance, inverse, nuisance, optimize=True) / spread**4
    )
    spread = max(LEAST_RESIDUAL, float(np.median(np.abs(left))) / 0.6745 * np.sqrt(count / (count - 3)))
    # What the blocks' slopes are known by themselves counts, not only what the prior lets pass.
    slope = max(
        np.radians(LEAST_SLOPE_DEG),
        float(np.sqrt(np.median(found[:, 1:] ** 2) / 0.4549 + np.median(inverse[:, 1, 1]))),
    )
    return weights, trust * min(1.0, INDEPENDENT / samples), (slope, spread)


def _contradicted(changes: Array, matrix: Array) -> bool:
    """Test whether powers, aims and exponents as given, (L, 18) of no change, are improbable: Wald's test.

    Lobes, positions and the warp of the artwork may explain what they can.
    """
    from scipy.special import chdtri

    count, terms = changes.shape
    places = (terms * np.arange(count)[:, None] + np.arange(4)).ravel()
    covariance = np.linalg.inv(matrix)[np.ix_(places, places)]
    asked = changes[:, :4].ravel()
    return float(asked @ np.linalg.solve(covariance, asked)) > float(chdtri(len(places), FALSE_ALARM))
