"""Metrics of a tile for every variant: errors against the truth, agreement, differences."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.files.arrays import read_array
from nlights_core.files.tiffs import read_tiff
from nlights_core.frames import Array, PixelGrid
from nlights_core.report.map_statistics import misclosure
from nlights_core.simulation.evaluation import angles_between
from nlights_core.solving.agreement import read_agreement
from nlights_flows.comparison.coverage import Coverage

BLOCKS = 8
"""Blocks of pixels along each side of a tile."""
_BAND_PIXELS = 250_000
_SAMPLE = 500_000
"""Pixels of which percentiles are taken, about."""


@dataclass(frozen=True)
class Metric:
    """A quantity by which variants are compared; less is better.

    Attributes
    ----------
    key, title, unit, meaning : str
    root : bool
        A root mean square: places hold means of squares.
    needs_truth : bool
    """

    key: str
    title: str
    unit: str
    meaning: str
    root: bool = False
    needs_truth: bool = False


METRICS = (
    Metric(
        "angle_error",
        "Error of the normals, mean",
        "°",
        "Angle between each normal and the true one.",
        needs_truth=True,
    ),
    Metric(
        "height_error",
        "Error of the height, rms",
        "mm",
        "Distance to the true height; the best constant is removed, a tilt or a bow counts.",
        root=True,
        needs_truth=True,
    ),
    Metric(
        "held_out",
        "Held-out lamp, rms",
        "% of albedo",
        "How far each photograph is from the one that the other lamps predict: it needs no truth.",
        root=True,
    ),
    Metric(
        "misclosure",
        "Misclosure of the slopes, rms",
        "µm",
        "How badly the measured slopes close round a pixel: noise and wrong light show in it, a slow bow does "
        "not, and a solver that smooths makes it small.",
        root=True,
    ),
)
"""By which variants are ranked, the most telling first."""

DESCRIBED = {
    "angle_error_p95": ("Error of the normals, 95 % are below", "°"),
    "normals_coverage": ("Normals within their stated uncertainty; 68 is right", "% of pixels"),
    "height_error_plane": ("Error of the height after the best plane, rms", "mm"),
    "height_coverage": ("Heights within their stated uncertainty; 68 is right", "% of pixels"),
    "known": ("Known share", "% of pixels"),
    "flat_fit": ("Flat fit, rms", "µm"),
    "seconds": ("Time of all its stages, shared ones included", "s"),
    "peak_memory": ("Peak memory of its stages, mapped files included", "MiB"),
}
"""Numbers that are shown but by which nothing is ranked: title and unit."""

QUALITY = {
    "held_out": "Held-out lamp, rms",
    "misclosure": "Misclosure of the slopes, rms",
    "known": "Known share",
    "flat_fit": "Flat fit, rms",
}
"""What the numbers of ``quality.json`` are called there."""


@dataclass
class TileMeasures:
    """Measurements of one tile.

    Attributes
    ----------
    values : dict
        By quantity, a number per variant; None where not measured.
    places : dict
        By metric, means (of squares, for an rms) at places (R, C, K).
    weights : dict
        By metric, how much each place counts, (R, C).
    differences : list of dict
        For each variant, its differences from the first.
    pixels : int
        Pixels that all variants (and the truth) know.
    share : float
        Their share of the tile.
    """

    values: dict[str, list[float | None]] = field(default_factory=dict)
    places: dict[str, Array] = field(default_factory=dict)
    weights: dict[str, Array] = field(default_factory=dict)
    differences: list[dict[str, float]] = field(default_factory=list)
    pixels: int = 0
    share: float = 0.0


def measure(
    folders: Sequence[Path], normals: Sequence[Path], truth: Path | None, grid: PixelGrid
) -> TileMeasures:
    """Measure a tile for all variants, on the pixels that all of them know.

    Parameters
    ----------
    folders : sequence of Path
        The tile's products, per variant.
    normals : sequence of Path
        The artefacts of the stage "normals", per variant.
    truth : Path or None
        Folder with normals.tif and height.tif.
    grid : PixelGrid
        Of the tile.

    Raises
    ------
    OSError
        When a file has gone.
    """
    found = TileMeasures()
    _from_quality(found, folders)
    _from_maps(found, folders, truth, grid)
    _held_out(found, normals)
    _misclosure(found, normals, grid)
    return found


def _from_quality(found: TileMeasures, folders: Sequence[Path]) -> None:
    """The numbers of the tile's report that concern a comparison."""
    tables = [json.loads((folder / "quality.json").read_text(encoding="utf-8")) for folder in folders]
    for key, name in QUALITY.items():
        found.values[key] = [
            next((row["value"] for row in table if row["name"] == name), None) for table in tables
        ]


class _Errors:
    """Sums of errors of K variants over blocks of pixels, and what percentiles need."""

    def __init__(self, blocks: tuple[int, int], variants: int) -> None:
        self.sums = np.zeros((*blocks, variants))
        self.sampled: list[list[Array]] = [[] for _ in range(variants)]

    def add(self, row: int, columns: Array, variant: int, errors: Array, thinned: Array) -> None:
        self.sums[row, :, variant] += np.add.reduceat(errors.sum(axis=0), columns[:-1])
        self.sampled[variant].append(thinned)

    def percentile(self, variant: int, q: float) -> float:
        return float(np.percentile(np.concatenate(self.sampled[variant]), q))


class _Heights:
    """Sums of K deviations of heights for their rms after the best constant and the best plane."""

    def __init__(self, blocks: tuple[int, int], variants: int) -> None:
        self.squares = np.zeros((*blocks, variants))
        self.sums = np.zeros((*blocks, variants))
        self.sides = np.zeros((variants, 3))
        self.matrix = np.zeros((3, 3))
        self.pivots: list[float | None] = [None] * variants

    def add(self, row: int, columns: Array, variant: int, away: Array, known: Array, plane: Array) -> None:
        pivot = self.pivots[variant]
        if pivot is None:  # near the mean, so that squares lose no digits
            if not known.any():
                return
            pivot = self.pivots[variant] = float(np.median(away[known]))
        away = np.where(known, away - pivot, 0)
        self.sums[row, :, variant] += np.add.reduceat(away.sum(axis=0), columns[:-1])
        self.squares[row, :, variant] += np.add.reduceat((away**2).sum(axis=0), columns[:-1])
        self.sides[variant] += np.tensordot(plane, away, axes=2)

    def block_squares(self, counts: Array) -> Array:
        """Sums of squares in each block, the tile's best constant removed, (R, C, K)."""
        mean = self.sums.sum(axis=(0, 1)) / counts.sum()
        squares = self.squares - 2 * mean * self.sums + mean**2 * counts[..., None]
        return np.asarray(np.maximum(squares, 0))  # rounding may leave less than nothing

    def constant(self, variant: int, count: float) -> float:
        """The best constant of a variant: the mean of its deviations."""
        return float(self.pivots[variant] or 0.0) + float(self.sums[..., variant].sum() / count)

    def after_plane(self, variant: int, count: float) -> float:
        fitted = np.linalg.lstsq(self.matrix, self.sides[variant], rcond=None)[0] @ self.sides[variant]
        return float(np.sqrt(max(self.squares[..., variant].sum() - fitted, 0) / count))


def _from_maps(found: TileMeasures, folders: Sequence[Path], truth: Path | None, grid: PixelGrid) -> None:
    """Errors against the truth, and differences from the first variant, in one reading of the maps."""
    maps = [(read_tiff(folder / "normals.tif"), read_tiff(folder / "height.tif")) for folder in folders]
    right = None if truth is None else (_tiff(truth / "normals.tif"), _tiff(truth / "height.tif"))
    if right is not None and (right[0].shape != maps[0][0].shape or right[1].shape != maps[0][1].shape):
        right = None  # of another size: not the truth of these photographs
    references = [maps[0]] + ([right] if right is not None else [])
    edges = [block_edges(length) for length in grid.shape]
    blocks = (len(edges[0]) - 1, len(edges[1]) - 1)
    counts = np.zeros(blocks)
    angles = [_Errors(blocks, len(maps)) for _ in references]
    heights = [_Heights(blocks, len(maps)) for _ in references]
    coverage = Coverage(folders, "confidence.tif")
    step = max(1, int(np.sqrt(grid.rows * grid.columns / _SAMPLE)))
    for row, band in _bands(edges[0], grid.columns):
        parts = [(np.asarray(n[band]), np.asarray(z[band], np.float64)) for n, z in maps]
        others = [(np.asarray(n[band]), np.asarray(z[band], np.float64)) for n, z in references]
        known = _known((*parts, *others))
        counts[row] += np.add.reduceat(known.sum(axis=0), edges[1][:-1])
        plane = _plane(known, band, grid)
        for (n, z), angle, height in zip(others, angles, heights, strict=True):
            height.matrix += np.tensordot(plane, plane, axes=((1, 2), (1, 2)))
            for k, (normal, surface) in enumerate(parts):
                error = np.where(known, angles_between(normal, n), 0)
                angle.add(row, edges[1], k, error, error[::step, ::step][known[::step, ::step]])
                height.add(row, edges[1], k, surface - z, known, plane)
                if right is not None and angle is angles[-1]:
                    coverage.add(k, band, error, known)
    found.pixels, found.share = int(counts.sum()), float(counts.sum() / (grid.rows * grid.columns))
    if not found.pixels:
        return
    _summarise(found, angles, heights, counts, right is not None)
    if right is not None:
        found.values["normals_coverage"] = coverage.percents()
        constants = [heights[-1].constant(k, counts.sum()) for k in range(len(maps))]
        found.values["height_coverage"] = _height_coverage(folders, [*maps, right], constants, edges[0])


def _height_coverage(
    folders: Sequence[Path], maps: Sequence[tuple[Array, Array]], constants: Sequence[float], rows: Array
) -> list[float | None]:
    """Share of the heights within their stated uncertainty, in a second reading: the best constants are known now.

    The last of the ``maps`` is the truth.
    """
    coverage = Coverage(folders, "height_uncertainty.tif")
    stating = [k for k in range(len(folders)) if coverage.states(k)]
    if not stating:
        return coverage.percents()
    for _, band in _bands(rows, maps[0][1].shape[1]):
        parts = [(np.asarray(n[band]), np.asarray(z[band], np.float64)) for n, z in maps]
        known = _known(parts)
        for k in stating:
            coverage.add(k, band, np.abs(parts[k][1] - parts[-1][1] - constants[k]), known)
    return coverage.percents()


def _known(parts: Sequence[tuple[Array, Array]]) -> Array:
    """Pixels whose normal and height are known to all, (h, W)."""
    return np.asarray(np.logical_and.reduce([np.isfinite(n).all(axis=-1) & np.isfinite(z) for n, z in parts]))


def _summarise(
    found: TileMeasures, angles: list[_Errors], heights: list[_Heights], counts: Array, truth: bool
) -> None:
    """Turn sums into means, percentiles and roots."""
    total = counts.sum()
    numbers = [
        {
            "angle_mean_deg": float(angle.sums[..., k].sum() / total),
            "angle_p95_deg": angle.percentile(k, 95),
            "height_rms": float(np.sqrt(height.block_squares(counts)[..., k].sum() / total)),
            "height_rms_after_plane": height.after_plane(k, total),
        }
        for angle, height in zip(angles, heights, strict=True)
        for k in range(angle.sums.shape[2])
    ]
    variants = angles[0].sums.shape[2]
    found.differences = numbers[:variants]
    if truth:
        names = {
            "angle_error": "angle_mean_deg",
            "angle_error_p95": "angle_p95_deg",
            "height_error": "height_rms",
            "height_error_plane": "height_rms_after_plane",
        }
        for key, name in names.items():
            found.values[key] = [one[name] for one in numbers[variants:]]
        with np.errstate(invalid="ignore", divide="ignore"):
            found.places["angle_error"] = angles[1].sums / counts[..., None]
            found.places["height_error"] = heights[1].block_squares(counts) / counts[..., None]
        found.weights["angle_error"] = found.weights["height_error"] = counts


def _plane(known: Array, band: slice, grid: PixelGrid) -> Array:
    """1, x, y at the known pixels of a band and 0 elsewhere, (3, h, W); x and y from -1 to 1."""
    half = max(grid.rows, grid.columns) * grid.pixel_size / 2
    x, y = grid.x() / half, grid.y(band.start, band.stop) / half
    return np.where(known, np.stack(np.broadcast_arrays(1.0, x[None, :], y[:, None])), 0)


def _tiff(path: Path) -> Array:
    import tifffile

    return np.asarray(tifffile.imread(path))


def block_edges(length: int) -> Array:
    """Beginnings of the blocks along a side of so many pixels, and its end."""
    return np.linspace(0, length, min(BLOCKS, length) + 1).astype(int)


def _bands(edges: Array, columns: int) -> Iterator[tuple[int, slice]]:
    """Bands of rows that lie within one row of blocks."""
    most = max(1, _BAND_PIXELS // columns)
    for i, (start, stop) in enumerate(pairwise(edges)):
        for first in range(start, stop, most):
            yield i, slice(int(first), int(min(first + most, stop)))


def _held_out(found: TileMeasures, normals: Sequence[Path]) -> None:
    """Squared errors of each lamp's prediction, (lamps, 1, K), in (% of albedo)^2."""
    lamps = np.array([read_agreement(folder).held_out for folder in normals], float).T
    found.places["held_out"] = (100 * lamps[:, None, :]) ** 2
    found.weights["held_out"] = np.ones((len(lamps), 1))


def _misclosure(found: TileMeasures, normals: Sequence[Path], grid: PixelGrid) -> None:
    """Mean squares of the curl in blocks, (R, C, K), in µm^2 (px^2 without a scale)."""
    rows, columns = (block_edges(length) for length in grid.shape)
    squares = np.full((len(rows) - 1, len(columns) - 1, len(normals)), np.nan)
    scale = 1000 if grid.unit == "mm" else 1
    for k, folder in enumerate(normals):
        measured = read_array(folder / "normals.npy")
        for i, j in np.ndindex(squares.shape[:2]):
            block = np.ascontiguousarray(measured[rows[i] : rows[i + 1], columns[j] : columns[j + 1]])
            block.flags.writeable = False  # as the maps: another type would be compiled once more
            curl = misclosure(
                block, PixelGrid(block.shape[0], block.shape[1], grid.pixel_size, unit=grid.unit)
            )
            squares[i, j, k] = np.nan if curl is None else (scale * curl) ** 2
    found.places["misclosure"] = squares
    found.weights["misclosure"] = np.multiply.outer(np.diff(rows), np.diff(columns)).astype(float)


def unit_of(metric: Metric, grid_units: Sequence[str]) -> str:
    """A metric's unit: lengths are in pixels where a tile has no scale."""
    return "px" if metric.unit in ("mm", "µm") and "px" in grid_units else metric.unit


def summary(measures: Mapping[str, Any], key: str, variants: int) -> list[float | None]:
    """Mean over the tiles of a number of each variant; None where a tile has none."""
    columns = [one.values[key] for one in measures.values() if key in one.values]
    return [
        float(np.mean([row[k] for row in columns]))
        if columns and all(row[k] is not None for row in columns)
        else None
        for k in range(variants)
    ]
