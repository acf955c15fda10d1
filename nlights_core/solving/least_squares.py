"""Weighted linear least squares for normals, in closed form over whole bands of pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field

from nlights_core.algorithms import PHOTONS, NormalSolver, Solution
from nlights_core.frames import Array

FORESEEN = 10.0
"""As how many further residuals the noise that was foreseen counts when a pixel's own residuals say
that there is more: a pixel of eight lights has only five to tell it by."""

COVERING = float(np.sqrt(-2 * np.log(1 - 0.68)))
"""Angle that covers 68 % of a round two-dimensional normal distribution, in standard deviations of one
of its two components."""


class UsableLights(NormalSolver):
    """A normal solver that fits by least squares to the lights that are usable in each pixel.

    Usable are those above shadow and below saturation; too few, or badly spread ones, leave the
    pixel unknown.  Subclass it to share these two options.
    """

    shadow: float = Field(
        default=0.02,
        ge=0,
        lt=1,
        description="samples below this share of the pixel's brightest are shadow; 0: none are",
    )
    condition: float = Field(
        default=100.0,
        gt=1,
        description="largest allowed ratio of the singular values of the usable lights",
    )


class Fit(NamedTuple):
    """A least-squares fit in every pixel.

    Attributes
    ----------
    scaled : (3, h, w) float64
        Albedo times normal; NaN where it could not be found.
    inverse : (6, h, w) float64
        Upper triangle of the inverse normal matrix: xx, xy, xz, yy, yz, zz.
    smallest : (h, w) float64
        Smallest eigenvalue of the normal matrix.
    """

    scaled: Array
    inverse: Array
    smallest: Array


def fit(images: Array, lights: Array, weights: Array, condition: float) -> Fit:
    """Solve ``min sum_i w_i (I_i - l_i . b)^2`` for b in every pixel.

    The 3 x 3 normal equations are inverted by cofactors (Cramer's rule): a batched library
    solve takes a hundred times as long (numerics, section 2).

    Parameters
    ----------
    images : (L, h, w) array
        Grey images; whatever stands where the weight is 0, even NaN, is ignored.
    lights : (L, h, w, 3) array, or broadcastable to it
        Direction times irradiance.
    weights : (L, h, w) array
        Weights of the squared residuals, 0 for a sample that is not used.
    condition : float
        Largest allowed ratio of the light matrix's singular values; beyond it the pixel is
        not known.

    Returns
    -------
    Fit
    """
    count = np.count_nonzero(weights > 0, axis=0)
    matrix, right = _normal_equations(images, lights, weights)
    inverse, smallest, well = _invert(matrix, condition)
    scaled = multiply(inverse, right)
    scaled[:, ~(well & (count >= 3))] = np.nan
    return Fit(scaled, inverse, smallest)


def _normal_equations(images: Array, lights: Array, weights: Array) -> tuple[Array, Array]:
    """Sums of ``w l l^T`` (upper triangles) and of ``w I l`` over the lights, float64."""
    shape = images.shape[1:]
    if lights.size == 3 * len(images):
        # No matrix product: it shares small work out to all cores, and waits long for busy ones.
        rays = lights.reshape(-1, 3).T.astype(np.float64)
        rows, columns = np.triu_indices(3)
        w = weights.astype(np.float64)
        values = w * np.where(weights > 0, images, 0)
        return np.einsum("kl,l...->k...", rays[rows] * rays[columns], w), np.einsum(
            "kl,l...->k...", rays, values
        )
    matrix, right = np.zeros((6, *shape)), np.zeros((3, *shape))
    for image, light, weight in zip(images, lights, weights, strict=True):
        w = weight.astype(np.float64)
        x, y, z = (light[..., k].astype(np.float64) for k in range(3))
        value = w * np.where(weight > 0, image, 0)
        wx, wy, wz = w * x, w * y, w * z
        for k, term in enumerate((wx * x, wx * y, wx * z, wy * y, wy * z, wz * z)):
            matrix[k] += term
        right[0] += value * x
        right[1] += value * y
        right[2] += value * z
    return matrix, right


def _invert(matrix: Array, condition: float) -> tuple[Array, Array, Array]:
    """Invert symmetric 3 x 3 matrices; also the smallest eigenvalues and which are well conditioned."""
    adjugate, determinant = adjugates(matrix)
    smallest, largest = eigenvalues(matrix)
    well = (smallest > 0) & (largest <= condition**2 * smallest) & (determinant > 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = adjugate / np.where(well, determinant, 1.0)
    return inverse, smallest, well


def adjugates(matrix: Array) -> tuple[Array, Array]:
    """Adjugates (6, ...) and determinants (...) of symmetric 3 x 3 matrices, upper triangles (6, ...)."""
    xx, xy, xz, yy, yz, zz = matrix
    adjugate = np.stack(
        [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ]
    )
    determinant = xx * adjugate[0] + xy * adjugate[1] + xz * adjugate[2]
    return adjugate, determinant


def eigenvalues(matrix: Array) -> tuple[Array, Array]:
    """Smallest and largest eigenvalue of symmetric 3 x 3 matrices, by the trigonometric formula.

    Parameters
    ----------
    matrix : (6, ...) float64 array
        Upper triangles: xx, xy, xz, yy, yz, zz.

    Returns
    -------
    smallest, largest : (...) float64 arrays

    Examples
    --------
    >>> smallest, largest = eigenvalues(np.array([3.0, 0, 0, 2.0, 0, 1.0]))
    >>> round(float(smallest), 12), round(float(largest), 12)
    (1.0, 3.0)
    """
    xx, xy, xz, yy, yz, zz = matrix
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.where(spread > 0, determinant / (2 * spread**3), 1.0)
    angle = np.arccos(np.clip(cosine, -1, 1)) / 3
    return mean + 2 * spread * np.cos(angle + 2 * np.pi / 3), mean + 2 * spread * np.cos(angle)


def multiply(symmetric: Array, vector: Array) -> Array:
    """Multiply symmetric 3 x 3 matrices (6, ...), upper triangles, with vectors (3, ...)."""
    xx, xy, xz, yy, yz, zz = symmetric
    x, y, z = vector
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])


def residual(image: Array, light: Array, scaled: Array) -> Array:
    """Residual of one light's image from the fit, (h, w) float64."""
    shown = sum(light[..., k] * scaled[k] for k in range(3))
    return np.asarray(image - shown)


def leverage(light: Array, weight: Array, inverse: Array) -> Array:
    """Leverage of one sample: how strongly it determines its own prediction, (h, w) float64 in 0..1."""
    direction = np.moveaxis(np.broadcast_to(light, (*inverse.shape[1:], 3)).astype(np.float64), -1, 0)
    return np.asarray(weight * np.sum(direction * multiply(inverse, direction), axis=0))


def solution(images: Array, lights: Array, weights: Array, found: Fit) -> Solution:
    """Split a fit into unit normal, albedo and the normal's uncertainty.

    The uncertainty follows from the covariance of the scaled normal, ``variance M^-1``, M being
    the normal matrix and the variance that of a sample of weight 1: the mean reading over
    `PHOTONS` where residuals are the noise that was foreseen, more where they are larger.

    Parameters
    ----------
    images, lights, weights : arrays
        As given to `fit`; weights in the unit of `nlights_core.algorithms.NormalSolver.solve`.
    found : Fit
        Its result.

    Returns
    -------
    Solution
        A fit with an albedo that is not positive, or whose normal points away from the
        camera, is not known.
    """
    albedo = np.sqrt(np.sum(found.scaled**2, axis=0))
    known = np.isfinite(albedo) & (albedo > 0) & (found.scaled[2] > 0)
    albedo = np.where(known, albedo, np.nan)
    normals = found.scaled / albedo
    return Solution(
        normals=np.moveaxis(normals, 0, -1).astype(np.float32),
        albedo=albedo.astype(np.float32),
        confidence=_uncertainty(images, lights, weights, found, normals, albedo).astype(np.float32),
        weights=np.where(known, weights, 0).astype(np.float32),
    )


def _uncertainty(
    images: Array, lights: Array, weights: Array, found: Fit, normals: Array, albedo: Array
) -> Array:
    """Angle that the normal is off by no more than in 68 % of all cases, degrees, (h, w)."""
    used = weights > 0
    missed = np.where(used, images - np.einsum("...k,k...->...", lights, found.scaled), 0.0)
    total = np.where(known := np.isfinite(albedo), weights.sum(axis=0, dtype=np.float64), 1)
    reading = np.einsum("l...,l...->...", weights, np.where(used, images - missed, 0)) / total
    foreseen = np.where(known, reading, np.nan) / PHOTONS
    surprise = np.einsum("l...,l...,l...->...", weights, missed, missed) / foreseen
    freedom = np.maximum(np.count_nonzero(used, axis=0) - 3, 0)
    variance = foreseen * (FORESEEN + surprise) / (FORESEEN + freedom)
    # What lies along the normal is the albedo's; the rest turns it.
    along = np.sum(normals * multiply(found.inverse, normals), axis=0)
    across = np.maximum(found.inverse[0] + found.inverse[3] + found.inverse[5] - along, 0)
    return np.asarray(np.degrees(COVERING * np.sqrt(variance * across / 2) / albedo))


def lit(images: Array, weights: Array, shadow: float) -> Array:
    """Weights without shadows: samples below a share of the pixel's brightest get 0.

    Parameters
    ----------
    images, weights : (L, h, w) arrays
    shadow : float
        Share of the pixel's brightest usable sample; 0 keeps all.

    Returns
    -------
    (L, h, w) float32 array
        A new array.
    """
    used = (weights > 0) & np.isfinite(images)
    if shadow == 0:
        return np.where(used, weights, 0).astype(np.float32)
    brightest = np.max(np.where(used, images, -np.inf), axis=0)
    return np.where(used & (images > shadow * brightest), weights, 0).astype(np.float32)
