"""Robust fits of normals: what disagrees with Lambert's law is given less weight, or none.

The functions take pixels in a row, (L, n), as `in_blocks` cuts them from a band; the functions
of `nlights_core.least_squares` take them too.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.least_squares import Fit, fit

BLOCK_SAMPLES = 40_000
"""Samples (pixels times lights) of a block: some arrays of them fit into the processor's cache, and
OpenBLAS leaves matrix products of 6 rows with them (below 2^18 multiplications) on their core."""

TUKEY = 4.685
"""Residual, in units of the scale, from which Tukey's biweight is 0; with Gaussian noise of known
scale it keeps 95 % of the efficiency of least squares (Holland and Welsch 1977)."""

SUSPICIOUS = 3.0
"""Least squares stand where no residual is larger than this, in units of the noise."""

ABSOLUTE_ROUNDS = 6
BIWEIGHT_ROUNDS = 3
"""Rounds of reweighting: twice as many change simulated and real scenes by about 1 %."""

DIMMEST = 0.02
"""Shading below which the noise is not taken to fall any further."""

DARKEST = 0.03
"""Albedo below which the noise is not taken to grow any further relative to it; so images in an
arbitrary small unit are not taken for noise."""

FEWEST = 5
"""With fewer lights no residual can tell which of them is wrong."""


def in_blocks(
    solve: Callable[[Array, Array, Array], Solution], images: Array, lights: Array, weights: Array
) -> Solution:
    """Solve a band by blocks of pixels, on all cores.

    Parameters
    ----------
    solve : callable
        Like `NormalSolver.solve`, but of pixels in a row: images and weights (L, n), lights
        (L, n, 3) or (L, 1, 3); the solution's shapes are (n, 3), (n,), (n,) and (L, n).
    images, lights, weights : arrays
        As `NormalSolver.solve` gets them.

    Returns
    -------
    Solution
        Of the whole band.
    """
    count, *shape = images.shape
    pixels = images[0].size
    shared = lights.shape[1:3] == (1, 1)
    rays = lights[:, 0] if shared else np.broadcast_to(lights, (count, *shape, 3)).reshape(count, pixels, 3)
    values, given = images.reshape(count, pixels), weights.reshape(count, pixels)
    normals = np.empty((pixels, 3), np.float32)
    albedo, confidence = np.empty((2, pixels), np.float32)
    used = np.empty((count, pixels), np.float32)
    size = max(BLOCK_SAMPLES // count, 1)

    def block(start: int) -> None:
        part = slice(start, start + size)
        found = solve(values[:, part], rays if shared else rays[:, part], given[:, part])
        normals[part], albedo[part], confidence[part] = found.normals, found.albedo, found.confidence
        used[:, part] = found.weights

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(block, range(0, pixels, size)))
    return Solution(
        normals.reshape(*shape, 3),
        albedo.reshape(shape),
        confidence.reshape(shape),
        used.reshape(images.shape),
    )


def known_or(first: tuple[Array, Fit], second: tuple[Array, Fit]) -> tuple[Array, Fit]:
    """Weights and fit of the first where it is known, of the second elsewhere.

    Parameters
    ----------
    first, second : tuple of (L, n) array and Fit
        Weights, and the fit made with them.

    Returns
    -------
    tuple of (L, n) array and Fit
    """
    known = np.isfinite(first[1].scaled[0])
    chosen = (np.where(known, a, b) for a, b in zip(first[1], second[1], strict=True))
    return np.where(known, first[0], second[0]), Fit(*chosen)


def rank_trimmed(images: Array, weights: Array, darkest: float, brightest: float) -> Array:
    """Weights without the darkest and the brightest share of each pixel's usable samples.

    Parameters
    ----------
    images, weights : (L, n) arrays
        Samples of weight 0 are not usable.
    darkest, brightest : float
        Of k usable samples those of rank ``floor(darkest k)`` up to, but without,
        ``floor((1 - brightest) k)`` are kept, and those equal to one of them.

    Returns
    -------
    (L, n) float32 array
        A new array.

    Examples
    --------
    >>> rank_trimmed(np.array([[3.0], [9.0], [1.0], [2.0]]), np.ones((4, 1)), 0.25, 0.25).ravel()
    array([1., 0., 0., 1.], dtype=float32)
    """
    used = weights > 0
    count = np.count_nonzero(used, axis=0)
    ordered = np.sort(np.where(used, images, np.inf), axis=0)
    first = np.floor(darkest * count).astype(np.intp)
    last = np.maximum(np.floor((1 - brightest) * count).astype(np.intp) - 1, 0)
    lowest = np.take_along_axis(ordered, first[None], axis=0)
    highest = np.take_along_axis(ordered, last[None], axis=0)
    kept = used & (images >= lowest) & (images <= highest)
    return np.where(kept, weights, 0).astype(np.float32)


def median_of_triplets(images: Array, lights: Array, weights: Array, most: int) -> Array:
    """Weighted median, component by component, of what all triplets of lights say.

    Least squares is the mean of the solutions of all triplets of lights i, j, k with the
    weights ``det(l_i, l_j, l_k)^2 w_i w_j w_k`` (Jacobi 1841).  This is the median with the same
    weights: a badly spread triplet counts little, one with an unusable light not at all.

    Parameters
    ----------
    images, lights, weights : (L, n), (L, n, 3) or (L, 1, 3), and (L, n) arrays
    most : int
        Of more triplets than this, a fixed random choice is used.

    Returns
    -------
    (3, n) float32 array
        Albedo times normal; NaN where no triplet is usable.
    """
    triplets = np.array(list(combinations(range(len(images)), 3)))
    if len(triplets) > most:
        triplets = triplets[np.sort(np.random.default_rng(0).permutation(len(triplets))[:most])]
    values = np.where(weights > 0, images, 0).astype(np.float32)
    rays = np.moveaxis(lights, -1, 1).astype(np.float32)
    said = np.empty((3, len(triplets), *images.shape[1:]), np.float32)
    shares = np.empty(said.shape[1:], np.float32)
    for t, (i, j, k) in enumerate(triplets):
        across = [_cross(rays[a], rays[b]) for a, b in ((j, k), (k, i), (i, j))]
        volume = np.sum(rays[i] * across[0], axis=0)
        total = values[i] * across[0] + values[j] * across[1] + values[k] * across[2]
        said[:, t] = total / np.where(volume == 0, np.float32(1), volume)
        shares[t] = volume**2 * weights[i] * weights[j] * weights[k]
    return np.stack([_weighted_median(component, shares) for component in said])


def _cross(a: Array, b: Array) -> Array:
    """Cross product of vectors along the first axis (numpy's takes five times as long)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _weighted_median(values: Array, weights: Array) -> Array:
    """Median along the first axis, each value counting by its weight; NaN without any."""
    order = np.argsort(values, axis=0)
    heaped = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middle = np.argmax(heaped >= heaped[-1] / 2, axis=0)
    chosen = np.take_along_axis(order, middle[None], axis=0)
    return np.where(heaped[-1] > 0, np.take_along_axis(values, chosen, axis=0)[0], np.nan)


def reweighted(
    images: Array, lights: Array, weights: Array, noise: float, condition: float
) -> tuple[Array, Fit]:
    """Least squares where they hold; elsewhere Tukey's biweight about the L1 fit.

    The standard deviation that a sample of albedo a and shading s is expected to have is that
    of photon noise, ``noise sqrt(a s / w)``.  Where a residual of least squares exceeds three
    of them, `ABSOLUTE_ROUNDS` of reweighting with ``1 / max(|u|, 1)``, u being the residual in
    standard deviations, approach the fit with the least sum of absolute residuals.  The scale
    is then the robust scale of u, at least 1; `BIWEIGHT_ROUNDS` with the weights
    ``(1 - (u / (4.685 scale))^2)^2``, 0 beyond, follow.  See [1]_, chapters 4 and 5.

    Parameters
    ----------
    images, lights, weights : (L, n), (L, n, 3) or (L, 1, 3), and (L, n) float32 arrays
        The weights without shadows.
    noise : float
        Standard deviation of a sample of weight 1 that reads 1.
    condition : float
        As for `nlights_core.least_squares.fit`.

    Returns
    -------
    weights : (L, n) float32 array
        0 for a sample that is discarded.
    fit : Fit
        The least-squares fit with them.

    References
    ----------
    .. [1] R. A. Maronna, R. D. Martin, V. J. Yohai, Robust Statistics, Wiley 2006.
    """
    plain = fit(images, lights, weights, condition)
    values = np.where(weights > 0, images, np.float32(0))
    start = plain.scaled.astype(np.float32)
    precision = _precision(lights, weights, start, noise)
    doubtful = np.max(_missed(values, lights, start, precision), axis=0) > SUSPICIOUS
    doubtful &= np.count_nonzero(weights > 0, axis=0) >= FEWEST
    if not doubtful.any():
        return weights, plain
    # Where all are, nothing needs to be copied.
    chosen = slice(None) if doubtful.all() else np.nonzero(doubtful)[0]
    rays = lights if lights.shape[1] == 1 else lights[:, chosen]
    values, given = values[:, chosen], weights[:, chosen]
    better = _biweighted(values, rays, given, precision[:, chosen], start[:, chosen])
    before = Fit(*(part[..., chosen] for part in plain))
    better, again = known_or((better, fit(values, rays, better, condition)), (given, before))
    out = weights.copy()
    out[:, chosen] = better
    for whole, part in zip(plain, again, strict=True):
        whole[..., chosen] = part
    return out, plain


def _shown(lights: Array, scaled: Array) -> Array:
    """What a fit predicts of every sample, (L, n) float32."""
    if lights.shape[1] == 1:
        return np.einsum("lk,kn->ln", lights[:, 0], scaled)
    return np.asarray(np.einsum("lnk,kn->ln", lights, scaled))


def _precision(lights: Array, weights: Array, scaled: Array, noise: float) -> Array:
    """Inverse of the standard deviation that each sample is expected to have, (L, n) float32.

    0 for a sample that is not used, or where the albedo is not known.  The square of the noise relative to the albedo a is
    ``noise^2 s / (a w)``, with the shading s and a not below `DIMMEST` and `DARKEST`.
    """
    albedo = np.sqrt(np.sum(scaled**2, axis=0))
    known = albedo > 0
    albedo = np.where(known, albedo, np.float32(1))
    shading = np.maximum(_shown(lights, scaled) / albedo, np.float32(DIMMEST))
    relative = np.float32(noise) * albedo / np.sqrt(np.maximum(albedo, np.float32(DARKEST)))
    return np.where(known, np.sqrt(weights / shading) / relative, np.float32(0))


def _biweighted(images: Array, lights: Array, weights: Array, precision: Array, start: Array) -> Array:
    """Weights by Tukey's biweight, (L, m) float32; see `reweighted`."""
    rays = np.moveaxis(lights, -1, 0).astype(np.float32)
    rows, columns = np.triu_indices(3)
    squares = rays[rows] * rays[columns]
    scaled = start
    for _ in range(ABSOLUTE_ROUNDS):
        missed = _missed(images, lights, scaled, precision)
        np.maximum(missed, np.float32(1), out=missed)
        scaled = _fitted(images, rays, squares, np.divide(weights, missed, out=missed))
    missed = _missed(images, lights, scaled, precision)
    reach = np.float32(TUKEY) * np.maximum(_scale(missed, weights > 0), np.float32(1))
    better = _tukey(missed, reach) * weights
    for _ in range(BIWEIGHT_ROUNDS - 1):
        scaled = _fitted(images, rays, squares, better)
        better = _tukey(_missed(images, lights, scaled, precision), reach) * weights
    return np.asarray(better)


def _missed(images: Array, lights: Array, scaled: Array, precision: Array) -> Array:
    """Absolute residuals in units of the expected noise, (L, m) float32."""
    shown = _shown(lights, scaled)
    np.subtract(images, shown, out=shown)
    np.abs(shown, out=shown)
    return np.multiply(shown, precision, out=shown)


def _tukey(missed: Array, reach: Array) -> Array:
    """Tukey's biweight, written over the absolute residuals; 0 from the reach on."""
    missed /= reach
    np.square(missed, out=missed)
    np.subtract(np.float32(1), missed, out=missed)
    np.maximum(missed, np.float32(0), out=missed)
    return np.square(missed, out=missed)


def _fitted(images: Array, rays: Array, squares: Array, weights: Array) -> Array:
    """A least-squares fit in single precision, good enough to weigh by, (3, m) float32."""
    values = weights * images
    if rays.shape[-1] == 1:
        matrix, right = (
            np.einsum("kl,ln->kn", squares[..., 0], weights),
            np.einsum("kl,ln->kn", rays[..., 0], values),
        )
    else:
        matrix = np.einsum("kln,ln->kn", squares, weights)
        right = np.einsum("kln,ln->kn", rays, values)
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = right
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    tiny = np.float32(np.finfo(np.float32).tiny)
    found = np.stack([a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z])
    return np.asarray(found / np.maximum(determinant, tiny))


def _scale(missed: Array, used: Array) -> Array:
    """Robust scale of the residuals of an L1 fit, (m,) float32.

    A fit of three unknowns makes three of the k residuals vanish.  The median of the others
    is the (k + 4) / 2 smallest of all; it is divided by the quantile that it is of normal
    noise's absolute values.
    """
    from scipy.special import ndtri

    count = np.count_nonzero(used, axis=0)
    middle = (count + 4) // 2
    ordered = np.sort(np.where(used, missed, np.float32(np.inf)), axis=0)
    median = np.take_along_axis(ordered, middle[None] - 1, axis=0)[0]
    # The r-th of m sorted uniform numbers is expected near r / (m + 1/2).
    share = (middle - 3) / (count - 2.5)
    return np.asarray(median / ndtri(0.5 + 0.5 * share).astype(np.float32))
