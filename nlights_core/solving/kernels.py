"""Kernels: the bundled normal solvers in compiled form, on all cores; without numba there are none."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import available
from nlights_core.solving import least_squares, robust_fitting
from nlights_core.solving.rules import Rule, rule

if TYPE_CHECKING:
    from nlights_core.solving.compiled_fits import Work


SAMPLES = 1 << 13
"""Samples (pixels times lights) that are worked on together: what is kept of them fits into a core's cache."""

TASK = 1 << 14
"""Pixels that are one task of a thread; a multiple of a block."""


class Images(NamedTuple):
    """Rows of the normal stage's images; the files are described in `nlights_core.solving.band_solving`."""

    normals: Array
    albedo: Array
    reflection: Array
    confidence: Array
    residual: Array
    used: Array
    saturated: Array
    shadow: Array


def rule_of(solver: NormalSolver) -> Rule | None:
    """The rule of the kernel that does all of a solver's work, if any.

    A class says itself which kernel that is; its subclasses do not inherit it.
    """
    kernel = vars(type(solver)).get("kernel") if available() else None
    return rule(kernel, **solver.model_dump()) if kernel else None


def solve_by_rule(rule: Rule, images: Array, lights: Array, weights: Array, shadow: float) -> Solution:
    """Solve a band as the normal solver with that rule does.

    Parameters
    ----------
    rule : Rule
        Whose work is done.
    images, lights, weights : arrays
        As `nlights_core.algorithms.NormalSolver.solve` gets them.
    shadow : float
        Option of `nlights_core.solving.least_squares.UsableLights`.

    Returns
    -------
    Solution
        Equal to what numpy finds up to the rounding of single precision, and the same bits with any
        number of threads.
    """
    from nlights_core.photographs.blocks import BLOCK
    from nlights_core.solving.compiled_solutions import pixel_solver

    count, *shape = images.shape
    pixels = images[0].size
    shared = lights.shape[1:3] == (1, 1)
    rays = lights[:, 0] if shared else np.broadcast_to(lights, (count, *shape, 3)).reshape(count, pixels, 3)
    values, given, rays = (_plain(a) for a in (images.reshape(count, -1), weights.reshape(count, -1), rays))
    normals, albedo = np.empty((pixels, 3), np.float32), np.empty(pixels, np.float32)
    confidence, used = np.empty(pixels, np.float32), np.empty((count, pixels), np.float32)
    samples = (values, rays, given)
    found = (normals, albedo, confidence, used)
    limits, solve_pixels = (np.float32(shadow), rule.limits), pixel_solver(rule.kernel)

    def task(first: int) -> None:
        solve_pixels(*samples, first, first + TASK, *limits, scratch(count, rule), *found)

    assert TASK % BLOCK == 0
    on_all_cores(task, range(0, pixels, TASK))
    return Solution(
        normals.reshape(*shape, 3),
        albedo.reshape(shape),
        confidence.reshape(shape),
        used.reshape(images.shape),
    )


def scratch(count: int, rule: Rule) -> Work:
    """Room for the blocks of pixels of so many lights that are worked on together by a rule."""
    from nlights_core.photographs.blocks import BLOCK, SAMPLE
    from nlights_core.solving.compiled_fits import FIT, Work
    from nlights_core.solving.compiled_solutions import FOUND
    from nlights_core.solving.robust_fitting import scale_quantiles
    from nlights_core.solving.triplets import chosen_triplets

    blocks = max(SAMPLES // (count * BLOCK), 1)
    # Of a hundred lights there are so many triplets that only who asks for them shall wait.
    triplets = chosen_triplets(count, rule.limits.most) if rule.limits.most else np.empty((0, 3), np.int64)
    return Work(
        samples=np.empty((blocks, count, SAMPLE), np.float32),
        fits=np.empty((blocks, FIT), np.float32),
        found=np.empty((blocks, FOUND), np.float32),
        quantiles=scale_quantiles(count),
        some=np.zeros((count, SAMPLE), np.float32),
        fit=np.zeros(FIT, np.float32),
        noise=np.empty((3, count, BLOCK), np.float32),
        rows=np.empty((10, BLOCK), np.float32),
        places=np.empty((3, BLOCK), np.int64),
        triplets=triplets,
        said=np.empty((4, len(triplets), BLOCK), np.float32),
    )


def on_all_cores(task: Callable[[int], None], items: range) -> None:
    """Call a task for every item, in threads where there is more than one."""
    for _ in in_order(task, items) if len(items) > 1 else map(task, items):
        pass


def _plain(array: Array) -> Array:
    """Array as the kernels are compiled for: float32, contiguous."""
    # What is read-only would be another type to numba, and compiled once more.
    return np.require(array, np.float32, ["C", "W"])


def robust_solution(
    images: Array, lights: Array, weights: Array, shadow: float, condition: float
) -> Solution:
    """Solve a band by `nlights_core.solving.robust_fitting.reweigh`.

    Parameters
    ----------
    images, lights, weights : arrays
        As for `nlights_core.algorithms.NormalSolver.solve`.
    shadow, condition : float
        Options of `nlights_core.solving.least_squares.UsableLights`.

    Returns
    -------
    Solution
    """
    if available():
        return solve_by_rule(rule("robust", condition), images, lights, weights, shadow)
    solved = partial(_reweighted, shadow=shadow, condition=condition)
    return robust_fitting.in_blocks(solved, images, lights, weights)


def _reweighted(images: Array, lights: Array, weights: Array, shadow: float, condition: float) -> Solution:
    usable = least_squares.lit(images, weights, shadow)
    kept, found = robust_fitting.reweigh(images, lights, usable, condition)
    return least_squares.solution(images, lights, kept, found)
