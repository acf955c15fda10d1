"""Positions of the lamps: they are fitted with the values that all pixels share, about what the stand's file says.

A flat holds the light of each lamp wherever it stands, so a position that is wrong by a millimetre hardly bends the
height by itself.  But under a lamp that stands elsewhere texture has another contrast, and where lamps are believed
to have changed, that is taken for a change.  Texture tells which of the two it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nlights_core.calibration import evidence
from nlights_core.calibration.linearisation import INDEPENDENT, Equations, in_parts
from nlights_core.calibration.reflectance import Reflectance
from nlights_core.calibration.sampling import Pixels, Samples, develop_pixels
from nlights_core.calibration.unknowns import Group, Shared, groups, prior
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.near_light.overview import ReducedRoom
from nlights_core.photographs.flat_fields import FlatField

SHIFT = 1.0
"""Shift of a lamp over which derivatives are taken, mm."""

NOISE_ALONE = 10_000
"""As how many independent pixels they count in the last fit, and in the uncertainty of what is the lamps': noise is
each pixel's own.  Formulas of gloss, and the flat, are wrong for all pixels alike: see `INDEPENDENT`."""

SETTLED = 100
"""Steps in which the width of the positions' errors is found; each is as cheap as one of these small matrices."""


class PositionedFit(NamedTuple):
    """Values of the shared unknowns, fitted together with the lamps' positions.

    Attributes
    ----------
    values : (M,) float64 array
        Of the shared unknowns.
    covariance : (S + 3 L, S + 3 L) float64 array
        Of what the equations are of.
    uncertainty : float
        Standard uncertainty of each coordinate, mm: as stated, or more where there is evidence of it.
    """

    values: Array
    covariance: Array
    uncertainty: float


def columns_of_positions(
    room: ReducedRoom,
    pixels: Pixels,
    lights: LightField,
    flat_field: FlatField,
    z: Array,
    scaled: Array,
    surface: Reflectance,
) -> Array:
    """Changes of what is predicted by a millimetre of each coordinate of each lamp, (N, L, 3 L).

    Parameters
    ----------
    room : ReducedRoom
    pixels : Pixels
        Those that have a say.
    lights, flat_field : LightField, FlatField
        Near lamps, and the flat as it is believed to be.
    z : (N,) array
        Heights, mm.
    scaled : (N, 3) float64 array
        Scaled normals.
    surface : Reflectance
        A highlight moves with its lamp.
    """
    here = develop_pixels(room, pixels, lights, flat_field, z)
    before, count = _predict(here, scaled, surface), len(here.images)
    more = np.zeros((len(scaled), count, count, 3))
    for axis in range(3):
        moved = replace(lights, positions=lights.positions + SHIFT * np.eye(3)[axis])
        there = develop_pixels(room, pixels, moved, flat_field, z)
        change = _change(here, there, before, _predict(there, scaled, surface)) / SHIFT
        for lamp in range(count):
            more[:, lamp, lamp, axis] = change[lamp]
    return more.reshape(len(scaled), count, -1)


def fit_with_positions(
    equations: Equations, shared: Shared, places: Array, free: tuple[int, ...], uncertainty: float
) -> PositionedFit:
    """Fit shared unknowns and the lamps' positions together.

    Parameters
    ----------
    equations : Equations
        Of the unknowns at ``places`` of the shared ones, and of each coordinate of each lamp behind them.
    shared : Shared
        Values that the equations were made with.
    places : (S,) int array
        The level (0) first.
    free : tuple of int
        Places of those that are fitted; the others keep their values.
    uncertainty : float
        Standard uncertainty of each coordinate as stated, mm.
    """
    vector = shared.vector()
    more = len(equations.right) - len(places)
    precisions, centres = prior(shared)
    precisions = np.append(precisions[places], np.full(more, uncertainty**-2))
    centres = np.append(centres[places], np.zeros(more))
    right = equations.right + equations.matrix @ np.append(vector[places], np.zeros(more))
    order = {place: number for number, place in enumerate(places.tolist())}
    positive = {place for group in groups(len(shared.strengths)) if group.positive for place in group.places}
    limited = Group("", tuple(order[place] for place in free if place in positive), True)
    always = [order[place] for place in free if place not in positive]
    always += range(len(places), len(places) + more)

    def fit() -> evidence.Found:
        return evidence.fit_groups(equations.matrix, right, precisions, centres, [limited], always)

    found = fit()
    # Where nothing is fitted the model does not fit at all, and says nothing of lamps.
    if more and free:
        uncertainty *= _wider(equations.matrix, right, precisions, centres, found.free, more)
        precisions[len(places) :] = uncertainty**-2
        found = fit()
    values = vector.copy()
    values[list(free)] = found.values[[order[place] for place in free]]
    # Of the lamps are their strengths, and what stands behind the shared unknowns.
    lamps = np.append((places >= 1) & (places <= len(shared.strengths)), np.ones(more, bool))
    less = np.sqrt(np.where(lamps, 1.0, INDEPENDENT / NOISE_ALONE))
    covariance = evidence.covariance_of(equations, precisions, found.free, less)
    # Heights are computed with the positions of the stand's file, whatever was found.
    last = np.arange(len(places), len(covariance))
    covariance[np.ix_(last, last)] = uncertainty**2 * np.eye(more)
    return PositionedFit(values, covariance, uncertainty)


def _wider(
    matrix: Array, right: Array, precisions: Array, centres: Array, free: Sequence[int], more: int
) -> float:
    """Factor by which the last ``more`` unknowns scatter more than stated; 1 without evidence.

    The width with the largest likelihood, by expectation and maximisation: each step asks how far the unknowns would
    be from what is stated if the width were that of the step before.  The pixels count as `INDEPENDENT`, as for all
    evidence: in photographs of many megapixels there is so little noise that what the model misses would tell.
    """
    places, less = np.array(free, np.intp), INDEPENDENT / NOISE_ALONE
    own, inner = precisions[places], less * matrix[np.ix_(places, places)]
    shifted = less * right[places] - inner @ centres[places]
    last = places >= len(right) - more

    def look(wide: float) -> tuple[float, float]:
        """Logarithm of the likelihood, and mean square over what is stated."""
        prior = own.copy()
        prior[last] /= wide**2
        inverse = np.linalg.inv(inner + np.diag(prior))
        values = inverse @ shifted
        likelihood = float(shifted @ values) + float(np.linalg.slogdet(inverse)[1] + np.log(prior).sum())
        square = (values[last] ** 2 + np.diag(inverse)[last]) * own[last]
        return likelihood / 2, float(square.mean())

    wide, (before, square) = 1.0, look(1.0)
    for _ in range(SETTLED):
        wide = float(np.sqrt(square))
        likelihood, square = look(wide)
    return wide if wide > 1 and likelihood - before > evidence.MARGIN else 1.0


def _change(here: Samples, there: Samples, before: Array, after: Array) -> Array:
    """Change of what is predicted less what is observed, (L, N); 0 where it is not known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change = after - before * np.where(here.images != 0, there.images / here.images, 1)
    return np.asarray(np.nan_to_num(change))


def _predict(samples: Samples, scaled: Array, surface: Reflectance) -> Array:
    """Readings of a surface, (L, N); NaN where its normal is not known."""
    from nlights_core.calibration.compiled_elimination import read_surface

    lights, views = (np.ascontiguousarray(a, np.float32) for a in (samples.lights, samples.views))
    readings = np.empty(samples.images.shape)

    def some(first: int, last: int) -> None:
        read_surface(
            lights, views, scaled, surface.gloss, surface.roughnesses, surface.grazing, surface.departure,
            first, last, readings,
        )  # fmt: skip

    in_parts(len(scaled), some)
    return readings
