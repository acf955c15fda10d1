"""Mixtures: each photograph as that mixture of the others which comes closest to it, place by place.

Fine structure of paint and of a rough surface is little more than three numbers a place, whatever the lamps do: how
bright the paint is and how it slopes.  Under gloss, and where it is dark, how each photograph depends on them is not
known beforehand, but it is much the same over some centimetres: so the photographs themselves tell how one is mixed
from the others.  A photograph that moved is no such mixture; what is left of it goes with its gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array
from nlights_core.movement.fine_structure import FineStructure
from nlights_core.reduced_light.relative_light import FEWEST

EDGE, SAMPLES = 64, 32
"""Edge of the cells over which a mixture is the same, px, and at least so many samples: many more than lamps."""

RIDGE = 1e-3
"""Of the typical power of a photograph, what keeps photographs that are all alike from mixing at random."""

TINY = 1e-30


@dataclass(frozen=True)
class Departure:
    """Departure of one photograph from the mixture of the others, and how it goes with the mixture's gradients.

    Attributes
    ----------
    sums : (n, 2, 3) float64 array
        For n cells: products of the mixture's gradients to the right and downwards with what is left of the
        photograph, and with what is left of its own two gradients, per px.
    places : (n, 2) float array
        Row and column of each cell's middle, px.
    """

    sums: Array
    places: Array

    @property
    def step(self) -> Array:
        """Movement that explains most, (2,): right and down, px."""
        sums = self.sums.sum(axis=0)
        return np.asarray(-np.linalg.pinv(sums[:, 1:], rcond=1e-6) @ sums[:, 0])

    @property
    def size(self) -> float:
        """Length of the step, px."""
        return float(np.hypot(*self.step))

    @property
    def error(self) -> float:
        """Standard error of the step, found from cell to cell, px."""
        if len(self.sums) < 2:
            return float("inf")
        steps = self._rests() @ np.linalg.pinv(self.sums[:, :, 1:].sum(axis=0)).T
        return float(np.sqrt((steps**2).sum() * len(steps) / (len(steps) - 1)))

    def quarters(self) -> list[Departure]:
        """The same of each quarter of the photographs, but for those of which nothing is known."""
        if not len(self.sums):
            return []
        lower = self.places[:, 0] > np.median(self.places[:, 0])
        right = np.zeros(len(lower), bool)
        for half in (lower, ~lower):
            if half.any():
                right[half] = self.places[half, 1] > np.median(self.places[half, 1])
        chosen = [2 * lower + right == quarter for quarter in range(4)]
        return [Departure(self.sums[some], self.places[some]) for some in chosen if some.any()]

    def _rests(self) -> Array:
        """Rest that each cell has left against the common step, (n, 2)."""
        return np.asarray(self.sums[:, :, 0] + self.sums[:, :, 1:] @ self.step)


def departures(structures: Sequence[tuple[FineStructure, int]]) -> list[Departure]:
    """Departures of all photographs, from fine structures of several sizes of details.

    Parameters
    ----------
    structures : sequence of (FineStructure, int)
        With the edge of their samples, px.

    Returns
    -------
    list of Departure
        One of each photograph.
    """
    lamps = structures[0][0].lamps
    parts = [_of_one_size(*one) for one in structures]
    return [
        Departure(
            *(np.concatenate([getattr(part[lamp], name) for part in parts]) for name in ("sums", "places"))
        )
        for lamp in range(lamps)
    ]


def _of_one_size(structure: FineStructure, scale: int) -> list[Departure]:
    count = structure.lamps
    if not len(structure.sizes):
        return [Departure(np.zeros((0, 2, 3)), np.zeros((0, 2)))] * count
    grams, included, places, sizes = _in_cells(structure, max(EDGE, SAMPLES * scale))
    gradients = np.r_[np.ones(count), np.full(2 * count, 1 / scale)]
    grams = grams * np.outer(gradients, gradients)
    inverse = np.linalg.inv(_regular(grams, included))
    found = []
    for lamp in range(count):
        some = included[:, lamp] & (included.sum(axis=1) >= FEWEST)
        sums, left = _of_lamp(grams[some], inverse[some], lamp)
        # What is left of the photograph there is noise, gloss, or its movement.
        weights = sizes[some] / (left + (np.median(left) if len(left) else 0) + TINY)
        found.append(Departure(sums * weights[:, None, None], places[some]))
    return found


def _in_cells(structure: FineStructure, edge: int) -> tuple[Array, Array, Array, Array]:
    """Sums over the tiles of each cell, lamps that all of them have, and the cells' middles and samples."""
    corners = (structure.places // edge).astype(np.intp)
    _, cell = np.unique(corners, axis=0, return_inverse=True)
    cell = cell.ravel()
    count, lamps = int(cell.max()) + 1, structure.lamps
    included = np.ones((count, lamps), bool)
    np.logical_and.at(included, cell, np.diagonal(structure.freedom, axis1=1, axis2=2) > 0)
    grams = np.zeros((count, 3 * lamps, 3 * lamps))
    np.add.at(grams, cell, structure.grams)
    three = np.tile(included, (1, 3))
    grams *= three[:, :, None] & three[:, None, :]
    tiles = np.bincount(cell)
    places = np.stack([np.bincount(cell, middle) / tiles for middle in structure.places.T], axis=1)
    return grams, included, places, np.bincount(cell, structure.sizes)


def _regular(grams: Array, included: Array) -> Array:
    """Products of the photographs in every cell, (n, L, L), that can be inverted."""
    count = included.shape[1]
    light = grams[:, :count, :count]
    power = np.trace(light, axis1=1, axis2=2) / np.maximum(included.sum(axis=1), 1)
    # Lamps that a cell leaves out have no power there, and no part in a mixture.
    apart = np.where(included, RIDGE * power[:, None] + TINY, 1.0)
    return np.asarray(light + np.eye(count) * apart[:, None])


def _of_lamp(grams: Array, inverse: Array, lamp: int) -> tuple[Array, Array]:
    """Sums of one photograph's departure in every cell, (n, 2, 3), and what is left of the photograph, (n,)."""
    count = inverse.shape[1]
    rest = inverse[:, :, lamp] / inverse[:, lamp, lamp, None]
    mixture = -rest
    mixture[:, lamp] = 0
    # Products of the mixture's two gradients with all photographs and gradients.
    blocks = grams.reshape(len(grams), 3, count, 3 * count)[:, 1:]
    slopes = np.einsum("nj,ndjk->ndk", mixture, blocks)
    # Of the others alone: the inverse without this lamp.
    others = inverse - inverse[:, :, lamp, None] * rest[:, None, :]
    own = grams[:, :count][:, :, [count + lamp, 2 * count + lamp]]
    explained = slopes[:, :, :count] @ (others @ own)
    gradients = slopes[:, :, [count + lamp, 2 * count + lamp]] - explained
    departing = np.einsum("ndk,nk->nd", slopes[:, :, :count], rest)
    left = np.einsum("nk,nk->n", grams[:, lamp, :count], rest)
    return np.concatenate([departing[:, :, None], gradients], axis=2), left


def disorder(structures: Sequence[tuple[FineStructure, int]]) -> float:
    """Logarithm of how much the photographs differ from mixtures of each other, the less the better they lie.

    It is that of the volume which their fine structure spans, summed over cells of several sizes of details.
    """
    total = 0.0
    for structure, scale in structures:
        if len(structure.sizes):
            grams, included, _, sizes = _in_cells(structure, max(EDGE, SAMPLES * scale))
            volumes = np.linalg.slogdet(_regular(grams, included))[1]
            total += float(volumes @ sizes)
    return total
