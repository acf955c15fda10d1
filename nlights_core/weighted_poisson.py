"""The Poisson equation with a weight for every step, by multigrid."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.integration import bands
from nlights_core.multigrid import Multigrid, left_over, overlap

MULTIGRID = 64
"""Bytes a pixel that `solve_weighted` and whoever prepares its steps take at the most."""


def solve_weighted(
    height: Array, residual: Array, weights: list[Array], tolerance: float, most_iterations: int = 200
) -> None:
    """Solve by flexible conjugate gradients, from ``height`` on and in place.

    Parameters
    ----------
    height : (H, W) float array
        Where it starts; becomes the solution, of any mean on each island.
    residual : (H, W) float64 array
        What `nlights_core.multigrid.weighted_laplacian` of the solution shall be.  Overwritten.
    weights : two float32 arrays
        ``across`` and ``down`` of `nlights_core.multigrid.weighted_laplacian`.
    tolerance : float
        It ends when the residual, in the norm of the preconditioner, has fallen to this share of
        what it is for a plane.
    most_iterations : int
        It ends here in any case.

    Notes
    -----
    Preconditioner and directions are float32, the residual float64: in float32 its sum over an
    island is not quite zero, and with many small islands that diverges.
    """
    across, down = weights
    preconditioner = Multigrid(across, down)
    enough = tolerance**2 * _dot(residual, preconditioner.correct(residual))
    left_over(residual, 1.0, height, across, down, residual)
    direction = np.zeros(height.shape, np.float32)
    stiffness = 1.0
    for _ in range(most_iterations):
        correction = preconditioner.correct(residual)
        if _dot(residual, correction) <= enough:
            break
        share = np.float32(-overlap(correction, direction, across, down) / stiffness)
        for lines in bands(len(height)):
            direction[lines] *= share
            direction[lines] += correction[lines]
        del correction
        stiffness = overlap(direction, direction, across, down)
        length = _dot(direction, residual) / stiffness
        left_over(residual, length, direction, across, down, residual)
        for lines in bands(len(height)):
            height[lines] += length * direction[lines].astype(np.float64)


def _dot(a: Array, b: Array) -> float:
    return sum(float(np.einsum("ij,ij->", a[lines], b[lines], dtype=np.float64)) for lines in bands(len(a)))
