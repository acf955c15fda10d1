"""The `rank-trim` normal solver: without the darkest and the brightest lights of each pixel."""

from typing import ClassVar

from pydantic import Field

from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.machine.kernel_switch import available
from nlights_core.solving import kernels, least_squares, robust_fitting
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Kernel, rule


class RankTrim(UsableLights):
    """Least squares without the darkest and the brightest share of each pixel's samples.

    The darkest may be shadow, the brightest highlights; both are dropped everywhere, whether
    they are or not.  Where fewer than three lights would be left, or badly spread ones, none
    is dropped.
    """

    name: ClassVar[str] = "rank-trim"
    kernel: ClassVar[Kernel] = "rank-trim"

    darkest: float = Field(
        default=0.2,
        ge=0,
        lt=0.5,
        description="share of each pixel's samples to drop as its darkest, rounded down",
    )
    brightest: float = Field(
        default=0.1, ge=0, lt=0.5, description="share to drop as its brightest, rounded up"
    )

    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        if available():
            return kernels.solve_by_rule(
                rule(self.kernel, **self.model_dump()), images, lights, weights, self.shadow
            )
        return robust_fitting.in_blocks(self._solved, images, lights, weights)

    def _solved(self, images: Array, lights: Array, weights: Array) -> Solution:
        usable = least_squares.lit(images, weights, self.shadow)
        fewer = robust_fitting.trim_by_rank(images, usable, self.darkest, self.brightest)
        kept, found = robust_fitting.fit_fewer(images, lights, fewer, usable, self.condition)
        return least_squares.solution(images, lights, kept, found)
