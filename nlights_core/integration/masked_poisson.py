"""The Poisson equation of a part of a rectangle, by way of the whole rectangle's."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.integration.poisson import row_slices, solve_poisson
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import tell

LINES = 16
"""Lines that are worked on at once: they fit into a core's cache."""

MOST_ITERATIONS = 40
"""Iterations after which it ends in any case."""

TRIAL = 10
"""Iterations after which it is seen whether it will end in time."""


def solve_embedded(
    residual: Array, known: Array, tolerance: float, most_iterations: int = MOST_ITERATIONS
) -> tuple[Array, float]:
    """Solve a masked Poisson equation by conjugate gradients, as far as they come fast.

    Each iteration solves the whole rectangle's equation, which differs only at the border of what
    is known; so few iterations suffice, whatever the size, for a canvas that is torn or turned, and
    fewer still for spots.  Labyrinths and narrow bridges are another matter, see
    `nlights_core.integration.multigrid`.

    Parameters
    ----------
    residual : (H, W) float array
        What `masked_laplacian` of the solution shall be: 0 where not known, of sum 0 on each
        island.  In the end what is left of it.
    known : (H, W) bool array
    tolerance : float
        It ends when the residual, in the norm of the preconditioner, has fallen to this share.
    most_iterations : int
        It ends as well where so many will not do, judged after `TRIAL` of them.

    Returns
    -------
    height : (H, W) array
        In the precision of ``residual``, of any mean on each island; where not known anything.
    left : float
        The share to which the residual has fallen.

    Notes
    -----
    Sums are taken in double precision, and by bands, so that threads change nothing.
    """
    height, direction = np.zeros_like(residual), np.zeros_like(residual)
    change = np.empty_like(residual)
    share, first, before = 1.0, 0.0, 1.0
    for iteration in range(most_iterations + 1):
        np.copyto(change, residual)
        change = solve_poisson(change, overwrite=True)
        product = -_dot(residual, change)
        first = first or product
        share = float(np.sqrt(max(product, 0.0) / first)) if first > 0 else 0.0
        tell(iteration / most_iterations)
        late = iteration >= TRIAL and share ** (most_iterations / iteration) > tolerance
        if share <= tolerance or late or iteration == most_iterations:
            break
        _follow(direction, product / before if iteration else 0.0, change)
        before = product
        stiffness = -masked_laplacian(direction, known, change)
        if stiffness <= 0:
            break
        _advance(height, residual, direction, change, product / stiffness)
    return height, share


def masked_laplacian(height: Array, known: Array, out: Array) -> float:
    """Sum of what a pixel's known neighbours exceed it by; and the sum of that times the height.

    Parameters
    ----------
    height : (H, W) float array
        Finite everywhere.
    known : (H, W) bool array
    out : (H, W) float array
        Written: 0 where not known.

    Returns
    -------
    float

    Examples
    --------
    >>> out = np.empty((1, 4))
    >>> masked_laplacian(np.array([[0.0, 1.0, 4.0, 9.0]]), np.array([[True, True, True, False]]), out)
    -10.0
    >>> out
    array([[ 1.,  2., -3.,  0.]])
    """

    def work(lines: slice) -> float:
        own = out[lines]
        own[:] = 0
        step = np.diff(height[lines], axis=1) * (known[lines, 1:] & known[lines, :-1])
        own[:, :-1] += step
        own[:, 1:] -= step
        # Steps down, from the row above the band to the row below it.
        first, last = max(lines.start - 1, 0), min(lines.stop, len(height) - 1)
        upper, lower = slice(first, last), slice(first + 1, last + 1)
        step = (height[lower] - height[upper]) * (known[lower] & known[upper])
        own[: last - lines.start] += step[lines.start - first :]
        own[first + 1 - lines.start :] -= step[: lines.stop - first - 1]
        return float(np.einsum("ij,ij->", height[lines], own, dtype=np.float64))

    return sum(in_order(work, row_slices(len(height), LINES)))


def _dot(a: Array, b: Array) -> float:
    def work(lines: slice) -> float:
        return float(np.einsum("ij,ij->", a[lines], b[lines], dtype=np.float64))

    return sum(in_order(work, row_slices(len(a), LINES)))


def _follow(direction: Array, share: float, change: Array) -> None:
    """The next direction, in place: the change and a share of the last direction."""

    def work(lines: slice) -> None:
        part = direction[lines]
        part *= share
        part += change[lines]

    list(in_order(work, row_slices(len(direction), LINES)))


def _advance(height: Array, residual: Array, direction: Array, change: Array, length: float) -> None:
    """Go a length along the direction, in place."""

    def work(lines: slice) -> None:
        height[lines] += length * direction[lines]
        residual[lines] -= length * change[lines]

    list(in_order(work, row_slices(len(height), LINES)))
