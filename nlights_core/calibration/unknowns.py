"""Unknowns that all pixels of a tile share: their order, their groups, and what is believed of them beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from nlights_core.calibration.reflectance import (
    FLAT_LOBES,
    KINDS,
    NORMAL_REFLECTANCE,
    ROUGHNESSES,
    Reflectance,
    grazing,
)
from nlights_core.frames import Array

LEVEL_PRIOR = 5.0
"""Standard deviation of the surface's level about the plane of the flat, mm."""

STRENGTH_PRIOR, FREEDOM = 0.02, 3
"""Scale and degrees of freedom of Student's distribution of a lamp's change since the flats: lamps drift by a per
cent or two, but one may be replaced or touched.  A Gaussian of 1 % shrank the two patterns that look like a tilt."""

GLOSS_PRIOR = 1.0
"""Of the strength of each lobe; 1 is varnish.  With it many lobes are as stable as three."""

DEPARTURE_PRIOR = 0.3
"""Of the cross term: a roughness of 0.3 has 0.27, of 0.5 has 0.43."""

AMBIENT_PRIOR = 0.02
"""Of light that the dark frame lacks, and of the room's light, as shares of the mean flat."""

FLAT_GLOSS_PRIOR = 0.5
"""Of the lobes of the flat: it is made to be matt."""

LARGEST_LEVEL, LARGEST_STRENGTH = 8.0, 0.15
"""Steps of a round, mm and logarithm of the strength."""


class Group(NamedTuple):
    """Unknowns that are believed together.

    Attributes
    ----------
    name : str
    places : tuple of int
        Among the columns.
    positive : bool
        Whether none can be negative.
    """

    name: str
    places: tuple[int, ...]
    positive: bool


@dataclass(frozen=True)
class Shared:
    """Values that all pixels of a tile share.

    Attributes
    ----------
    level : float
        Mean height of the surface above the plane of the flat, mm.
    strengths : (L,) float64 array
        Logarithm of each lamp's strength in the frames against the flats.
    gloss : (K,) float64 array
        Strengths of the white lobes, of the kinds `nlights_core.calibration.reflectance.KINDS`.
    departure : float
        Share of the cross term of rough paint.
    additive, room : float
        Light that is in frames and flats but not in the dark frame, and light that the surface reflects; as
        shares of the mean flat.
    flat_gloss : (F,) float64 array
        The same of the flat, of the lobes `nlights_core.calibration.reflectance.FLAT_LOBES`.
    roughnesses : (K,) float64 array
        Alpha of each lobe of the surface; not an unknown, but moved when the gloss is roughly known.
    grazing : float
        See `nlights_core.calibration.reflectance.grazing`; the same holds for it.
    """

    level: float
    strengths: Array
    gloss: Array
    departure: float
    additive: float
    room: float
    flat_gloss: Array
    roughnesses: Array = field(default_factory=lambda: np.array(ROUGHNESSES))
    grazing: float = 1 - NORMAL_REFLECTANCE

    @property
    def reflectance(self) -> Reflectance:
        """The part that is the surface's."""
        return Reflectance(self.gloss, self.departure, self.roughnesses, self.grazing)

    def vector(self) -> Array:
        """All in one, in the order of the columns, (M,) float64."""
        return np.concatenate(
            [
                [self.level],
                self.strengths,
                self.gloss,
                [self.departure, self.additive, self.room],
                self.flat_gloss,
            ]
        )

    def moved(self, to: Array) -> Shared:
        """Approach what a vector says, by steps that are not too long."""
        found = from_vector(to, len(self.strengths))
        level = self.level + np.clip(found.level - self.level, -LARGEST_LEVEL, LARGEST_LEVEL)
        change = np.clip(found.strengths - self.strengths, -LARGEST_STRENGTH, LARGEST_STRENGTH)
        return replace(
            found,
            level=float(level),
            strengths=self.strengths + change,
            roughnesses=self.roughnesses,
            grazing=self.grazing,
        )


SMALLEST, LARGEST = 0.03, 0.8
"""Alpha that a lobe may have."""


def narrowed(shared: Shared, found: Mapping[str, Array], width: float) -> Shared:
    """Move the lobes of each kind close to where that kind, by itself, has the gloss; adapt Fresnel's term to it.

    Parameters
    ----------
    shared : Shared
        Present values; their gloss is handed on to the lobes nearby.
    found : mapping of str to (K,) float64 array
        Strengths of the lobes if the gloss is of one kind.
    width : float
        About how far from the middle lobes are put at least, as a logarithm.
    """
    logarithms, gloss = np.log(shared.roughnesses), np.zeros(len(KINDS))
    roughnesses = shared.roughnesses.copy()
    for kind, strengths in found.items():
        mine = np.flatnonzero(np.array(KINDS) == kind)
        weights = strengths[mine]
        if not weights.sum() > 0:
            continue
        middle = np.average(logarithms[mine], weights=weights)
        spread = np.sqrt(np.average((logarithms[mine] - middle) ** 2, weights=weights))
        # Two kinds of gloss on each other spread the lobes by themselves.
        reach = max(width, 1.5 * spread)
        places = np.clip(
            np.linspace(middle - reach, middle + reach, len(mine)), np.log(SMALLEST), np.log(LARGEST)
        )
        roughnesses[mine] = np.exp(places)
        for old in mine:
            at = np.interp(logarithms[old], places, np.arange(len(mine)))
            low = min(int(at), len(mine) - 2)
            gloss[mine[low]] += (low + 1 - at) * shared.gloss[old]
            gloss[mine[low + 1]] += (at - low) * shared.gloss[old]
    return replace(shared, gloss=gloss, roughnesses=roughnesses, grazing=grazing(float(gloss.sum())))


def nothing(lamps: int) -> Shared:
    """A matt surface in the plane of the flat, under lamps that have not changed."""
    return from_vector(np.zeros(4 + lamps + len(KINDS) + len(FLAT_LOBES)), lamps)


def from_vector(vector: Array, lamps: int) -> Shared:
    """Read what `Shared.vector` wrote."""
    lobes = len(KINDS)
    first = 1 + lamps
    departure, additive, room = (float(value) for value in vector[first + lobes : first + lobes + 3])
    return Shared(
        level=float(vector[0]),
        strengths=np.array(vector[1:first]),
        gloss=np.array(vector[first : first + lobes]),
        departure=departure,
        additive=additive,
        room=room,
        flat_gloss=np.array(vector[first + lobes + 3 :]),
    )


def groups(lamps: int) -> list[Group]:
    """Groups of unknowns beside the level, which is always one; of a name one at most is believed."""
    first, lobes = 1 + lamps, len(KINDS)
    rest = first + lobes
    return [
        Group("lamps", tuple(range(1, first)), False),
        *(Group("gloss", tuple(first + place for place in family), True) for family in _families()),
        Group("departure", (rest,), False),
        Group("ambient", (rest + 1, rest + 2), True),
        Group("flat-gloss", tuple(range(rest + 3, rest + 3 + len(FLAT_LOBES))), True),
    ]


def _families() -> list[tuple[int, ...]]:
    """Lobes of each kind by themselves, those without tails (Ward's is between them), and all together."""
    alone = [
        tuple(place for place, other in enumerate(KINDS) if other == kind) for kind in dict.fromkeys(KINDS)
    ]
    return [*alone, (*alone[1], *alone[2]), tuple(range(len(KINDS)))]


def prior(shared: Shared) -> tuple[Array, Array]:
    """Precisions of what is believed beforehand, and about which values.

    Returns
    -------
    precisions, centres : (M,) float64 arrays
    """
    strengths = shared.strengths
    middle = np.full(len(strengths), np.median(strengths))
    scatter = FREEDOM * STRENGTH_PRIOR**2 + (strengths - middle) ** 2
    precisions = np.concatenate(
        [
            [LEVEL_PRIOR**-2],
            (FREEDOM + 1) / scatter,
            np.full(len(KINDS), GLOSS_PRIOR**-2),
            [DEPARTURE_PRIOR**-2, AMBIENT_PRIOR**-2, AMBIENT_PRIOR**-2],
            np.full(len(FLAT_LOBES), FLAT_GLOSS_PRIOR**-2),
        ]
    )
    centres = np.zeros(len(precisions))
    centres[1 : 1 + len(strengths)] = middle
    return precisions, centres
