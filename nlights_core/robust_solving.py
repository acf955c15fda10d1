"""The robust solution of a band: compiled where that is possible, by numpy where not."""

from __future__ import annotations

from functools import partial

from nlights_core import kernels, least_squares, robust_fitting
from nlights_core.algorithms import Solution
from nlights_core.frames import Array
from nlights_core.rules import rule


def robust_solution(
    images: Array, lights: Array, weights: Array, shadow: float, condition: float
) -> Solution:
    """Solve a band by `nlights_core.robust_fitting.reweighted`.

    Parameters
    ----------
    images, lights, weights : arrays
        As for `nlights_core.algorithms.NormalSolver.solve`.
    shadow, condition : float
        Options of `nlights_core.least_squares.UsableLights`.

    Returns
    -------
    Solution
    """
    if kernels.available():
        return kernels.solve(rule("robust", condition), images, lights, weights, shadow)
    solved = partial(_by_numpy, shadow=shadow, condition=condition)
    return robust_fitting.in_blocks(solved, images, lights, weights)


def _by_numpy(images: Array, lights: Array, weights: Array, shadow: float, condition: float) -> Solution:
    usable = least_squares.lit(images, weights, shadow)
    kept, found = robust_fitting.reweighted(images, lights, usable, condition)
    return least_squares.solution(images, lights, kept, found)
