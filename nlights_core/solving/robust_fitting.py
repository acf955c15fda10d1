"""Robust fits of normals: what disagrees with Lambert's law is given less weight, or none.

The functions take pixels in a row, (L, n), as `in_blocks` cuts them from a band; the functions
of `nlights_core.solving.least_squares` take them too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nlights_core.algorithms import PHOTONS, Solution
from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.solving.least_squares import Fit, adjugates, fit

BLOCK_SAMPLES = 1 << 18
"""Samples (pixels times lights) of a block: an array of them is 1 MB, so some of them fit into the
processor's cache, and two threads seldom wait for each other."""

TUKEY = 4.685
"""Residual, in units of the scale, from which Tukey's biweight is 0; with Gaussian noise of known
scale it keeps 95 % of the efficiency of least squares (Holland and Welsch 1977)."""

SUSPICIOUS = 3.0
"""Least squares stand where no residual is larger than this, in units of the noise."""

ABSOLUTE_ROUNDS = 8
BIWEIGHT_ROUNDS = 2
"""Rounds of reweighting: more change the errors on simulated and real scenes by less than 1 %."""

DARKEST = 0.03
"""Albedo below which the noise is not taken to grow any further relative to it; so images in an
arbitrary small unit are not taken for noise."""

MODEL_ERROR = 0.003
"""Share of a reading that lamps and flat field are not known better than, besides the noise."""

FEW = 16
"""With more lights none has a leverage by which it alone decides the fit."""

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
    # Rows and columns become one: pixels stand for themselves.
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

    for _ in in_order(block, range(0, pixels, size)):
        pass
    return Solution(
        normals.reshape(*shape, 3),
        albedo.reshape(shape),
        confidence.reshape(shape),
        used.reshape(images.shape),
    )


def fit_fewer(
    images: Array, lights: Array, fewer: Array, usable: Array, condition: float
) -> tuple[Array, Fit]:
    """Fit with fewer samples, or with all usable ones where the fewer do not determine a normal.

    Parameters
    ----------
    images, lights : (L, n), (L, n, 3) or (L, 1, 3) arrays
    fewer, usable : (L, n) arrays
        Weights.
    condition : float
        As for `nlights_core.solving.least_squares.fit`.

    Returns
    -------
    weights : (L, n) array
        Those that were used.
    fit : Fit
    """
    found = fit(images, lights, fewer, condition)
    lost = np.nonzero(np.isnan(found.scaled[0]))[0]
    if not lost.size:
        return fewer, found
    rays = lights if lights.shape[1] == 1 else lights[:, lost]
    again = fit(images[:, lost], rays, usable[:, lost], condition)
    kept = fewer.copy()
    kept[:, lost] = usable[:, lost]
    # Scaled normal, inverse and smallest eigenvalue alike; pixels are their last axis.
    for whole, part in zip(found, again, strict=True):
        whole[..., lost] = part
    return kept, found


def trim_by_rank(images: Array, weights: Array, darkest: float, brightest: float) -> Array:
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
    >>> trim_by_rank(np.array([[3.0], [9.0], [1.0], [2.0]]), np.ones((4, 1)), 0.25, 0.25).ravel()
    array([1., 0., 0., 1.], dtype=float32)
    """
    used = weights > 0
    count = np.count_nonzero(used, axis=0)
    # Samples that are not usable come last, past all ranks that are asked for.
    ordered = np.sort(np.where(used, images, np.inf), axis=0)
    first = np.floor(darkest * count).astype(np.intp)
    last = np.maximum(np.floor((1 - brightest) * count).astype(np.intp) - 1, 0)
    lowest = np.take_along_axis(ordered, first[None], axis=0)
    highest = np.take_along_axis(ordered, last[None], axis=0)
    kept = used & (images >= lowest) & (images <= highest)
    return np.where(kept, weights, 0).astype(np.float32)


def reweigh(images: Array, lights: Array, weights: Array, condition: float) -> tuple[Array, Fit]:
    """Least squares where they hold; elsewhere Tukey's biweight about the L1 fit.

    The variance that a sample is expected to have at an albedo a is that of photon noise and of an
    imperfect model, ``a / (w PHOTONS) + (MODEL_ERROR a)^2``.  Where a residual of least squares
    exceeds three standard deviations,
    `ABSOLUTE_ROUNDS` of reweighting with ``1 / max(|u|, 1)``, u being the residual in standard
    deviations, approach the fit with the least sum of absolute residuals.  Such a fit follows a
    wrong light of high leverage, so with few lights a fit without the light that the others
    predict worst is tried too, and the one with the smaller robust scale of u is taken
    (S-estimation).  `BIWEIGHT_ROUNDS` with the weights ``(1 - (u / (4.685 scale))^2)^2``, 0
    beyond, follow; the scale is at least 1.  See [1]_, chapters 4 and 5.

    Parameters
    ----------
    images, lights, weights : (L, n), (L, n, 3) or (L, 1, 3), and (L, n) float32 arrays
        The weights without shadows.
    condition : float
        As for `nlights_core.solving.least_squares.fit`.

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
    values = np.where(weights > 0, images, np.float32(0))
    # Where the lights do not determine a normal the sums are senseless; `fit` finds that out.
    with np.errstate(all="ignore"):
        rays, squares = _light_products(lights)
        start = _fit_single_precision(values, rays, squares, weights)
        precision = _precision(weights, start)
        doubtful = np.max(_standardised_residuals(values, lights, start, precision), axis=0) > SUSPICIOUS
        doubtful &= np.count_nonzero(weights > 0, axis=0) >= FEWEST
        chosen = np.nonzero(doubtful)[0]
        better = weights
        if chosen.size == doubtful.size:
            # Where all are doubtful, nothing needs to be copied.
            better = _reweigh_by_biweight(values, lights, weights, precision, start)
        elif chosen.size:
            some = lights if lights.shape[1] == 1 else lights[:, chosen]
            better = weights.copy()
            better[:, chosen] = _reweigh_by_biweight(
                values[:, chosen], some, weights[:, chosen], precision[:, chosen], start[:, chosen]
            )
    return fit_fewer(images, lights, better, weights, condition)


def _predict(lights: Array, scaled: Array) -> Array:
    """Prediction of every sample by a fit, (L, n) float32.

    ``einsum`` and no matrix product, as in `least_squares`: those share small work out to
    all cores and wait for them.
    """
    if lights.shape[1] == 1:
        return np.asarray(np.einsum("lk,kn->ln", lights[:, 0], scaled))
    return np.asarray(np.einsum("lnk,kn->ln", lights, scaled))


def _precision(weights: Array, scaled: Array) -> Array:
    """Inverse of the standard deviation that each sample is expected to have, (L, n) float32.

    0 for a sample that is not used, or where the albedo is not known.
    """
    albedo = np.sqrt(np.sum(scaled**2, axis=0))
    # Variance of a sample of weight 1; of the model's error it is the weight's multiple, divided out below.
    photons = albedo**2 / np.maximum(albedo, np.float32(DARKEST)) / np.float32(PHOTONS)
    variance = photons + weights * np.square(np.float32(MODEL_ERROR) * albedo)
    known = albedo > 0
    return np.where(known, np.sqrt(weights / np.where(known, variance, 1)), np.float32(0))


def _light_products(lights: Array) -> tuple[Array, Array]:
    """Lights (3, L, n) and their products xx, xy, xz, yy, yz, zz (6, L, n), float32; n may be 1."""
    rays = np.moveaxis(lights, -1, 0).astype(np.float32)
    rows, columns = np.triu_indices(3)
    return rays, np.asarray(rays[rows] * rays[columns])


def _reweigh_by_biweight(
    images: Array, lights: Array, weights: Array, precision: Array, start: Array
) -> Array:
    """Weights by Tukey's biweight, (L, m) float32; see `reweigh`."""
    rays, squares = _light_products(lights)
    scaled = start
    for _ in range(ABSOLUTE_ROUNDS):
        missed = _standardised_residuals(images, lights, scaled, precision)
        # Weights 1 / max(|u|, 1), over their own residuals.
        np.maximum(missed, np.float32(1), out=missed)
        scaled = _fit_single_precision(images, rays, squares, np.divide(weights, missed, out=missed))
    missed = _standardised_residuals(images, lights, scaled, precision)
    scale = _scale(missed, weights > 0)
    # The L1 fit follows a wrong light of high leverage; the smaller scale tells which fit is the better one.
    if len(images) <= FEW:
        other = _residuals_without_worst(images, lights, weights, precision, start)
        other_scale = _scale(other, weights > 0)
        missed = np.where(other_scale < scale, other, missed)
        scale = np.minimum(scale, other_scale)
    reach = np.float32(TUKEY) * np.maximum(scale, np.float32(1))
    better = _tukey(missed, reach) * weights
    for _ in range(BIWEIGHT_ROUNDS - 1):
        scaled = _fit_single_precision(images, rays, squares, better)
        better = _tukey(_standardised_residuals(images, lights, scaled, precision), reach) * weights
    return np.asarray(better)


def _residuals_without_worst(
    images: Array, lights: Array, weights: Array, precision: Array, start: Array
) -> Array:
    """Absolute residuals of the fit without the sample that the others predict worst, (L, m) float32.

    The square of a sample's residual, divided by 1 - leverage, is by how much the sum of
    squares falls without it.
    """
    rays, squares = _light_products(lights)
    inverse = _inverse(_sums(squares, weights))
    # Leverages of samples of weight 1: elements beside the diagonal count twice.
    own = np.einsum("kln,kn->ln", squares, inverse * np.array([1, 2, 2, 1, 2, 1], np.float32)[:, None])
    fall = _standardised_residuals(images, lights, start, precision) ** 2 / np.maximum(
        1 - weights * own, np.float32(0.01)
    )
    fewer = weights.copy()
    np.put_along_axis(fewer, np.argmax(fall, axis=0)[None], 0, axis=0)
    return _standardised_residuals(
        images, lights, _fit_single_precision(images, rays, squares, fewer), precision
    )


def _standardised_residuals(images: Array, lights: Array, scaled: Array, precision: Array) -> Array:
    """Absolute residuals in units of the expected noise, (L, m) float32."""
    shown = _predict(lights, scaled)
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


def _fit_single_precision(images: Array, rays: Array, squares: Array, weights: Array) -> Array:
    """A least-squares fit in single precision, good enough to weigh by, (3, m) float32."""
    xx, xy, xz, yy, yz, zz = _inverse(_sums(squares, weights))
    x, y, z = _sums(rays, weights * images)
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])


def _sums(terms: Array, weights: Array) -> Array:
    """Weighted sums over the lights of terms (k, L, m) or (k, L, 1), (k, m) float32."""
    if terms.shape[-1] == 1:
        return np.asarray(np.einsum("kl,ln->kn", terms[..., 0], weights))
    return np.asarray(np.einsum("kln,ln->kn", terms, weights))


def _inverse(matrix: Array) -> Array:
    """Inverses of symmetric 3 x 3 matrices (6, m) of positive determinant, upper triangles."""
    adjugate, determinant = adjugates(matrix)
    return np.asarray(adjugate / np.maximum(determinant, np.float32(np.finfo(np.float32).tiny)))


def _scale(missed: Array, used: Array) -> Array:
    """Robust scale of the residuals of an L1 fit, (m,) float32.

    A fit of three unknowns makes three of the k residuals vanish.  The median of the others
    is the (k + 4) / 2 smallest of all; it is divided by the quantile that it is of normal
    noise's absolute values.
    """
    count = np.count_nonzero(used, axis=0)
    middle = (count + 4) // 2
    ordered = np.sort(np.where(used, missed, np.float32(np.inf)), axis=0)
    # Ranks count from 1, places from 0.
    median = np.take_along_axis(ordered, middle[None] - 1, axis=0)[0]
    return np.asarray(median / scale_quantiles(len(used))[count])


def scale_quantiles(most: int) -> Array:
    """Quantile of normal noise's absolute values that `_scale` divides by, by the number of lights.

    Parameters
    ----------
    most : int
        Largest number of lights.

    Returns
    -------
    (most + 1,) float32 array
        NaN below `FEWEST`.
    """
    from scipy.special import ndtri

    count = np.arange(most + 1)
    # The r-th of m sorted uniform numbers is expected near r / (m + 1/2).
    # Rank of the median among the k - 3 residuals that do not vanish, over k - 3 + 1/2.
    share = ((count + 4) // 2 - 3) / (count - 2.5)
    return np.where(count >= FEWEST, ndtri(0.5 + 0.5 * share), np.nan).astype(np.float32)
