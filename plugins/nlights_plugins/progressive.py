"""The `progressive` normal solver of the paper: discard, one by one, what disagrees most."""

from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.solving import kernels, least_squares
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Kernel, rule


class Progressive(UsableLights):
    """Least squares from which the most disagreeing light is discarded until ``keep`` are left.

    The paper (section 2.2) says: "Redundant conditions are used to refine the results by
    progressively discarding the closest values."  It is read here as: from 8 lights, discard
    the value that disagrees most with what the others predict, and again, down to a stated
    number.  A discard that would leave badly spread lights is not made.
    """

    name: ClassVar[str] = "progressive"
    kernel: ClassVar[Kernel] = "progressive"

    keep: int = Field(default=5, ge=3, description="how many lights are left in the end")

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        if available():
            return kernels.solve_by_rule(
                rule(self.kernel, **self.model_dump()), images, lights, weights, self.shadow
            )
        usable = least_squares.lit(images, weights, self.shadow)
        found = least_squares.fit(images, lights, usable, self.condition)
        for _ in range(len(images) - self.keep):
            worst = self._worst(images, lights, usable, found)
            fewer = usable.copy()
            np.put_along_axis(fewer, worst[None], 0, axis=0)
            again = least_squares.fit(images, lights, fewer, self.condition)
            better = (np.count_nonzero(usable, axis=0) > self.keep) & np.isfinite(again.scaled[0])
            usable = np.where(better, fewer, usable)
            found = least_squares.Fit(*(np.where(better, b, a) for a, b in zip(found, again, strict=True)))
        return least_squares.solution(images, lights, usable, found)

    def _worst(self, images: Array, lights: Array, usable: Array, found: least_squares.Fit) -> Array:
        """Index of the light that the others predict worst, (h, w)."""
        worst = np.zeros(images.shape[1:], np.intp)
        largest = np.full(images.shape[1:], -1.0)
        for i, (image, light, weight) in enumerate(zip(images, lights, usable, strict=True)):
            own = least_squares.leverage(light, weight, found.inverse)
            missed = np.abs(least_squares.residual(image, light, found.scaled))
            alone = np.sqrt(weight) * missed / np.maximum(1 - own, 1e-6)
            larger = (weight > 0) & (alone > largest)
            worst = np.where(larger, i, worst)
            largest = np.where(larger, alone, largest)
        return worst
