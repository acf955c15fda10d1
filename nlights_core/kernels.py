"""Kernels: the bundled normal solvers in compiled form, on all cores; without numba there are none."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from nlights_core.algorithms import NormalSolver, Solution
from nlights_core.frames import Array

if TYPE_CHECKING:
    from nlights_core.compiled_fits import Work

Kernel = Literal["least-squares", "robust"]
"""Whose work a kernel does."""

SWITCH = "NLIGHTS_KERNELS"
"""Environment variable; "off" leaves all work to numpy, with the same results."""

SAMPLES = 1 << 13
"""Samples (pixels times lights) that are worked on together: what is kept of them fits into a core's cache."""

TASK = 1 << 14
"""Pixels that are one task of a thread; a multiple of a block."""


class Images(NamedTuple):
    """Rows of the normal stage's images; the files are described in `nlights_core.solving`."""

    normals: Array
    albedo: Array
    reflection: Array
    confidence: Array
    residual: Array
    used: Array
    saturated: Array
    shadow: Array


def available() -> bool:
    """Whether there are compiled kernels: numba is installed and the switch is not off."""
    return os.environ.get(SWITCH) != "off" and importlib.util.find_spec("numba") is not None


def kernel_of(solver: NormalSolver) -> Kernel | None:
    """The kernel that does a solver's work, if any: a class says so itself, its subclasses do not inherit it."""
    return vars(type(solver)).get("kernel") if available() else None


def solve(
    kernel: Kernel, images: Array, lights: Array, weights: Array, shadow: float, condition: float
) -> Solution:
    """Solve a band as the normal solver of that name does.

    Parameters
    ----------
    kernel : {"least-squares", "robust"}
        With "robust", reweighted as `nlights_core.robust_fitting.reweighted` does.
    images, lights, weights : arrays
        As `nlights_core.algorithms.NormalSolver.solve` gets them.
    shadow, condition : float
        Options of `nlights_core.least_squares.UsableLights`.

    Returns
    -------
    Solution
        Equal to what numpy finds up to the rounding of single precision, and the same bits with any
        number of threads.
    """
    from nlights_core.compiled_fits import BLOCK
    from nlights_core.compiled_solutions import solve_pixels

    count, *shape = images.shape
    pixels = images[0].size
    shared = lights.shape[1:3] == (1, 1)
    rays = lights[:, 0] if shared else np.broadcast_to(lights, (count, *shape, 3)).reshape(count, pixels, 3)
    values, given, rays = (_plain(a) for a in (images.reshape(count, -1), weights.reshape(count, -1), rays))
    normals, albedo = np.empty((pixels, 3), np.float32), np.empty(pixels, np.float32)
    confidence, used = np.empty(pixels, np.float32), np.empty((count, pixels), np.float32)
    samples = (values, rays, given)
    found = (normals, albedo, confidence, used)
    limits = (np.float32(shadow), float(condition), kernel == "robust")

    def task(first: int) -> None:
        solve_pixels(*samples, first, first + TASK, *limits, scratch(count), *found)

    assert TASK % BLOCK == 0
    on_all_cores(task, range(0, pixels, TASK))
    return Solution(
        normals.reshape(*shape, 3),
        albedo.reshape(shape),
        confidence.reshape(shape),
        used.reshape(images.shape),
    )


def scratch(count: int) -> Work:
    """Room for the blocks of pixels of so many lights that are worked on together."""
    from nlights_core.compiled_fits import BLOCK, FIT, SAMPLE, Work
    from nlights_core.compiled_solutions import FOUND
    from nlights_core.robust_fitting import scale_quantiles

    blocks = max(SAMPLES // (count * BLOCK), 1)
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
    )


def on_all_cores(task: Callable[[int], None], items: range) -> None:
    """Call a task for every item, in threads where there is more than one."""
    if len(items) > 1:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(task, items))
    else:
        for item in items:
            task(item)


def _plain(array: Array) -> Array:
    """As the kernels are compiled for: float32, contiguous."""
    # What is read-only would be another type to numba, and compiled once more.
    return np.require(array, np.float32, ["C", "W"])
