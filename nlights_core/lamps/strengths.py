"""Strengths of the lamps and their ambient light, fitted to photographs.

Xiong's model says that pixel j, of scaled normal b_j (albedo times normal), reads under lamp i

    I_ij = s_i (l_ij . b_j) + alpha_i |b_j|

where l_ij is the given light, s_i the strength it lacks and alpha_i the ambient light.  The
least squares fit over all b_j, s_i and alpha_i has directions in which the residual hardly
changes while the normals do: a common scale, two tilts of a flat artwork, three ambient
patterns ``alpha_i = beta . l_i``.  PSBox leaves them free and loses degrees; here a prior at the
given lights (s = 1, alpha = 0) holds them.

No surface is quite Lambertian, and what that does to the photographs must not pass for lamps.  It
changes with the normals, which strengths do not: so a lamp is believed the less, the more its
residuals depend on the normals, and ambient light only where it exceeds such faults.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.lamps.emission_on_artwork import fit_emission_on_artwork
from nlights_core.photographs.block_means import average_blocks
from nlights_core.photographs.development import bands_of_grid, darkroom
from nlights_core.photographs.images import grey

BLOCKS = 40
"""Across the artwork, where the emission of its lamps is fitted."""


ROWS = 16
"""Of each block, that are looked at."""


SAMPLES = 5000
"""How many pixels the refinement of lamp strengths looks at."""

STRENGTH_DEVIATION = 0.1
"""Standard deviation of a lamp's strength about the given one, at prior 1."""
AMBIENT_DEVIATION = 0.05
"""Standard deviation of the ambient share about 0, at prior 1."""
MOST_INDEPENDENT = 10.0
"""However many samples agree, they count as no more than these: noise in b_j pretends to reveal
what it cannot, in proportion to the number of samples, and would overrule the prior."""
SYSTEMATIC_PENALTY = 10.0
"""How much more than noise a variance counts that pixels of similar normals have in common: of a
fault that changes slowly with the normals, most hides in the scaled normals and the strengths."""
LEAST_NOISE = 3e-4
"""Relative noise that is taken for granted."""
MOST_SAMPLES = 100_000
"""Pixels times lamps that are looked at: more would cost seconds and, see above, tell no more."""
LEAST_SAMPLES = 100
"""Fewer pixels than these say nothing about a lamp."""


class _Samples(NamedTuple):
    """Pixels that enough lamps light."""

    values: Array
    """(N, L)"""
    lights: Array
    """(N, L, 3): given lights"""
    usable: Array
    """(N, L): neither unknown nor in shadow"""


class _Estimate(NamedTuple):
    """One state of the fit."""

    strength: Array
    """(L,)"""
    ambient: Array
    """(L,)"""
    scaled: Array
    """(N, 3): the scaled normals b_j"""


def refine(field: LightField, images: Array, vectors: Array, prior: float = 1.0) -> LightField:
    """Refine the strengths of a light field.

    Parameters
    ----------
    field : LightField
        The given lamps.
    images : (L, N) array
        Grey samples, linear, divided by the given power; NaN where saturated.
    vectors : (L, N, 3) array, or broadcastable to it
        ``field.vectors`` at the samples.
    prior : float
        As in `refine_strengths`; 0 is the fit of PSBox: strengths alone, all samples alike.

    Returns
    -------
    LightField
        The power multiplied by the strengths; the ambient light as a share of that power.

    Raises
    ------
    TileError
        As in `refine_strengths`.
    """
    if prior == 0:
        # Ambient light that nothing holds would explain an even artwork by itself, as bright as the lamps.
        strength, ambient = refine_strengths(
            images, vectors, prior=0, with_ambient=False, robust=False, shadow=0
        )
        strength = strength / strength.mean()
    else:
        strength, ambient = refine_strengths(images, vectors, prior=prior)
    return replace(field, power=field.power * strength[:, None], ambient=ambient / strength)


def refine_strengths(
    images: Array,
    vectors: Array,
    *,
    prior: float = 1.0,
    with_ambient: bool = True,
    robust: bool = True,
    shadow: float = 0.1,
) -> tuple[Array, Array]:
    """Fit the lamps' strengths and ambient shares to samples of the photographs.

    Parameters
    ----------
    images : (L, N) array
        Samples of linear grey photographs in any common unit; NaN where not known.
    vectors : (L, N, 3) array, or broadcastable to it
        Direction times irradiance of the given lights at the samples.
    prior : float
        Weight of the given lights: strengths are 1 with a standard deviation of ``0.1 /
        sqrt(prior)``, ambient shares 0 with ``0.05 / sqrt(prior)``.  0 sets neither, nor the
        gauge: the strengths keep whatever common factor the fit ends with.
    with_ambient : bool
        False keeps the ambient light at 0, as PSBox does.
    robust : bool
        Weigh samples down that contradict the rest of their pixel (Cauchy's loss): gloss,
        penumbras.  False: plain least squares, as PSBox does.
    shadow : float
        A sample below this fraction of its pixel's brightest is taken as shadow and left out.

    Returns
    -------
    strength : (L,) float64 array
        Factors on the given lights, of mean 1 (unless ``prior`` is 0).
    ambient : (L,) float64 array
        alpha_i of the model above, for the same scale.

    Raises
    ------
    TileError
        When fewer than 100 pixels are lit by enough lamps: at least four, and half of them all.

    Notes
    -----
    Gauss-Newton on all unknowns at once, the b_j eliminated by their Schur complement, so that
    a step costs one product of a (2 L, 3 N) matrix with its transpose.

    The fit runs twice.  The first time it follows the samples closely; its residuals tell noise
    (each sample for itself) from the model's own faults (common to pixels of similar normals:
    gloss, interreflection, wrong directions).  The second time each lamp's samples count by that:
    faults that are systematic do not average out, however many pixels share them.  Ambient light
    that is then no larger than the faults is one of them (a falloff flatter than Lambert's looks
    like ambient light): the fit is done again without it.

    References
    ----------
    .. [1] Y. Xiong, PSBox, 2014: ``PSEstimateLightStrength.m``.
    """
    samples = _lit_samples(images, vectors, shadow)
    lamps = samples.values.shape[1]
    given = np.array([prior / STRENGTH_DEVIATION**2] * lamps + [prior / AMBIENT_DEVIATION**2] * lamps)
    free = np.arange(2 * lamps if with_ambient else lamps)
    start = _Estimate(np.ones(lamps), np.zeros(lamps), _scaled_normals(samples))
    estimate = _descend(samples, start, given, free, None, robust)
    if prior == 0:
        return estimate.strength, estimate.ambient
    variance = _variance(samples, estimate)
    estimate = _descend(samples, start, given, free, variance, robust)
    brightness = np.median(np.linalg.norm(estimate.scaled, axis=1))
    if np.mean((estimate.ambient * brightness) ** 2) < variance.mean():
        without = estimate._replace(ambient=np.zeros(lamps))
        estimate = _descend(samples, without, given, free[:lamps], variance, robust)
    mean = estimate.strength.mean()
    return estimate.strength / mean, estimate.ambient / mean


def _lit_samples(images: Array, vectors: Array, shadow: float) -> _Samples:
    """Choose the pixels that enough lamps light, and what of them is used."""
    samples = np.array(images, float).T
    lights = np.broadcast_to(vectors, (*np.shape(images), 3)).transpose(1, 0, 2).astype(float)
    known = np.isfinite(samples)
    samples[~known] = 0
    usable = known & (samples > 0) & (samples >= shadow * samples.max(axis=1, keepdims=True))
    needed = max(4, samples.shape[1] / 2)
    enough = usable.sum(axis=1) >= needed
    if enough.sum() < LEAST_SAMPLES:
        raise TileError(
            f"refine: only {enough.sum()} sampled pixels are lit by at least {needed:.0f} of "
            f"{samples.shape[1]} lamps and {LEAST_SAMPLES} are needed; set 'refine: false' or use more lamps"
        )
    every = -(-int(enough.sum()) * samples.shape[1] // MOST_SAMPLES)
    chosen = np.flatnonzero(enough)[::every]
    return _Samples(samples[chosen], lights[chosen], usable[chosen])


def _scaled_normals(samples: _Samples) -> Array:
    """Least squares b_j under the given lights, (N, 3)."""
    weighted = samples.lights * samples.usable[..., None]
    moments = np.swapaxes(weighted, 1, 2) @ samples.lights
    right = np.einsum("nl,nlk->nk", samples.values, weighted)
    return np.asarray(np.linalg.solve(_bounded(moments), right[..., None])[..., 0])


def _bounded(matrices: Array) -> Array:
    """Positive matrices (N, 3, 3) kept invertible where all usable lights lie in one plane."""
    ridge = 1e-9 * np.trace(matrices, axis1=1, axis2=2) + np.finfo(float).tiny
    return np.asarray(matrices + ridge[:, None, None] * np.eye(3))


def _residual(samples: _Samples, estimate: _Estimate) -> Array:
    """Residual that the model leaves unexplained, (N, L)."""
    shading = np.einsum("nlk,nk->nl", samples.lights, estimate.scaled)
    albedo = np.linalg.norm(estimate.scaled, axis=1, keepdims=True)
    return np.asarray(samples.values - estimate.strength * shading - estimate.ambient * albedo)


def _deviation(samples: _Samples, residual: Array) -> float:
    """Standard deviation of a sample, from the median of its residual's size.

    Three of the samples of each pixel go into its b_j and must be made good for.
    """
    usable = samples.usable
    left = max(1, int(usable.sum()) - 3 * len(usable))
    scale = 1.4826 * np.median(np.abs(residual[usable])) * np.sqrt(usable.sum() / left)
    # No photograph is better than this; a simulation without noise must not overrule the prior.
    return float(max(scale, LEAST_NOISE * np.median(samples.values[usable])))


def _trust(samples: _Samples, residual: Array, deviation: float) -> Array:
    """Weights of Cauchy's loss, which gives 95 % efficiency on pure noise; (N, L)."""
    return np.asarray(samples.usable / (1 + (residual / (2.385 * deviation)) ** 2))


def _variance(samples: _Samples, estimate: _Estimate) -> Array:
    """Variance of one sample of the mean fit, (L,): noise averages out, faults do not.

    Pixels are sorted into groups of similar normals.  What the residuals of a lamp have in
    common within a group, beyond what chance gives, is systematic.
    """
    residual = _residual(samples, estimate)
    deviation = _deviation(samples, residual)
    trust = _trust(samples, residual, deviation)
    normals = estimate.scaled / np.linalg.norm(estimate.scaled, axis=1, keepdims=True)
    across = int(np.clip(np.sqrt(len(normals) / 50), 2, 10))
    groups = [
        cell
        for stripe in np.array_split(np.argsort(normals[:, 0]), across)
        for cell in np.array_split(stripe[np.argsort(normals[stripe, 1])], across)
    ]
    total = np.array([trust[cell].sum(axis=0) for cell in groups])
    mean = np.array([(trust[cell] * residual[cell]).sum(axis=0) for cell in groups])
    mean /= np.maximum(total, 1e-12)
    chance = deviation**2 / np.maximum(total, 1e-12)
    seen = total >= 5
    excess = np.where(seen, mean**2 - chance, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    # A fault of one lamp shows in the residuals of all, for it bends the scaled normals.
    systematic = (np.maximum(excess, 0) + max(0.0, float(excess.mean()))) / 2
    return np.asarray(SYSTEMATIC_PENALTY * systematic + deviation**2 / MOST_INDEPENDENT)


def _descend(
    samples: _Samples,
    estimate: _Estimate,
    given: Array,
    free: Array,
    variance: Array | None,
    robust: bool,
) -> _Estimate:
    """Gauss-Newton steps until no strength changes by more than 1e-4.

    ``given`` (2 L,) are the precisions of the prior and ``free`` the unknowns that may change;
    ``variance`` (L,) is that of one sample of the mean fit (None: as if all was noise).
    """
    lamps = samples.values.shape[1]
    for _ in range(40):
        residual = _residual(samples, estimate)
        deviation = _deviation(samples, residual)
        trust = _trust(samples, residual, deviation) if robust else samples.usable.astype(float)
        # The samples count as a mean, not as a sum: more pixels are not more independent ones.
        trust /= len(trust) * (deviation**2 / MOST_INDEPENDENT if variance is None else variance)
        curvature, slope, back = _normal_equations(samples.lights, trust, residual, estimate)
        curvature[np.diag_indices(2 * lamps)] += given
        slope -= given * np.concatenate([estimate.strength - 1, estimate.ambient])
        step = np.zeros(2 * lamps)
        # Without a prior the gauge makes the matrix singular: the shortest step leaves it alone.
        step[free] = np.linalg.lstsq(curvature[np.ix_(free, free)], slope[free], rcond=1e-10)[0]
        largest = np.abs(step).max()
        step *= min(1.0, 0.1 / max(largest, 1e-12))
        estimate = _Estimate(
            estimate.strength + step[:lamps],
            estimate.ambient + step[lamps:],
            estimate.scaled + back[0] - back[1] @ step,
        )
        if largest < 1e-4:
            break
    return estimate


def _normal_equations(
    lights: Array, trust: Array, residual: Array, estimate: _Estimate
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Curvature (2 L, 2 L) and slope (2 L,) for strengths and ambient, the b_j eliminated.

    The third part gives the change of the b_j that belongs to a step: (N, 3) for no step, less
    (N, 3, 2 L) times the step.
    """
    shading = np.einsum("nlk,nk->nl", lights, estimate.scaled)
    albedo = np.linalg.norm(estimate.scaled, axis=1)
    normals = estimate.scaled / np.maximum(albedo, np.finfo(float).tiny)[:, None]
    by_normal = estimate.strength[:, None] * lights + estimate.ambient[:, None] * normals[:, None, :]
    weighted = by_normal * trust[..., None]
    inverse = np.linalg.inv(_bounded(np.swapaxes(weighted, 1, 2) @ by_normal))
    by_lamp = np.stack([shading, np.broadcast_to(albedo[:, None], shading.shape)])
    mixed = np.concatenate([np.swapaxes(weighted * part[..., None], 1, 2) for part in by_lamp], axis=2)
    alone = np.einsum("nlk,nl->nk", weighted, residual)
    solved = inverse @ mixed
    lamps = shading.shape[1]
    curvature = -np.tensordot(mixed, solved, axes=([0, 1], [0, 1]))
    for i, first in enumerate(by_lamp):
        for k, second in enumerate(by_lamp):
            block = curvature[i * lamps : (i + 1) * lamps, k * lamps : (k + 1) * lamps]
            block[np.diag_indices(lamps)] += (trust * first * second).sum(axis=0)
    slope = (trust * by_lamp * residual).sum(axis=1).ravel() - np.einsum("nkl,nk->l", solved, alone)
    return curvature, slope, ((inverse @ alone[..., None])[..., 0], solved)


def refine_by_photographs(tile: Tile, field: LightField, prior: float, scratch: Path) -> LightField:
    """Fit strengths and ambient light to a sample of the photographs, or the emission where it is stated.

    Raises
    ------
    TileError
        When the photographs cannot be read, or show too little.
    """
    with darkroom(tile, scratch) as room:
        if field.near and field.axes is not None:
            block = max(1, room.grid.columns // BLOCKS)
            means = average_blocks(room, block, ROWS)
            room.check()
            images = grey(means.images / field.power.astype(np.float32)[:, None, None, :])
            images[means.saturated | ~means.inside] = np.nan
            blocks = room.grid.reduced(block)
            return fit_emission_on_artwork(images, field, blocks.x(), blocks.y())
        every = max(1, int(np.sqrt(room.grid.rows * room.grid.columns / (8 * SAMPLES))))
        samples, vectors = [], []
        for start, stop in bands_of_grid(room.grid, len(field.lamps) * 36):
            raw = room.raw(start, stop, field)
            usable = raw.inside & ~raw.saturated.any(axis=0)
            rows, columns = np.nonzero(usable[::every, ::every])
            points = room.grid.points(start, stop)
            light = np.broadcast_to(field.vectors(points), (len(field.lamps), *usable.shape, 3))
            samples.append(grey(raw.images)[:, rows * every, columns * every])
            vectors.append(light[:, rows * every, columns * every])
        room.check()
    shown, light = np.concatenate(samples, axis=1), np.concatenate(vectors, axis=1)
    chosen = np.random.default_rng(0).permutation(shown.shape[1])[:SAMPLES]
    return refine(field, shown[:, chosen], light[:, chosen], prior)
