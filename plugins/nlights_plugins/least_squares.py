"""The `least-squares` normal solver: every usable light counts."""

from typing import ClassVar

from pydantic import Field

from nlights_core import least_squares
from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.frames import Array


class LeastSquares(NormalSolver):
    """Weighted least squares over the lights that are usable in each pixel.

    Usable are the lights above shadow and below saturation.  Fewer than three, or lights that
    are badly spread, leave the pixel unknown.  Source: Woodham 1980; the paper, section 2.2.
    """

    name: ClassVar[str] = "least-squares"

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
        usable = least_squares.lit(images, weights, self.shadow)
        found = least_squares.fit(images, lights, usable, self.condition)
        return least_squares.solution(images, lights, usable, found)
