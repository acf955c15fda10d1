"""Unknown surfaces: the gain of one photograph, beside the artwork's height and gloss, which nobody has told.

An artwork 15 mm above the plane of the flats reads some percent otherwise under each lamp, and varnish adds
its highlights.  Neither is a gain, but where they are not known either looks like one, or hides it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nlights_core.frames import Array
from nlights_core.reduced_light.explanations import Misfit
from nlights_core.reduced_light.places import places, unexplained
from nlights_core.reduced_light.relative_light import RelativeLight

EXPONENTS = (5.0, 15.0, 40.0, 100.0)
"""Of the highlights whose sum stands for gloss: satin to varnish, on paint that is flat but for its structure."""

FRESNEL = 0.04
"""Reflectance of varnish at normal incidence; Schlick's term has the rest."""

HEIGHT_DEVIATION = 15.0
"""Standard deviation of the height of artworks above the flats' plane, mm."""

HIGHEST = 60.0
"""Height within which it is looked for, mm."""

STEP = 3.0
"""Height over which the change of light is taken, mm."""

PARTS = (4, 6)
"""Parts of the artwork, down and across, whose places err alike."""

CERTAIN = 3.0
"""How many standard errors, from part to part, the next best photograph must explain less.  Sound captures reach
17, but with gains within 7 % of 1; a photograph at 0.8 of its exposure has 5 or more, under gloss on paint of
albedo 0.05 some 3 to 6."""

TWO = 0.5
"""What two gains must leave of what one leaves for it not to be one: where two photographs are at 0.7 they leave
0 to 0.5, or 0.6 and more under gloss on dark paint; beside the gain of a single one a second leaves 0.7 and more."""

ROUNDS = 4
"""In which height, gloss and the weights of places are found anew."""

TINY = 1e-12


class LoneGain(NamedTuple):
    """Gain of one photograph, and what is left to be explained once the surface is known.

    Attributes
    ----------
    lamp : int
    gain : float
        1: as it should be.
    light : (L, n) array
        Of the places, without gloss, the photograph at the level of the others.
    vectors : (L, n, 3) array
        At the artwork's height.
    """

    lamp: int
    gain: float
    light: Array
    vectors: Array


@dataclass(frozen=True)
class _Surface:
    """Places of an artwork, n of them, under L lamps: light relative to the flats and to its median.

    Attributes
    ----------
    relative : RelativeLight
    y, x : (n,) int arrays
    light, weights : (n, L) float32 arrays
    level : (n,) float32 array
        By which the light was divided.
    vectors : (L, n, 3) float32 array
        On the plane.
    """

    relative: RelativeLight
    y: Array
    x: Array
    light: Array
    weights: Array
    level: Array
    vectors: Array

    @property
    def part(self) -> Array:
        """Number of the part of the artwork that each place lies in, (n,) int."""
        _, rows, columns = self.relative.light.shape
        return np.asarray((self.y * PARTS[0] // rows) * PARTS[1] + self.x * PARTS[1] // columns)

    @property
    def near(self) -> bool:
        """Test whether the light changes with the height at all."""
        return self.relative.lights.near

    def points(self, height: float) -> Array:
        """Points seen at the places when the artwork lies so high, mm, (3, n, 1)."""
        grid = self.relative.grid
        rows = grid.rows
        # The whole grid is small: one point a sample.
        seen = grid.points(0, rows, np.full((rows, grid.columns), height, np.float32))
        return seen[:, self.y, self.x, None]

    def raw_vectors(self, height: float) -> Array:
        """Direction times irradiance of the lamps at such a height, (L, n, 3) float32."""
        lights = self.relative.lights
        chosen = [lights.lamps.index(lamp) for lamp in self.relative.lamps]
        found = lights.vectors(self.points(height))[chosen, :, 0]
        return np.broadcast_to(found, (len(chosen), len(self.y), 3))

    @cached_property
    def upright(self) -> Array:
        """Share of the lamps that the flat sees, (L, n, 1)."""
        return self.raw_vectors(0.0)[..., 2:]

    def at(self, height: float) -> Array:
        """Vectors that explain light relative to the flat at such a height, (L, n, 3)."""
        if not self.near:
            return self.vectors
        return np.asarray(self.raw_vectors(height) / self.upright)

    @cached_property
    def gloss(self) -> Array:
        """Highlights of a flat surface, one column for each exponent, (n, L, E)."""
        points = self.points(0.0)[..., 0]
        camera = self.relative.grid.camera
        view = np.array([0.0, 0.0, 1.0])[:, None] + 0 * points
        if camera is not None:
            view = _unit((np.asarray(camera)[:, None] - points).T).T
        lights = _unit(self.raw_vectors(0.0))
        half = _unit(lights + view.T)
        grazing = (1 - np.einsum("lni,lni->nl", half, lights)) ** 5
        upright = np.clip(half[..., 2].T, 0, 1)
        strength = (FRESNEL + (1 - FRESNEL) * grazing) * self.weights / self.level[:, None]
        return np.stack(
            [strength * (exponent + 8) / 8 * upright**exponent for exponent in EXPONENTS], axis=-1
        )


def gain_beside_surface(relative: RelativeLight) -> LoneGain | None:
    """Find the one photograph whose gain explains more than any other's, beside height and gloss.

    Parameters
    ----------
    relative : RelativeLight
        With flats.

    Returns
    -------
    LoneGain or None
        None where it is not certain which lamp it is.
    """
    y, x, light, vectors, weights = places(relative)
    level = np.maximum(np.nanmedian(np.where(weights > 0, light, np.float32(np.nan)), axis=0), TINY)
    surface = _Surface(relative, y, x, (light / level).T, weights.T, level, vectors)
    count, shines = len(light), len(EXPONENTS)
    height, gloss, changes = 0.0, np.zeros(shines), np.zeros(count)
    squares = np.ones(len(y))
    trust = np.ones(len(y))
    for _ in range(ROUNDS):
        columns = _columns(surface, height, gloss, changes)
        rest = columns[:, :, :count].sum(axis=2)
        for _ in range(2):
            # A part counts once: its places err alike.
            variance = float(trust @ squares) / trust.sum() / max(count - 3, 1)
            prior = variance * float(trust.sum()) / (PARTS[0] * PARTS[1] * HEIGHT_DEVIATION**2)
            misfit, others = _without_surface(columns, trust, count, prior, height)
            ranked = misfit.ranked(1, False, ())
            changes = ranked[0][2][:, 0]
            unknown = others(changes)
            squares = ((rest + columns @ np.r_[changes, unknown]) ** 2).sum(axis=1)
            trust = 1 / (1 + squares / max(float(np.median(squares)), TINY))
        gloss = -unknown[:shines]
        if surface.near:
            height = float(np.clip(height - unknown[-1], -HIGHEST, HIGHEST))
    lamp = ranked[0][1][0]
    if misfit.ranked(2, False, (lamp,))[0][0] < TWO * ranked[0][0]:
        return None
    for _, _, instead in ranked[1:]:
        worse = ((rest + columns @ np.r_[instead[:, 0], others(instead[:, 0])]) ** 2).sum(axis=1)
        if not _certain(trust * (worse - squares), surface.part):
            return None
    matt = (surface.light * (1 + changes) - surface.gloss @ gloss) * level[:, None]
    return LoneGain(lamp, float(1 / (1 + changes[lamp])), matt.T, surface.at(height))


def _columns(surface: _Surface, height: float, gloss: Array, changes: Array) -> Array:
    """Parts that a place does not explain by itself: of each lamp's light, of gloss, and of the height; (n, L, K)."""
    vectors = surface.at(height)
    free = unexplained(vectors, surface.weights.T)
    own = free * surface.light[:, None, :]
    shine = np.einsum("nij,njk->nik", free, surface.gloss)
    if not surface.near:
        return np.concatenate([own, shine], axis=2)
    matt = surface.light * (1 + changes) - surface.gloss @ gloss
    weighted = vectors * surface.weights.T[..., None]
    matrix = np.einsum("lni,lnj->nij", weighted, vectors) + 1e-6 * np.eye(3)
    normals = np.linalg.solve(matrix, np.einsum("lni,nl->ni", weighted, matt)[..., None])[..., 0]
    slope = (surface.at(height + STEP) - vectors) / STEP
    higher = np.einsum("lni,ni->nl", slope, normals) * surface.weights
    return np.concatenate([own, shine, np.einsum("nij,nj->ni", free, higher)[..., None]], axis=2)


def _without_surface(
    columns: Array, trust: Array, count: int, prior: float, height: float
) -> tuple[Misfit, Callable[[Array], Array]]:
    """Misfit of the lamps, whatever the surface is, and the surface that goes with some changes of theirs."""
    # One product of matrices of rows: places and lamps.
    flat = columns.reshape(-1, columns.shape[2]).astype(np.float64)
    weighted = flat * np.repeat(trust, columns.shape[1])[:, None]
    products = np.einsum("nk,nm->km", weighted, flat)
    vector = products[:, :count].sum(axis=1)
    matrix = products[count:, count:].copy()
    matrix += (1e-8 * np.trace(matrix) + TINY) * np.eye(len(matrix))
    right = vector[count:].copy()
    if len(matrix) > len(EXPONENTS):
        # The change of height that is fitted has the other sign.
        matrix[-1, -1] += prior
        right[-1] -= prior * height
    solved = np.linalg.solve(matrix, np.c_[products[count:, :count], right])
    across = products[:count, count:]
    misfit = Misfit(
        products[:count, :count] - across @ solved[:, :-1],
        vector[:count] - across @ solved[:, -1],
        float(vector[:count].sum() - right @ solved[:, -1]),
        count,
    )
    return misfit, lambda changes: -(solved[:, :-1] @ changes + solved[:, -1])


def _certain(more: Array, part: Array) -> bool:
    """Test whether something is more than nothing, from one part of the artwork to another."""
    sums = np.bincount(part, more, minlength=PARTS[0] * PARTS[1])
    sums = sums[np.bincount(part, minlength=len(sums)) > 0]
    if len(sums) < 2:
        return False
    error = np.sqrt(((sums - sums.mean()) ** 2).sum() * len(sums) / (len(sums) - 1))
    return bool(sums.sum() > CERTAIN * error)


def _unit(vectors: Array) -> Array:
    """Vectors along the last axis, made unit."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
