"""Photographs linearised about an offset of the height and strengths of the lamps: one step of levelling.

Normals and albedo are eliminated in every pixel: a residual is projected off what a change of the normal
could explain.  The loops are compiled where that is possible, and done by numpy where not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.photographs.development import Darkroom, Raw
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving import least_squares

STEP = 0.05
"""Difference of height that derivatives are taken over, mm."""

SHADOW = 0.05
CONDITION = 100.0


class Strip(NamedTuple):
    """Some rows of the photographs, their height (h, w), and what drifts have bent it by (L, h, w)."""

    raw: Raw
    height: Array
    bends: Array


@dataclass(frozen=True)
class Linearised:
    """The pixels of a strip, linearised about the present offset and strengths.

    Attributes
    ----------
    images, weights : (L, N) float64 arrays
        Grey samples, and how much each counts.
    lights : (L, N, 3) float32 array
        Relative to the flat field.
    by_offset : (L, N) float64 array
        By how much its residual grows per mm of offset.
    bends : (L, N) float64 array
        By what drifts bend the height, mm per unit of their logarithms.
    solution : (9, N) float64 array
        Albedo times normal, NaN where not known, and the upper triangle of the inverse normal matrix.
    surprise : (L, N) float64 array
        Residuals in standard deviations, without sign; NaN where a sample is not used.
    """

    images: Array
    lights: Array
    weights: Array
    by_offset: Array
    bends: Array
    solution: Array
    surprise: Array

    def reweighted(self, surprise: Array, limit: float) -> Linearised:
        """Solve again, samples counting the less the more they surprised (Cauchy's loss)."""
        weights = self.weights / (1 + (np.nan_to_num(surprise) / limit) ** 2)
        solution, surprise = _fit_normals(self.images, self.lights, weights)
        return replace(self, weights=weights, solution=solution, surprise=surprise)

    def sums(self, scale: float) -> tuple[Array, Array, int]:
        """Share of these pixels of the normal equations of offset and strengths.

        Parameters
        ----------
        scale : float
            Spread of the surprise.

        Returns
        -------
        matrix, right : (L + 1, L + 1) and (L + 1,) float64 arrays
        pixels : int
            How many are known.
        """
        size = len(self.images) + 1
        matrix, right = np.zeros((size, size)), np.zeros(size)
        if available():
            from nlights_core.near_light.compiled_overview import add_normal_equations

            samples = (self.images, self.lights, self.weights, self.by_offset, self.bends)
            known = add_normal_equations(*samples, self.solution, scale, matrix, right)
        else:
            known = self._add_sums(scale, matrix, right)
        return np.triu(matrix) + np.triu(matrix, 1).T, right, known

    def _add_sums(self, scale: float, matrix: Array, right: Array) -> int:
        """Add to the upper triangle of the matrix and to the right-hand side."""
        scaled, inverse = self.solution[:3], self.solution[3:]
        albedo = np.sqrt(np.sum(scaled**2, axis=0))
        known = np.isfinite(albedo)
        count = len(self.images)
        # One over the variance: photons make it grow with the albedo, the scale measures how much there is.
        weights = np.where(known, self.weights / (scale**2 * albedo), 0)
        lights = self.lights.astype(np.float64)
        residual = np.nan_to_num(_residuals(self.images, lights, scaled))
        shown = np.nan_to_num(self.images - residual)
        across = _off_normals(self.by_offset, lights, self.weights, inverse)
        across = np.where(known, np.nan_to_num(across), 0)
        # Products of by_offset, which a drift changes by its bend, with itself, residual and drifts.
        own = np.sum(weights * self.by_offset * across, axis=0)
        rest = np.sum(weights * across * residual, axis=0)
        mixed = -weights * across * shown
        matrix[0, 0], right[0] = np.sum(own), -np.sum(rest)
        # The inverse normal matrix times each light.
        turned = [least_squares.multiply(inverse, light.T) for light in lights]
        for k, bend in enumerate(self.bends):
            matrix[0, k + 1] = np.sum(mixed[k] - bend * own)
            right[k + 1] = np.sum(weights[k] * shown[k] * residual[k] + bend * rest)
            for m in range(k, count):
                # Of a change of lamp m, the share that turns the normal and so shows under lamp k.
                shared = np.sum(lights[k].T * turned[m], axis=0) * self.weights[m]
                off = (k == m) - np.where(known, shared, 0)
                other = self.bends[m]
                both = bend * mixed[m] + other * mixed[k] - bend * other * own
                matrix[k + 1, m + 1] = np.sum(weights[k] * shown[k] * off * shown[m] - both)
        return int(np.count_nonzero(known))


def linearise(
    room: Darkroom,
    lights: LightField,
    flat_field: FlatField,
    strip: Strip,
    offset: float,
    logarithms: Array,
    before: Array,
) -> Linearised:
    """Develop a strip at an offset and a little above, and solve it.

    Parameters
    ----------
    room, lights, flat_field : Darkroom, LightField, FlatField
        As for `nlights_core.near_light.levelling.find_level`.
    strip : Strip
        What is developed.
    offset : float
        Of the height, mm.
    logarithms, before : (L,) arrays
        Of the lamps' strengths, and of those with which the height was measured: what the others have bent
        it by is taken off it.
    """
    raw = strip.raw
    height = strip.height - np.einsum("l,lhw->hw", logarithms - before, strip.bends)
    factors = np.exp(-logarithms).astype(np.float32)[:, None, None]
    count = len(lights.lamps)

    def developed(z: float) -> tuple[Array, Array, Array]:
        band = room.develop(raw, lights, flat_field, (height + z).astype(np.float32))
        weights = np.where(np.isfinite(height), band.weights, 0)
        images = (band.grey * factors).astype(np.float64)
        rays = np.ascontiguousarray(np.broadcast_to(band.lights, (*images.shape, 3)))
        return images.reshape(count, -1), rays.reshape(count, -1, 3), weights.reshape(count, -1)

    # Weights are those at the offset itself: a sample is in shadow or not, however small the step.
    images, rays, weights = developed(offset)
    above, rays_above, _ = developed(offset + STEP)
    usable = least_squares.lit(images, weights, SHADOW).astype(np.float64)
    solution, surprise = _fit_normals(images, rays, usable)
    by_offset = _predict_changes(images, rays, above, rays_above, solution)
    bends = np.ascontiguousarray(strip.bends).reshape(count, -1)
    return Linearised(images, rays, usable, by_offset, bends, solution, surprise)


def _fit_normals(images: Array, lights: Array, weights: Array) -> tuple[Array, Array]:
    """`Linearised.solution` and `Linearised.surprise`."""
    if available():
        from nlights_core.near_light.compiled_overview import NORMAL, fit_normals

        solution, surprise = np.empty((NORMAL, images.shape[1])), np.empty(images.shape)
        fit_normals(images, lights, weights, CONDITION, solution, surprise)
        return solution, surprise
    found = least_squares.fit(images, lights, weights, CONDITION)
    albedo = np.sqrt(np.sum(found.scaled**2, axis=0))
    residual = _residuals(images, lights, found.scaled)
    with np.errstate(divide="ignore", invalid="ignore"):
        # By photons the variance is albedo over weight.
        surprise = np.where(weights > 0, np.abs(residual) * np.sqrt(weights / albedo), np.nan)
    return np.concatenate([found.scaled, found.inverse]), surprise


def _predict_changes(
    images: Array, lights: Array, above: Array, lights_above: Array, solution: Array
) -> Array:
    """`Linearised.by_offset`, 0 in pixels that are not known.

    A sample's noise is in its residual and would be in its change too, and their product has a mean:
    it was taken for 0.03 mm of height.  So it is the predicted images that are changed.
    """
    if available():
        from nlights_core.near_light.compiled_overview import predict_changes

        out = np.empty(images.shape)
        predict_changes(images, lights, above, lights_above, solution, STEP, out)
        return out
    shown = images - _residuals(images, lights, solution[:3])
    # What the other height does to the same photograph: its flat field is read elsewhere.
    brighter = np.divide(above, images, out=np.ones_like(images), where=images != 0)
    return np.nan_to_num(_residuals(shown * brighter, lights_above, solution[:3]) / STEP)


def _residuals(images: Array, lights: Array, scaled: Array) -> Array:
    return np.stack(
        [least_squares.residual(image, light, scaled) for image, light in zip(images, lights, strict=True)]
    )


def _off_normals(values: Array, lights: Array, weights: Array, inverse: Array) -> Array:
    """Part of some values in every pixel that no change of its normal could explain, (L, N)."""
    right = np.einsum("ln,lnk->kn", np.where(weights > 0, weights * values, 0), lights)
    scaled = least_squares.multiply(inverse, right)
    return _residuals(values, lights, scaled)
