"""An approximate inverse of a weighted grid Laplacian: aggregation multigrid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nlights_core.frames import Array
from nlights_core.integration.poisson import BAND, row_slices
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import available
from nlights_core.machine.progress import tell

Result = TypeVar("Result")

MULTIGRID = 64
"""Bytes a pixel that `solve_weighted` and whoever prepares its steps take at the most."""

DAMPING = 0.8
"""Share of a Jacobi step that is taken; below 1, so that a chequered error dies out too."""

COARSEST = 256
"""Pixels of the coarsest grid, whose Laplacian is inverted as a matrix."""

SMALL = 1 << 18
"""Grids of no more pixels are left to one thread."""

CLOSE_ENOUGH = 0.25
"""A coarse residual that has fallen to this share needs no second step."""


def weighted_laplacian(height: Array, across: Array, down: Array) -> Array:
    """Sum over each pixel's neighbours of the weight times how much the pixel is higher than they are.

    Parameters
    ----------
    height : (H, W) float array
        Finite everywhere.
    across : (H, W - 1) float array
        Weight of the step from each column to the next, 0 where there is none.
    down : (H - 1, W) float array
        Weight of the step from each row to the next.

    Returns
    -------
    (H, W) array
        In the precision of ``height``.

    Examples
    --------
    >>> weighted_laplacian(np.array([[0.0, 1.0, 3.0]]), np.array([[1.0, 10.0]]), np.empty((0, 3)))
    array([[ -1., -19.,  20.]])
    """
    # Each step counts for its two pixels with the same rounding, so that the sum over an island stays 0.
    excess = np.zeros_like(height)
    for lines in row_slices(len(height)):
        steps = np.diff(height[lines], axis=1) * across[lines]
        excess[lines, 1:] += steps
        excess[lines, :-1] -= steps
    for lines in row_slices(len(down)):
        below = slice(lines.start + 1, lines.stop + 1)
        steps = (height[below] - height[lines]) * down[lines]
        excess[below] += steps
        excess[lines] -= steps
    return excess


def subtract_laplacian(
    residual: Array, length: float, height: Array, across: Array, down: Array, out: Array
) -> None:
    """Remainder of a residual after going a length along a height.

    Parameters
    ----------
    residual : (H, W) float array
    length : float
    height, across, down : arrays
        As `weighted_laplacian` gets them.
    out : (H, W) float array
        Written: ``residual - length * weighted_laplacian(height)``; may be the residual itself.
    """
    if available():
        from nlights_core.integration import compiled_integration as compiled

        def work(lines: slice) -> None:
            compiled.subtract_laplacian_rows(
                residual[lines], float(length), height, across, down, lines.start, out[lines]
            )

        _in_threads(work, height)
    else:
        out[:] = residual - length * weighted_laplacian(height, across, down)


def laplacian_product(other: Array, height: Array, across: Array, down: Array) -> float:
    """Sum of ``other`` times `weighted_laplacian` of a height, in double precision."""
    if not available():
        return _dot(other, weighted_laplacian(height, across, down))
    from nlights_core.integration import compiled_integration as compiled

    def work(lines: slice) -> float:
        return compiled.laplacian_product_of_rows(other, height, across, down, lines.start, lines.stop)

    return sum(_in_threads(work, height))


def _in_threads(work: Callable[[slice], Result], grid: Array) -> list[Result]:
    lines = BAND if grid.size > SMALL else len(grid)
    parts = row_slices(len(grid), lines)
    return list(in_order(work, parts)) if grid.size > SMALL else [work(part) for part in parts]


@dataclass(frozen=True)
class _Level:
    across: Array
    down: Array
    inverse_diagonal: Array
    """0 where a pixel has no step at all."""


class Multigrid:
    """An approximate inverse of `weighted_laplacian`, to precondition conjugate gradients.

    Each level joins two by two pixels into one, whose steps weigh as much as all that cross its
    border.  Blocks of one height are a crude picture of a slope, and too stiff; two conjugate
    gradient steps on every coarse level (a K-cycle) find the right stiffness.  Therefore the
    result depends on the residual in a not quite linear way, and the iteration that it serves
    must be a *flexible* one.

    Parameters
    ----------
    across, down : (H, W - 1) and (H - 1, W) float32 arrays
        Weights of the steps, 0 where there is none.  They are kept, not copied.

    References
    ----------
    Y. Notay, "An aggregation-based algebraic multigrid method", Electronic Transactions on
    Numerical Analysis 37 (2010) 123-146.
    """

    def __init__(self, across: Array, down: Array) -> None:
        self._levels = [_level(across, down)]
        while self._levels[-1].inverse_diagonal.size > COARSEST:
            across, down = _joined(across), _joined(down.T).T
            self._levels.append(_level(across, down))
        self._coarsest_inverse = _inverse(self._levels[-1])

    def correct(self, residual: Array) -> Array:
        """Height whose weighted Laplacian is nearly ``residual``.

        Parameters
        ----------
        residual : (H, W) float array
            0 where a pixel has no step.

        Returns
        -------
        (H, W) float32 array
        """
        largest = max(abs(float(residual.max())), abs(float(residual.min()))) or 1.0
        # Scaled, so that single precision neither overflows nor vanishes.
        scaled = np.empty(residual.shape, np.float32)
        np.multiply(residual, 1 / largest, out=scaled, casting="same_kind")
        height = self._cycle(0, scaled)
        height *= np.float32(largest)
        return height

    def _cycle(self, depth: int, residual: Array) -> Array:
        """One damped Jacobi step, the coarser grid's correction, and another step."""
        if depth == len(self._levels) - 1:
            height = self._coarsest_inverse @ residual.ravel()
            return height.reshape(residual.shape).astype(np.float32)
        level = self._levels[depth]
        height = residual * level.inverse_diagonal
        height *= np.float32(DAMPING)
        # What the step has left goes to the coarser grid: a block's equation is the sum of its pixels'.
        left = np.empty_like(residual)
        subtract_laplacian(residual, 1.0, height, level.across, level.down, left)
        coarse = _block_sums(left)
        # What a level does not need while the coarser ones work is not held.
        del left
        _add_blocks(height, self._coarse_steps(depth + 1, coarse))
        del coarse
        left = np.empty_like(residual)
        subtract_laplacian(residual, 1.0, height, level.across, level.down, left)
        _jacobi(height, left, level.inverse_diagonal)
        return height

    def _coarse_steps(self, depth: int, residual: Array) -> Array:
        """One or two steps of conjugate gradients on a coarse level, preconditioned by its cycle."""
        first = self._cycle(depth, residual)
        if depth == len(self._levels) - 1:
            return first
        level = self._levels[depth]
        stiffness = laplacian_product(first, first, level.across, level.down)
        # Not positive only where there is nothing to correct.
        if stiffness <= 0:
            return first
        length = _dot(first, residual) / stiffness
        left = np.empty_like(residual)
        subtract_laplacian(residual, length, first, level.across, level.down, left)
        if _dot(left, left) <= CLOSE_ENOUGH**2 * _dot(residual, residual):
            first *= np.float32(length)
            return first
        second = self._cycle(depth, left)
        # What the second step has of the first one is taken off it, in the norm of the Laplacian.
        common = laplacian_product(second, first, level.across, level.down) / stiffness
        second_stiffness = laplacian_product(second, second, level.across, level.down) - common**2 * stiffness
        second_length = _dot(second, left) / second_stiffness if second_stiffness > 0 else 0.0
        first *= np.float32(length - common * second_length)
        second *= np.float32(second_length)
        first += second
        return first


def _level(across: Array, down: Array) -> _Level:
    diagonal = np.zeros((len(across), down.shape[1]), np.float32)
    diagonal[:, 1:] += across
    diagonal[:, :-1] += across
    diagonal[1:] += down
    diagonal[:-1] += down
    inverse = np.divide(1, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0)
    return _Level(across, down, inverse)


def _jacobi(height: Array, residual: Array, inverse_diagonal: Array) -> None:
    """A damped Jacobi step, in place."""

    def work(lines: slice) -> None:
        step = residual[lines] * inverse_diagonal[lines]
        step *= np.float32(DAMPING)
        height[lines] += step

    _in_threads(work, height)


def _joined(weights: Array) -> Array:
    """Weights of steps along lines, for blocks of two by two: sums over what crosses their border."""
    # Steps between odd and even columns cross a border; the others are inside of blocks.
    crossing = weights[:, 1::2]
    joined = crossing[0::2].copy()
    # A last row without a partner is a block of its own.
    joined[: len(crossing) // 2] += crossing[1::2]
    return joined


def _block_sums(values: Array) -> Array:
    # First pairs of columns, then pairs of rows; a last one without a partner stands alone.
    columns = values[:, 0::2].copy()
    columns[:, : values.shape[1] // 2] += values[:, 1::2]
    sums = columns[0::2].copy()
    sums[: len(columns) // 2] += columns[1::2]
    return sums


def _add_blocks(height: Array, blocks: Array) -> None:
    """Add to every pixel the height of its block, in place."""
    for i in (0, 1):
        for j in (0, 1):
            pixels = height[i::2, j::2]
            pixels += blocks[: pixels.shape[0], : pixels.shape[1]]


def _inverse(level: _Level) -> Array:
    """Pseudo-inverse of the Laplacian of a small grid, (pixels, pixels) float64."""
    shape = level.inverse_diagonal.shape
    units = np.eye(level.inverse_diagonal.size).reshape(-1, *shape)
    columns = [weighted_laplacian(unit, level.across, level.down).ravel() for unit in units]
    # The Laplacian of a constant on an island is 0: the pseudo-inverse gives heights of mean 0 there.
    inverse: Array = np.linalg.pinv(np.array(columns), rcond=1e-12, hermitian=True)
    return inverse


def _dot(a: Array, b: Array) -> float:
    def work(lines: slice) -> float:
        return float(np.einsum("ij,ij->", a[lines], b[lines], dtype=np.float64))

    return sum(_in_threads(work, a))


def solve_weighted(
    height: Array, residual: Array, weights: list[Array], tolerance: float, most_iterations: int
) -> float:
    """Solve by flexible conjugate gradients, from ``height`` on and in place.

    Parameters
    ----------
    height : (H, W) float array
        Where it starts; becomes the solution, of any mean on each island.
    residual : (H, W) float64 array
        What `nlights_core.integration.multigrid.weighted_laplacian` of the solution shall be.  Overwritten.
    weights : two float32 arrays
        ``across`` and ``down`` of `nlights_core.integration.multigrid.weighted_laplacian`.
    tolerance : float
        It ends when the residual, in the norm of the preconditioner, has fallen to this share of
        what it is for a plane.
    most_iterations : int
        It ends here in any case.

    Returns
    -------
    float
        The share to which the residual has fallen; above ``tolerance`` only where the iterations ran out.

    Notes
    -----
    Preconditioner and directions are float32, the residual float64: in float32 its sum over an
    island is not quite zero, and with many small islands that diverges.
    """
    across, down = weights
    preconditioner = Multigrid(across, down)
    # Here ``residual`` still is the right-hand side, that of a plane; only then the start is taken off.
    whole = _dot(residual, preconditioner.correct(residual))
    enough = tolerance**2 * whole
    subtract_laplacian(residual, 1.0, height, across, down, residual)
    direction = np.zeros(height.shape, np.float32)
    stiffness, share_done, left = 1.0, 0.0, 1.0
    for iteration in range(most_iterations):
        correction = preconditioner.correct(residual)
        product = _dot(residual, correction)
        left = float(np.sqrt(max(product, 0.0) / whole)) if whole > 0 else 0.0
        if product <= enough:
            break
        # Whichever ends it: it falls by a like factor each time, or runs out of iterations.
        fallen = np.log(max(left, tolerance)) / np.log(tolerance) if tolerance < 1 else 1.0
        share_done = max(share_done, fallen, iteration / most_iterations)
        tell(share_done)
        # Orthogonal to the last direction itself: the preconditioner is not linear, so the short formula fails.
        share = np.float32(-laplacian_product(correction, direction, across, down) / stiffness)
        for lines in row_slices(len(height)):
            direction[lines] *= share
            direction[lines] += correction[lines]
        del correction
        stiffness = laplacian_product(direction, direction, across, down)
        length = _dot(direction, residual) / stiffness
        subtract_laplacian(residual, length, direction, across, down, residual)
        for lines in row_slices(len(height)):
            height[lines] += length * direction[lines].astype(np.float64)
    return left
