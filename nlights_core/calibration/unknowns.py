"""Unknowns that all pixels of a tile share: their order, their groups, and what is believed of them beforehand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nlights_core.calibration.reflectance import FLAT_LOBES, LOBES, Reflectance
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
        Strengths of the white lobes of `nlights_core.calibration.reflectance.LOBES`.
    departure : float
        Share of the cross term of rough paint.
    additive, room : float
        Light that is in frames and flats but not in the dark frame, and light that the surface reflects; as
        shares of the mean flat.
    flat_gloss : (K,) float64 array
        The same of the flat; only `nlights_core.calibration.reflectance.FLAT_LOBES` are not 0.
    """

    level: float
    strengths: Array
    gloss: Array
    departure: float
    additive: float
    room: float
    flat_gloss: Array

    @property
    def reflectance(self) -> Reflectance:
        """The part that is the surface's."""
        return Reflectance(self.gloss, self.departure)

    def vector(self) -> Array:
        """All in one, in the order of the columns, (M,) float64."""
        return np.concatenate(
            [
                [self.level],
                self.strengths,
                self.gloss,
                [self.departure, self.additive, self.room],
                self.flat_gloss[list(FLAT_LOBES)],
            ]
        )

    def moved(self, to: Array) -> Shared:
        """Approach what a vector says, by steps that are not too long."""
        found = from_vector(to, len(self.strengths))
        level = self.level + np.clip(found.level - self.level, -LARGEST_LEVEL, LARGEST_LEVEL)
        change = np.clip(found.strengths - self.strengths, -LARGEST_STRENGTH, LARGEST_STRENGTH)
        return replace(found, level=float(level), strengths=self.strengths + change)


def nothing(lamps: int) -> Shared:
    """A matt surface in the plane of the flat, under lamps that have not changed."""
    return from_vector(np.zeros(4 + lamps + len(LOBES) + len(FLAT_LOBES)), lamps)


def from_vector(vector: Array, lamps: int) -> Shared:
    """Read what `Shared.vector` wrote."""
    lobes = len(LOBES)
    first = 1 + lamps
    flat_gloss = np.zeros(lobes)
    flat_gloss[list(FLAT_LOBES)] = vector[first + lobes + 3 :]
    departure, additive, room = (float(value) for value in vector[first + lobes : first + lobes + 3])
    return Shared(
        level=float(vector[0]),
        strengths=np.array(vector[1:first]),
        gloss=np.array(vector[first : first + lobes]),
        departure=departure,
        additive=additive,
        room=room,
        flat_gloss=flat_gloss,
    )


def groups(lamps: int) -> list[Group]:
    """Groups of unknowns beside the level, which is always one; of a name one at most is believed."""
    first, lobes = 1 + lamps, len(LOBES)
    rest = first + lobes
    return [
        Group("lamps", tuple(range(1, first)), False),
        *(Group("gloss", tuple(first + place for place in family), True) for family in _families()),
        Group("departure", (rest,), False),
        Group("ambient", (rest + 1, rest + 2), True),
        Group("flat-gloss", tuple(range(rest + 3, rest + 3 + len(FLAT_LOBES))), True),
    ]


def _families() -> list[tuple[int, ...]]:
    """Lobes of each kind by themselves, and all together."""
    kinds = [kind for kind, _ in LOBES]
    alone = [
        tuple(place for place, other in enumerate(kinds) if other == kind) for kind in dict.fromkeys(kinds)
    ]
    return [*alone, tuple(range(len(LOBES)))]


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
            np.full(len(LOBES), GLOSS_PRIOR**-2),
            [DEPARTURE_PRIOR**-2, AMBIENT_PRIOR**-2, AMBIENT_PRIOR**-2],
            np.full(len(FLAT_LOBES), FLAT_GLOSS_PRIOR**-2),
        ]
    )
    centres = np.zeros(len(precisions))
    centres[1 : 1 + len(strengths)] = middle
    return precisions, centres
