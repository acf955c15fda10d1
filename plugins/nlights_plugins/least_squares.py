"""The `least-squares` normal solver: every usable light counts."""

from typing import ClassVar

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.solving import kernels, least_squares
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Kernel, rule


class LeastSquares(UsableLights):
    """Weighted least squares over the lights that are usable in each pixel.

    Usable are the lights above shadow and below saturation.  Fewer than three, or lights that
    are badly spread, leave the pixel unknown.  Source: Woodham 1980; the paper, section 2.2.
    """

    name: ClassVar[str] = "least-squares"
    kernel: ClassVar[Kernel] = "least-squares"

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        if available():
            return kernels.solve_by_rule(
                rule(self.kernel, **self.model_dump()), images, lights, weights, self.shadow
            )
        usable = least_squares.lit(images, weights, self.shadow)
        found = least_squares.fit(images, lights, usable, self.condition)
        return least_squares.solution(images, lights, usable, found)
