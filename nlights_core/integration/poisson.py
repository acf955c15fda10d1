"""Height from the gradients of a rectangle, by fast sine and cosine transforms.

A gradient here is always a *height step per pixel*: ``per_column`` from one column to the next,
``per_row`` from one row to the next (downwards), in whatever length the height shall have.  Both
are sampled at the centres of the pixels, as photometric stereo gives them.  Transforms run in the
precision of the gradients: float32 stays float32, float64 stays float64.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Literal

import numpy as np
import scipy.fft
from numpy.typing import DTypeLike

from nlights_core.frames import Array
from nlights_core.machine.band_threads import cores, in_order
from nlights_core.machine.kernel_switch import available

Stencil = Literal["6-point", "trapezoid"]
"""How the step between two pixels follows from the gradients at the pixels around it."""

BAND = 64
"""Lines that are worked on at once, so that temporary arrays stay small."""

# Each formula: how many pixels it reaches before the step, and the weights of its pixels.
_TRAPEZOID = (0, np.array([1, 1]) / 2)
_FIRST_OF_FOUR = (0, np.array([9, 19, -5, 1]) / 24)
_LAST_OF_FOUR = (2, np.array([1, -5, 19, 9]) / 24)
_FOUR_POINT = (1, np.array([-1, 13, 13, -1]) / 24)
_SIX_POINT = (2, np.array([11, -93, 802, 802, -93, 11]) / 1440)
_FORMULAS = {
    "trapezoid": (_TRAPEZOID,),
    "6-point": (_SIX_POINT, _FOUR_POINT, _FIRST_OF_FOUR, _LAST_OF_FOUR, _TRAPEZOID),
}


def frankot_chellappa(
    per_column: Array, per_row: Array, *, periodic: bool = False, remove_plane: bool = True
) -> Array:
    """Integrate with the exact derivative of a Fourier series (Frankot and Chellappa).

    Parameters
    ----------
    per_column, per_row : (H, W) float32 or float64 arrays
        Height steps per pixel, finite everywhere.
    periodic : bool
        True: the surface repeats itself beyond its borders, as in the original method.  False:
        it is mirrored there, which gives what a transform of 2H x 2W mirrored pixels would, at
        the cost of H x W.
    remove_plane : bool
        Integrate the mean plane apart.  Left in, a tilt makes a step (periodic) or a kink
        (mirrored) at every border.

    Returns
    -------
    (H, W) array
        Height of mean 0, in the precision of the gradients.

    References
    ----------
    R. T. Frankot, R. Chellappa, "A method for enforcing integrability in shape from shading
    algorithms", IEEE TPAMI 10 (1988) 439-451.
    """
    tilt = mean_steps(per_column, per_row) if remove_plane else (0.0, 0.0)
    surface = _periodic_surface if periodic else _mirrored_surface
    height = surface(per_column - tilt[0], per_row - tilt[1])
    add_plane(height, tilt)
    return height


def simchony(
    per_column: Array, per_row: Array, *, stencil: Stencil = "6-point", remove_plane: bool = True
) -> Array:
    """Integrate by least squares with free borders: a Poisson equation (Simchony et al.).

    The height minimises the squared difference between its own steps from pixel to pixel and
    those that `height_steps` takes from the gradients.

    Parameters
    ----------
    per_column, per_row : (H, W) float32 or float64 arrays
        Height steps per pixel, finite everywhere.
    stencil : {"6-point", "trapezoid"}
        See `height_steps`.
    remove_plane : bool
        Integrate the mean plane apart.  The result is the same but for rounding, which a tilt
        left in makes worse.

    Returns
    -------
    (H, W) array
        Height of mean 0, in the precision of the gradients.

    References
    ----------
    T. Simchony, R. Chellappa, M. Shao, "Direct analytical methods for solving Poisson equations
    in computer vision problems", IEEE TPAMI 12 (1990) 435-446.
    """
    tilt = mean_steps(per_column, per_row) if remove_plane else (0.0, 0.0)
    source = np.zeros(per_column.shape, np.result_type(per_column, per_row))
    add_divergence(source, per_column, stencil, tilt[0])
    add_divergence(source.T, per_row.T, stencil, tilt[1])
    height = solve_poisson(source, overwrite=True)
    add_plane(height, tilt)
    return height


def height_steps(gradient: Array, stencil: Stencil) -> Array:
    """Steps from each pixel of a line to the next, out of the gradient at the pixels.

    Parameters
    ----------
    gradient : (n, N) float array
        Derivative along each of n lines of N pixels; NaN where not known.
    stencil : {"6-point", "trapezoid"}
        "trapezoid": the mean of the two pixels, exact for a parabola.  "6-point": the integral
        of the polynomial through six pixels, ``[802 (p[j] + p[j+1]) - 93 (p[j-1] + p[j+2])
        + 11 (p[j-2] + p[j+3])] / 1440``; where not all six are known the same with four
        (centred, else one-sided), else the trapezoid.

    Returns
    -------
    (n, N - 1) float array
        NaN where either end of the step is not known.

    Examples
    --------
    >>> height_steps(np.array([[0.0, 2.0, 4.0]]), "trapezoid")
    array([[1., 3.]])
    """
    return _by_formulas(gradient, _FORMULAS[stencil])


def certain_steps(gradient: Array, variance: Array, stencil: Stencil) -> tuple[Array, Array]:
    """Steps as `height_steps` takes them, but away from pixels that are far less certain.

    Parameters
    ----------
    gradient : (n, N) float array
        Derivative along each of n lines of N pixels; NaN where not known.
    variance : (n, N) float array
        Variance of each pixel, in any unit.
    stencil : {"6-point", "trapezoid"}
        Where it would make the variance of a step more than twice the trapezoid's, the step is the
        trapezoid's: an outer pixel that steep brings more error than its curvature removes.

    Returns
    -------
    step, variance : (n, N - 1) float arrays
        The variance that the formula passes on; both NaN where either end is not known.
    """
    steps, passed_on = height_steps(gradient, "trapezoid"), _passed_on(variance, "trapezoid")
    if stencil != "trapezoid":
        wider = _passed_on(variance, stencil)
        better = wider <= 2 * passed_on
        steps = np.where(better, height_steps(gradient, stencil), steps)
        passed_on = np.where(better, wider, passed_on)
    return steps, passed_on


def add_divergence(source: Array, gradient: Array, stencil: Stencil, mean: float) -> None:
    """Add one direction's share of the right-hand side of the Poisson equation, in place.

    No step crosses the border of the field or of what is known: that *is* the condition of a
    free border, and nothing else has to be added there.

    Parameters
    ----------
    source : (n, N) float array
        Changed in place.
    gradient : (n, N) float array
        Derivative along the lines; NaN where not known.
    stencil : {"6-point", "trapezoid"}
        See `height_steps`.
    mean : float
        Taken off every step.
    """
    for lines in row_slices(len(source)):
        steps = height_steps(gradient[lines], stencil)
        steps -= steps.dtype.type(mean)
        np.nan_to_num(steps, copy=False, nan=0.0)
        source[lines, :-1] += steps
        source[lines, 1:] -= steps


def solve_poisson(source: Array, *, overwrite: bool = False) -> Array:
    """Solve the discrete Poisson equation of a rectangle with free borders.

    A cosine transform along the rows leaves one tridiagonal system down the columns for each of
    its waves; without compiled loops a second transform down the columns does the same.

    Parameters
    ----------
    source : (H, W) float array
        What the five-point Laplacian of the solution shall be; its mean is ignored.
    overwrite : bool
        Whether the solution takes the place of ``source``, which spares an array.

    Returns
    -------
    (H, W) float array
        Solution of mean 0, in the precision of ``source``.

    References
    ----------
    R. W. Hockney, "A fast direct solution of Poisson's equation using Fourier analysis", J. ACM
    12 (1965) 95-113.
    """
    rows, columns = source.shape
    spectrum = source if overwrite else source.copy()
    spectrum = scipy.fft.dct(spectrum, type=2, axis=1, workers=cores(), overwrite_x=True)
    spectrum[:, 0] -= spectrum[:, 0].mean(dtype=np.float64)
    # 2 - 2 cos would lose the slowest waves to rounding; 4 sin^2 does not.
    across = 4 * np.sin(np.pi * np.arange(columns) / (2 * columns)) ** 2
    if available():
        from nlights_core.integration import compiled_integration as compiled

        strips = range(0, columns, compiled.STRIP)
        list(in_order(partial(compiled.solve_strip, spectrum, across), strips))
        spectrum[:, 0] -= spectrum[:, 0].mean(dtype=np.float64)
    else:
        spectrum = scipy.fft.dct(spectrum, type=2, axis=0, workers=cores(), overwrite_x=True)
        down = 4 * np.sin(np.pi * np.arange(rows) / (2 * rows)) ** 2
        for lines in row_slices(rows):
            spectrum[lines] /= _away_from_zero(-(down[lines, None] + across))
        spectrum = scipy.fft.idct(spectrum, type=2, axis=0, workers=cores(), overwrite_x=True)
    height: Array = scipy.fft.idct(spectrum, type=2, axis=1, workers=cores(), overwrite_x=True)
    return height


def islands(known: Array) -> tuple[Array, int]:
    """Connected islands of pixels; pixels that share an edge belong together.

    Parameters
    ----------
    known : (H, W) bool array

    Returns
    -------
    label : (H, W) int32 array, or (1, 1) where all are known
        From 1 on; 0 where not known.
    count : int
        How many islands there are.
    """
    if known.all():
        return np.ones((1, 1), np.int32), 1
    from scipy import ndimage

    label, count = ndimage.label(known)
    return label, count


def mean_per_island(values: Array) -> Array:
    """Mean over the connected island that each pixel belongs to.

    Parameters
    ----------
    values : (H, W) float array
        NaN where not known.

    Returns
    -------
    (H, W) or (1, 1) array
        In the precision of ``values``, NaN where not known; one number where all is known.
    """
    label, count = islands(np.isfinite(values))
    sums = (sum_per_island(values[lines], label, count, lines) for lines in row_slices(len(values)))
    means = island_means(sums, label, values.size)
    spread: Array = means.astype(values.dtype)[label]
    return spread


def sum_per_island(values: Array, label: Array, count: int, lines: slice) -> Array:
    """Sums over each island's part of a band of lines, (count + 1,) float64; of `islands`."""
    if label.size == 1:
        return np.array([0.0, values.sum(dtype=np.float64)])
    sums: Array = np.bincount(label[lines].ravel(), np.nan_to_num(values).ravel(), count + 1)
    return sums


def island_means(sums: Iterable[Array], label: Array, pixels: int) -> Array:
    """Means out of `sum_per_island` of all bands, (count + 1,) float64, NaN for what is no island."""
    total = np.sum(list(sums), axis=0)
    sizes = np.zeros(len(total))
    for lines in row_slices(len(label)):
        sizes += np.bincount(label[lines].ravel(), minlength=len(total))
    # One label for all pixels, see `islands`.
    if label.size == 1:
        sizes *= pixels
    means: Array = total / np.maximum(sizes, 1)
    means[0] = np.nan
    return means


def mean_steps(per_column: Array, per_row: Array) -> tuple[float, float]:
    """Mean height step per column and per row over what is known, in float64."""
    across, down = (float(g.mean(dtype=np.float64, where=np.isfinite(g))) for g in (per_column, per_row))
    return across, down


def add_plane(height: Array, tilt: tuple[float, float]) -> None:
    """Add a plane of mean 0 to ``height``, in place; ``tilt`` is its step per column and per row."""
    across, down = plane(height.shape, tilt, np.float64)
    for lines in row_slices(len(height)):
        height[lines] += down[lines] + across


def plane(shape: tuple[int, ...], tilt: tuple[float, float], precision: DTypeLike) -> tuple[Array, Array]:
    """A plane of mean 0 as the sum of a row (W,) and a column (H, 1)."""
    rows, columns = shape
    across = (np.arange(columns) - (columns - 1) / 2) * tilt[0]
    down = (np.arange(rows) - (rows - 1) / 2) * tilt[1]
    return across.astype(precision), down.astype(precision)[:, None]


def row_slices(rows: int, lines: int = BAND) -> Iterator[slice]:
    """Slices of up to ``lines`` lines that cover all ``rows``."""
    for start in range(0, rows, lines):
        yield slice(start, min(start + lines, rows))


def _by_formulas(gradient: Array, formulas: tuple[tuple[int, Array], ...]) -> Array:
    """Steps by the first formula whose pixels are all known."""
    pixels = gradient.shape[1]
    steps = np.full_like(gradient[:, 1:], np.nan)
    (before, weights), *fallbacks = formulas
    fitting = pixels - len(weights) + 1
    if fitting > 0:
        terms = (float(w) * gradient[:, k : k + fitting] for k, w in enumerate(weights))
        steps[:, before : before + fitting] = sum(terms)
    for before, weights in fallbacks:
        wanted = np.flatnonzero(np.isnan(steps).any(axis=0))
        first = wanted - before
        inside = (first >= 0) & (first + len(weights) <= pixels)
        wanted, first = wanted[inside], first[inside]
        value = sum(float(w) * gradient[:, first + k] for k, w in enumerate(weights))
        steps[:, wanted] = np.where(np.isnan(steps[:, wanted]), value, steps[:, wanted])
    return steps


def _passed_on(variance: Array, stencil: Stencil) -> Array:
    """Variance of the steps whose pixels err independently of each other."""
    return _by_formulas(variance, tuple((before, weights**2) for before, weights in _FORMULAS[stencil]))


def _periodic_surface(per_column: Array, per_row: Array) -> Array:
    rows, columns = per_column.shape
    across = 2 * np.pi * np.arange(columns // 2 + 1) / columns
    down = 2 * np.pi * scipy.fft.fftfreq(rows)
    # The derivative of the fastest wave of an even length is zero at every pixel.
    if columns % 2 == 0:
        across[-1] = 0
    if rows % 2 == 0:
        down[rows // 2] = 0
    spectrum = scipy.fft.rfft2(per_column, workers=-1)
    other = scipy.fft.rfft2(per_row, workers=-1)
    for lines in row_slices(rows):
        wave = down[lines, None]
        sum_of_squares = _away_from_zero(across**2 + wave**2)
        spectrum[lines] = -1j * (across * spectrum[lines] + wave * other[lines]) / sum_of_squares
    height: Array = scipy.fft.irfft2(spectrum, per_column.shape, workers=-1, overwrite_x=True)
    return height


def _mirrored_surface(per_column: Array, per_row: Array) -> Array:
    """The mirrored height is even, so its slope is odd along itself: a sine transform there."""
    rows, columns = per_column.shape
    spectrum = _sine_and_cosine(per_column, sine=1)
    other = _sine_and_cosine(per_row, sine=0)
    across, down = np.pi * np.arange(columns) / columns, np.pi * np.arange(rows) / rows
    for lines in row_slices(rows):
        wave = down[lines, None]
        sum_of_squares = _away_from_zero(across**2 + wave**2)
        spectrum[lines] = -(across * spectrum[lines] + wave * other[lines]) / sum_of_squares
    height: Array = scipy.fft.idctn(spectrum, type=2, workers=-1, overwrite_x=True)
    return height


def _sine_and_cosine(gradient: Array, sine: int) -> Array:
    """Sine transform along the axis ``sine``, cosine along the other, both indexed by frequency."""
    spectrum: Array = scipy.fft.dst(gradient, type=2, axis=sine, workers=-1, overwrite_x=True)
    spectrum = scipy.fft.dct(spectrum, type=2, axis=1 - sine, workers=-1, overwrite_x=True)
    # The transform's first coefficient is frequency 1.
    shifted = np.moveaxis(spectrum, sine, 0)
    shifted[1:] = shifted[:-1]
    shifted[0] = 0
    return spectrum


def _away_from_zero(eigenvalues: Array) -> Array:
    """Zeros replaced by 1: their waves have no slope, so that their numerator is zero too."""
    return np.where(eigenvalues == 0, 1.0, eigenvalues)
