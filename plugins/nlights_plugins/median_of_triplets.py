"""The `median-of-triplets` normal solver: what most triplets of lights agree on."""

from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.solving import kernels, least_squares, robust_fitting
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Kernel, rule
from nlights_core.solving.triplets import median_of_triplets


class MedianOfTriplets(UsableLights):
    """Weighted median of the solutions of all triplets of usable lights.

    Three lights determine a normal; Coleman and Jain (1982) compared the four triplets of four
    lights to find a highlight.  With more lights the median over the triplets does it; the
    weights are those with which their mean would be least squares.
    """

    name: ClassVar[str] = "median-of-triplets"
    kernel: ClassVar[Kernel] = "median-of-triplets"

    most: int = Field(
        default=120,
        ge=1,
        le=5000,
        description="how many triplets are solved at most: all those of 10 lights; of more lights "
        "a fixed random choice",
    )

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        if available():
            chosen = rule(self.kernel, **self.model_dump())
            return kernels.solve_by_rule(chosen, images, lights, weights, self.shadow)
        return robust_fitting.in_blocks(self._solved, images, lights, weights)

    def _solved(self, images: Array, lights: Array, weights: Array) -> Solution:
        usable = least_squares.lit(images, weights, self.shadow)
        found = least_squares.fit(images, lights, usable, self.condition)
        median = median_of_triplets(images, lights, usable, self.most)
        found.scaled[:, np.isnan(median[0])] = np.nan
        known = np.isfinite(found.scaled[0])
        found.scaled[:, known] = median[:, known]
        return least_squares.solution(images, lights, usable, found)
