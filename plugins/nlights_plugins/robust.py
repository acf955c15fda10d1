"""The `robust` normal solver: least squares where they hold, reweighted where they do not."""

from typing import ClassVar

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.solving.kernels import robust_solution
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Kernel


class Robust(UsableLights):
    """Least squares that give up samples which the others contradict: highlights, shadows.

    A pixel all of whose residuals are noise is solved by plain least squares.  In any other an
    L1 fit is found, and samples far from it lose their weight (Tukey's biweight).  Of fewer
    than five usable lights none can be told to be wrong: they are solved by least squares.
    Source: Maronna, Martin and Yohai, Robust Statistics, 2006.
    """

    name: ClassVar[str] = "robust"
    kernel: ClassVar[Kernel] = "robust"

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        return robust_solution(images, lights, weights, self.shadow, self.condition)
