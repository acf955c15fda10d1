"""Places: samples of relative light that are compared, spread over the artwork."""

from __future__ import annotations

import numpy as np

from nlights_core.frames import Array
from nlights_core.reduced_light.relative_light import FEWEST, RelativeLight

PLACES = 6000
"""Samples looked at: a gain is one number."""


def places(relative: RelativeLight) -> tuple[Array, Array, Array, Array, Array]:
    """Choose samples that enough lamps light.

    Parameters
    ----------
    relative : RelativeLight

    Returns
    -------
    y, x : (n,) int arrays
        Which samples.
    light : (L, n) float32 array
        0 where not known.
    vectors : (L, n, 3) float32 array
    weights : (L, n) float32 array
        0 where not known or in shadow, else 1.
    """
    lit = ~np.repeat(np.repeat(relative.shaded, relative.patch, axis=1), relative.patch, axis=2)
    _, rows, columns = relative.light.shape
    usable = np.isfinite(relative.light) & lit[:, :rows, :columns]
    y, x = np.nonzero(usable.sum(axis=0) >= FEWEST)
    # A stride that is no divisor of the width spreads them in both directions.
    step = max(1, len(y) // PLACES)
    y, x = y[::step], x[::step]
    weights = usable[:, y, x].astype(np.float32)
    light = np.where(weights > 0, relative.light[:, y, x], np.float32(0))
    return y, x, light, relative.vectors[:, y, x], weights


def unexplained(vectors: Array, weights: Array) -> Array:
    """Projection of light on what three numbers a place do not explain, (n, L, L); 0 for lamps of weight 0."""
    basis, _ = np.linalg.qr((vectors * weights[..., None]).swapaxes(0, 1))
    return np.asarray(weights.T[:, :, None] * np.eye(len(weights)) - basis @ basis.swapaxes(1, 2))
