"""Height detrends: the smooth deformation of a height map that is not the artwork's."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from nlights_core.algorithms import HeightDetrend
from nlights_core.fields import HeightMap
from nlights_core.frames import Array
from nlights_core.integration.poisson import row_slices
from nlights_core.machine.band_threads import in_order

BAND = 256
"""Rows that are worked on at once."""

Terms = Literal["3x3", "quadratic"]
"""Which products x^a y^b take part: a, b <= 2, or only a + b <= 2."""


class ParabolicFit(HeightDetrend):
    """The parabolic surface of least squared distance from the height (the paper's).

    It takes a true bow of the panel or canvas for a deformation too.
    """

    name: ClassVar[str] = "parabolic-fit"

    terms: Terms = Field(
        default="3x3",
        description="'3x3': the nine products x^a y^b with a, b <= 2, as in the paper; "
        "'quadratic': the six with a + b <= 2",
    )

    def trend(self, height: HeightMap) -> Array:
        """The fitted surface on the whole rectangle; 0 where nothing is known of the height."""
        return parabolic_surface(parabolic_coefficients(height.height, self.terms), height.grid.shape)


def parabolic_coefficients(height: Array, terms: Terms = "3x3") -> Array:
    """Fit a surface ``sum c[a, b] x^a y^b`` to what is known of a height map.

    Columns and rows are scaled to x and y from -1 to 1 over the whole map.  The normal equations
    are summed up in float64, a band of rows at a time.

    Parameters
    ----------
    height : (H, W) float array
        NaN where not known.
    terms : {"3x3", "quadratic"}
        Products that take part.

    Returns
    -------
    (3, 3) float64 array
        ``c[a, b]`` in the height's unit; of all fits that are equally good, as where few pixels
        are known, the one of the smallest coefficients.

    Examples
    --------
    >>> parabolic_coefficients(np.array([[1.0, 0.0, 1.0]])).round(12)[:, 0]
    array([0., 0., 1.])
    """
    rows, columns = height.shape
    x, y = _powers(columns, 5), _powers(rows, 5)

    def sums(lines: slice) -> tuple[Array, Array]:
        known = np.isfinite(height[lines])
        z = np.where(known, height[lines], 0).astype(np.float64)
        # No matrix product: what it rounds depends on how many threads share it.
        counts = np.einsum("aw,hw->ah", x, known.astype(np.float64))
        lifted = np.einsum("aw,hw->ah", x[:3], z)
        return (
            np.einsum("ah,bh->ab", counts, y[:, lines]),
            np.einsum("ah,bh->ab", lifted, y[:3, lines]),
        )

    moments, products = np.zeros((5, 5)), np.zeros((3, 3))
    for moment, product in in_order(sums, row_slices(rows, BAND)):
        moments += moment
        products += product
    a, b = _exponents(terms)
    normal = moments[a[:, None] + a, b[:, None] + b]
    coefficients = np.zeros((3, 3))
    coefficients[a, b] = np.linalg.lstsq(normal, products[a, b], rcond=1e-12)[0]
    return coefficients


def parabolic_surface(coefficients: Array, shape: tuple[int, int]) -> Array:
    """Evaluate what `parabolic_coefficients` fitted.

    Parameters
    ----------
    coefficients : (3, 3) float64 array
        ``c[a, b]`` of ``x^a y^b``, x and y from -1 to 1 over the map.
    shape : tuple of 2 ints
        H, W.

    Returns
    -------
    (H, W) float32 array
        In the unit of the coefficients.
    """
    rows, columns = shape
    per_row = np.einsum("ab,aw->bw", coefficients, _powers(columns, 3))
    y = _powers(rows, 3)
    surface = np.empty(shape, np.float32)

    def fill(lines: slice) -> None:
        surface[lines] = np.einsum("bh,bw->hw", y[:, lines], per_row)

    for _ in in_order(fill, row_slices(rows, BAND)):
        pass
    return surface


def _powers(count: int, number: int) -> Array:
    """The first ``number`` powers of a coordinate from -1 to 1, (number, count)."""
    coordinate = np.linspace(-1, 1, count) if count > 1 else np.zeros(1)
    return coordinate ** np.arange(number)[:, None]


def _exponents(terms: Terms) -> tuple[Array, Array]:
    a, b = (e.ravel() for e in np.indices((3, 3)))
    taken = np.full(9, True) if terms == "3x3" else a + b <= 2
    return a[taken], b[taken]
