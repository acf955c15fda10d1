"""Agreement of the photographs with the model: residuals in units of the noise, lamps held out."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nlights_core.algorithms import PHOTONS, Solution
from nlights_core.frames import Array, PixelGrid
from nlights_core.photographs.development import Band

PIXELS = 40_000
"""About how many pixels of a tile are looked at."""

Solve = Callable[[Band], Solution]


@dataclass(frozen=True)
class Agreement:
    """Agreement of the photographs with the model.

    Attributes
    ----------
    surprise : float or None
        Median over the pixels of the residuals' rms in units of the expected noise; 1 where there
        is nothing but noise.  None: no pixel has more than three lights.
    held_out : tuple of float or None
        For each lamp the rms difference, as a share of the albedo, of its photograph to the one
        that is predicted from all others.  None where it could not be predicted.
    typical : tuple of float or None
        The same at the typical pixel: the median of the differences' sizes.  Highlights and cast shadows,
        which a few pixels have, do not count in it.
    """

    surprise: float | None
    held_out: tuple[float | None, ...]
    typical: tuple[float | None, ...] = ()


@dataclass
class AgreementMeter:
    """Meter of what `Agreement` says, collected over the bands of a tile.

    Parameters
    ----------
    grid : PixelGrid
        Of the tile.
    solve : callable
        Solves a band; pixels stand for themselves.
    """

    grid: PixelGrid
    solve: Solve
    _surprises: list[Array] = field(default_factory=list)
    _squares: list[Array] = field(default_factory=list)

    @property
    def step(self) -> int:
        """Every so many rows and columns are looked at, beginning with row 0 and column step / 2."""
        return max(1, int(np.ceil(np.sqrt(self.grid.rows * self.grid.columns / PIXELS))))

    def add(self, band: Band) -> None:
        """Look at some pixels of a band of rows."""
        self.look(_thinned(band, -band.start % self.step, self.step))

    def look(self, part: Band) -> None:
        """Look at all pixels of a part."""
        if not part.grey[0].size:
            return
        self._surprises.append(_surprise(part, self.solve(part)))
        self._squares.append(np.stack([self._prediction_error(part, i) for i in range(len(part.grey))]))

    def _prediction_error(self, band: Band, lamp: int) -> Array:
        """Squared error of one lamp's photograph predicted by the others, relative to the albedo, (n,)."""
        fewer = band.weights.copy()
        fewer[lamp] = 0
        found = self.solve(replace(band, weights=fewer))
        light = np.broadcast_to(band.lights[lamp], found.normals.shape)
        shading = np.maximum(np.einsum("hwk,hwk->hw", light, found.normals), 0)
        if band.ambient is not None:
            shading += band.ambient[lamp]
        with np.errstate(divide="ignore", invalid="ignore"):
            missed = band.grey[lamp] / found.albedo - shading
        return np.where(band.weights[lamp] > 0, missed**2, np.nan).ravel()

    def found(self) -> Agreement:
        """Agreement over all bands."""
        surprises = np.concatenate(self._surprises) if self._surprises else np.empty(0)
        surprises = surprises[np.isfinite(surprises)]
        squares = np.concatenate(self._squares, axis=1) if self._squares else np.empty((0, 0))
        known = [row[np.isfinite(row)] for row in squares]
        means = tuple(float(np.sqrt(row.mean())) if row.size else None for row in known)
        typical = tuple(float(np.sqrt(np.median(row))) if row.size else None for row in known)
        return Agreement(float(np.median(surprises)) if surprises.size else None, means, typical)


def _thinned(band: Band, first: int, step: int) -> Band:
    """Every so many pixels of a band, in both directions."""
    rows, columns = slice(first, None, step), slice(step // 2, None, step)
    near = band.lights.shape[1] > 1
    return replace(
        band,
        images=band.images[:, rows, columns],
        weights=band.weights[:, rows, columns],
        saturated=band.saturated[:, rows, columns],
        lights=band.lights[:, rows, columns] if near else band.lights,
        ambient=None if band.ambient is None else band.ambient[:, rows, columns],
        grey=band.grey[:, rows, columns],
    )


def _surprise(band: Band, found: Solution) -> Array:
    """Residuals' rms in units of the noise, such that noise alone has a median of 1, (n,)."""
    from scipy.special import chdtri

    used = found.weights > 0
    shown = np.einsum("lhwk,hwk->lhw", np.broadcast_to(band.lights, (*used.shape, 3)), found.normals)
    if band.ambient is not None:
        shown = shown + band.ambient
    missed = np.where(used, band.grey - found.albedo * shown, 0)
    # Weights that were reduced for a large residual would hide it.
    weights = np.where(used, band.weights, 0)
    freedom = np.count_nonzero(used, axis=0) - 3
    total = weights.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        reading = np.sum(weights * np.where(used, band.grey, 0), axis=0) / total
        square = PHOTONS * np.sum(weights * missed**2, axis=0) / reading
        median = chdtri(np.arange(1, len(used) + 1), 0.5)[np.maximum(freedom, 1) - 1]
        ratio = np.sqrt(square / median)
    return np.where(freedom > 0, ratio, np.nan).ravel()


def write_agreement(folder: Path, found: Agreement) -> None:
    """Write ``agreement.json``."""
    record = {"surprise": found.surprise, "held_out": found.held_out, "typical": found.typical}
    (folder / "agreement.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_agreement(folder: Path) -> Agreement:
    """Read what `write_agreement` wrote."""
    record = json.loads((folder / "agreement.json").read_text(encoding="utf-8"))
    return Agreement(record["surprise"], tuple(record["held_out"]), tuple(record["typical"]))
