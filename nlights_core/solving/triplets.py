"""Triplets of lights: each determines a normal, and the median of them outvotes a wrong light.

The functions take pixels in a row, as those of `nlights_core.solving.robust_fitting` do.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np

from nlights_core.frames import Array


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
    triplets = chosen_triplets(len(images), most)
    values = np.where(weights > 0, images, 0).astype(np.float32)
    rays = np.moveaxis(lights, -1, 1).astype(np.float32)
    said = np.empty((3, len(triplets), *images.shape[1:]), np.float32)
    shares = np.empty(said.shape[1:], np.float32)
    for t, (i, j, k) in enumerate(triplets):
        # Cramer's rule: what multiplies the values of lights i, j and k, over the volume that the three span.
        across = [_cross(rays[a], rays[b]) for a, b in ((j, k), (k, i), (i, j))]
        volume = np.sum(rays[i] * across[0], axis=0)
        total = values[i] * across[0] + values[j] * across[1] + values[k] * across[2]
        said[:, t] = total / np.where(volume == 0, np.float32(1), volume)
        shares[t] = volume**2 * weights[i] * weights[j] * weights[k]
    return np.stack([_weighted_median(component, shares) for component in said])


@lru_cache(maxsize=8)
def chosen_triplets(count: int, most: int) -> Array:
    """All triplets of so many lights, or a fixed random choice of ``most``: places, (T, 3) int64."""
    triplets = np.array(list(combinations(range(count), 3)), np.int64).reshape(-1, 3)
    if len(triplets) > most:
        triplets = triplets[np.sort(np.random.default_rng(0).permutation(len(triplets))[:most])]
    return triplets


def _cross(a: Array, b: Array) -> Array:
    """Cross product of vectors along the first axis (numpy's takes five times as long)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _weighted_median(values: Array, weights: Array) -> Array:
    """Median along the first axis, each value counting by its weight; NaN without any."""
    order = np.argsort(values, axis=0)
    heaped = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    # The first value up to which there is half of all weights.
    middle = np.argmax(heaped >= heaped[-1] / 2, axis=0)
    chosen = np.take_along_axis(order, middle[None], axis=0)
    return np.where(heaped[-1] > 0, np.take_along_axis(values, chosen, axis=0)[0], np.nan)
