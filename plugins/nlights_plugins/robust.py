"""The `robust` normal solver: least squares where they hold, reweighted where they do not."""

from typing import ClassVar

from pydantic import Field

from nlights_core import least_squares, robust_fitting
from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.frames import Array


class Robust(NormalSolver):
    """Least squares that give up samples which the others contradict: highlights, shadows.

    A pixel all of whose residuals are noise is solved by plain least squares.  In any other an
    L1 fit is found, and samples far from it lose their weight (Tukey's biweight).  Of fewer
    than five usable lights none can be told to be wrong: they are solved by least squares.
    Source: Maronna, Martin and Yohai, Robust Statistics, 2006.
    """

    name: ClassVar[str] = "robust"

    noise: float = Field(
        default=0.005,
        gt=0,
        le=0.1,
        description="standard deviation of a sample of weight 1 that reads 1: photon noise of a white "
        "surface under the brightest lamp; 0.005 is that of 40000 electrons",
    )
    shadow: float = Field(
        default=0.02,
        ge=0,
        lt=1,
        description="samples below this share of the pixel's brightest are shadow; 0: none are",
    )
    condition: float = Field(
        default=100.0,
        gt=1,
        description="largest allowed ratio of the singular values of the usable lights",
    )

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        return robust_fitting.in_blocks(self._solved, images, lights, weights)

    def _solved(self, images: Array, lights: Array, weights: Array) -> Solution:
        usable = least_squares.lit(images, weights, self.shadow)
        kept, found = robust_fitting.reweighted(images, lights, usable, self.noise, self.condition)
        return least_squares.solution(images, lights, kept, found)
