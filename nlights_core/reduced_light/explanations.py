"""Explanations: the fewest photographs whose change explains what the photographs do not agree about.

Three lamps determine every place, so a change of one photograph can be imitated by smaller changes of all
others.  What has happened is told by parsimony: one photograph changed, or several alike, or a few each in
its own way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from nlights_core.frames import Array

FEW = 10
"""Lamps up to which all sets of photographs are tried; of more, the first and the last, and one more at a time."""

TINY = 1e-30
"""What keeps a sum over nothing from dividing by zero."""


@dataclass(frozen=True)
class Misfit:
    """Rest that photographs leave unexplained, by changes x of each: ``level + 2 vector.x + x.matrix.x``.

    Attributes
    ----------
    matrix : (dL, dL) float64 array
        For d numbers of a change: those of all lamps first, then the second ones.
    vector : (dL,) float64 array
    level : float
    lamps : int
        L.
    """

    matrix: Array
    vector: Array
    level: float
    lamps: int

    def least(self, lamps: Sequence[int], together: bool = False) -> tuple[float, Array]:
        """Find the changes of some lamps that leave least.

        Parameters
        ----------
        lamps : sequence of int
        together : bool
            Whether all of them change alike.

        Returns
        -------
        rest : float
        changes : (L, d) float64 array
        """
        numbers = len(self.vector) // self.lamps
        chosen = np.concatenate([np.array(lamps) + k * self.lamps for k in range(numbers)])
        matrix, vector = self.matrix[np.ix_(chosen, chosen)], self.vector[chosen]
        spread = np.repeat(np.eye(numbers), len(lamps), axis=0) if together else np.eye(len(chosen))
        matrix, vector = spread.T @ matrix @ spread, spread.T @ vector
        matrix = matrix + (1e-6 * np.trace(matrix) / len(matrix) + TINY) * np.eye(len(matrix))
        found = -np.linalg.solve(matrix, vector)
        changes = np.zeros((self.lamps, numbers))
        changes[list(lamps)] = (spread @ found).reshape(numbers, -1).T
        return self.level + float(vector @ found), changes

    def kinds(self) -> Iterator[tuple[int, bool]]:
        """Numbers of lamps that changed (0: several), and whether alike, from the simplest explanation on."""
        yield 1, False
        yield 0, True
        # Of n lamps, n - 3 could be told at best; half as many leave others to confirm it.
        for size in range(2, max(1, (self.lamps - 2) // 2) + 1):
            yield size, False

    def ranked(
        self, size: int, together: bool, before: Sequence[int]
    ) -> list[tuple[float, tuple[int, ...], Array]]:
        """Explanations of a kind: what each leaves, its lamps and their changes; the best first, or none.

        Parameters
        ----------
        size, together : int, bool
            One of `kinds`.
        before : sequence of int
            Lamps of the best explanation so far, to which one is added where there are too many to try all.
        """
        tried = []
        for lamps in self._sets(size, together, before):
            rest, changes = self.least(lamps, together)
            tried.append((rest, lamps, changes))
        return sorted(tried, key=lambda one: one[0])

    def _sets(self, size: int, together: bool, before: Sequence[int]) -> Iterator[tuple[int, ...]]:
        everyone = range(self.lamps)
        if together and self.lamps <= FEW:
            for several in range(2, self.lamps // 2 + 1):
                yield from combinations(everyone, several)
        elif together:
            for several in range(2, self.lamps // 2 + 1):
                yield tuple(everyone[:several])
                yield tuple(everyone[-several:])
        elif self.lamps <= FEW or size == 1:
            yield from combinations(everyone, size)
        elif size == len(before) + 1:
            for lamp in set(everyone) - set(before):
                yield tuple(sorted([*before, lamp]))
