"""The free constant of a height, found in the photographs themselves.

Integration leaves the constant free.  It matters: near lamps light a surface 1 mm higher from
another angle, and its flat field is read elsewhere, which bends a relief by some 0.05 mm.  It can
be seen, too: raised by dz, a point is lit along rays that meet the plane somewhere else, where
each lamp's flat field is brighter or darker by an amount that is known.  Eight lamps leave five
equations over, so the right constant is the one at which the photographs agree best.

A lamp that has drifted since the flats were taken would be mistaken for height, so a factor
per lamp is fitted along (and bound to 1 by a prior).  It has bent the height that it was
integrated to as well: a fit that took the height for right would answer a tilt with more of it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.poisson import simchony
from nlights_core.machine.band_threads import in_order
from nlights_core.near_light.linearisation import Linearised, Strip, linearise
from nlights_core.photographs.development import Darkroom
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving import least_squares

BLOCKS = 32
"""Across the field, on which it is computed what a drift does to the height: that is smooth."""

PIXELS = 30_000
"""About how many pixels are looked at."""

LINES = 16
"""Rows that are looked at, at least: they must show the whole height of the tile."""

INDEPENDENT = 300
"""As how many independent pixels they count: what is wrong with the flat field is wrong for all neighbours
at once, so a million pixels know little more than some hundred."""

GLOSSY = 0.01
"""With more than this share of samples beyond five times the spread a surface is not matt: Gaussian
noise has none there, matt simulated scenes have none, varnished ones 3 to 4 %."""

STRENGTH_PRIOR = 0.01
"""Standard deviation of a lamp's drift since the flats were taken."""

STEADY = 0.002
"""Drifts that smoothing and noise of a flat field pretend where there are none: about 0.1 %."""

HEIGHT_PRIOR = 5.0
"""Standard deviation of the surface's level about the plane of the flat, mm."""

ROUNDS = 5
CLOSE = 0.01
"""A change of the offset below this, mm, ends the rounds, if the drifts have settled too."""

SETTLED = STEADY / 4
"""A change of a drift below this is of no account."""

REWEIGHTINGS = 4
TUNING = 2.385
"""Cauchy's loss with this times the spread keeps 95 % of the efficiency of least squares on clean data."""


@dataclass(frozen=True)
class Level:
    """Fitted level of the surface, and strengths of the lamps.

    Attributes
    ----------
    offset : float
        To be added to the height, mm.
    uncertainty : float or None
        Its standard deviation, mm, as far as the fit can tell; None: it could not be found.
    strengths : (L,) float64 array
        Each lamp's strength in the frames against the flats.
    """

    offset: float
    uncertainty: float | None
    strengths: Array


def write_level(folder: Path, found: Level) -> None:
    """Write ``level.json``."""
    record = {
        "offset_mm": found.offset,
        "uncertainty_mm": found.uncertainty,
        "strengths": found.strengths.tolist(),
    }
    (folder / "level.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_level(folder: Path) -> Level:
    """Read what `write_level` wrote."""
    record = json.loads((folder / "level.json").read_text(encoding="utf-8"))
    return Level(record["offset_mm"], record["uncertainty_mm"], np.array(record["strengths"]))


def find_level(
    room: Darkroom, lights: LightField, flat_field: FlatField, height: Array, assumed: Array | None = None
) -> Level:
    """Find the constant at which the photographs agree best.

    Parameters
    ----------
    room : Darkroom
        The open photographs of a tile.
    lights : LightField
        Near lamps.
    flat_field : FlatField
        What a flat reads.
    height : (H, W) array
        Height up to a constant, mm.
    assumed : (L,) array, optional
        Strengths of the lamps with which that height was measured; all 1 by default.

    Returns
    -------
    Level

    Notes
    -----
    Gauss-Newton on the offset and the lamps' factors; normals and albedo are eliminated in every
    pixel (the residual is projected off what a change of normal could explain).  Samples that
    disagree by much more than is usual count less and less (Cauchy's loss).  Where they are too
    many the surface is glossy, and nothing is found: gloss must not be taken for height.
    """
    rows = _sample_rows(room)
    bends = _bends(room.grid, lights, flat_field)
    strips = [
        Strip(
            room.raw(*lines, lights), np.asarray(height[slice(*lines)]), _enlarged(bends, room.grid, *lines)
        )
        for lines in rows
    ]
    count = len(lights.lamps)
    before = np.zeros(count) if assumed is None else np.log(assumed)
    offset, logarithms = 0.0, np.zeros(count)
    prior = np.diag([HEIGHT_PRIOR**-2, *[STRENGTH_PRIOR**-2] * count])
    lowest = float(np.min(lights.positions[:, 2])) if lights.positions is not None else np.inf
    reach = lowest / 4
    information = prior
    for _ in range(ROUNDS):
        matrix, right, pixels = _equations(room, lights, flat_field, strips, offset, logarithms, before)
        if pixels < INDEPENDENT:
            return Level(0.0, None, np.ones(count))
        share = min(1.0, INDEPENDENT / pixels)
        information = share * matrix + prior
        state = np.array([offset, *logarithms])
        change = np.linalg.solve(information, share * right - prior @ state)
        offset = float(np.clip(offset + change[0], -reach, reach))
        logarithms = np.clip(logarithms + change[1:], -0.2, 0.2)
        if abs(change[0]) < CLOSE and np.max(np.abs(change[1:])) < SETTLED:
            break
    covariance = np.linalg.inv(information)
    drifts = _significant(logarithms, covariance[1:, 1:])
    return Level(offset, float(np.sqrt(covariance[0, 0])), np.exp(drifts))


def _significant(logarithms: Array, covariance: Array) -> Array:
    """Shrink drifts towards none as far as what is not drift could have made them.

    Two patterns of drift look like a tilt of the whole artwork, so that little but the prior holds
    them, and lamps at wrong positions are mistaken for them.  Lamps drift independently: how much
    they do shows in the other patterns, and these two are believed in that proportion.  Lamps
    that have hardly drifted are left alone: correcting what is not there would bend the height.

    Parameters
    ----------
    logarithms : (L,) array
        Of the lamps' strengths, as fitted.
    covariance : (L, L) array
        Of them.

    Returns
    -------
    (L,) array
        Of mean 0: in every direction k of the covariance the fitted value times
        ``d^2 / (d^2 + s_k^2 + STEADY^2)``, with the drift's variance d^2 as the well-determined
        directions show it (empirical Bayes).
    """
    count = len(logarithms)
    centre = np.eye(count) - 1 / count
    variances, directions = np.linalg.eigh(centre @ covariance @ centre)
    # The first is the strength of all lamps together, which the centring has taken out.
    variances, found = variances[1:], (directions.T @ centre @ logarithms)[1:]
    known = variances <= 9 * variances[0]
    drift = max(0.0, float(np.mean(found[known] ** 2)) - STEADY**2)
    return np.asarray(directions[:, 1:] @ (found * drift / (drift + variances + STEADY**2)))


def _sample_rows(room: Darkroom) -> list[tuple[int, int]]:
    """Rows spread over the whole height of the tile."""
    rows, columns = room.grid.shape
    wanted = int(np.clip(PIXELS // columns, min(rows, LINES), rows))
    thickness = max(1, wanted // 16)
    starts = np.linspace(0, rows - thickness, max(1, wanted // thickness)).round().astype(int)
    return [(int(start), int(start) + thickness) for start in dict.fromkeys(starts)]


def _equations(
    room: Darkroom,
    lights: LightField,
    flat_field: FlatField,
    strips: Sequence[Strip],
    offset: float,
    logarithms: Array,
    before: Array,
) -> tuple[Array, Array, int]:
    """Normal equations of offset and strengths, in units of the residuals' variance.

    No pixels are counted when too many samples are strange: gloss would be taken for height.
    """

    def at_present(strip: Strip) -> Linearised:
        return linearise(room, lights, flat_field, strip, offset, logarithms, before)

    parts = list(in_order(at_present, strips))
    size = len(lights.lamps) + 1
    matrix, right, pixels = np.zeros((size, size)), np.zeros(size), 0
    settled, scale = parts, 1.0
    for _ in range(REWEIGHTINGS):
        # One scale for all: the residuals' spread relative to what shot noise lets expect.
        surprise = np.concatenate([part.surprise.ravel() for part in settled])
        surprise = surprise[np.isfinite(surprise)]
        if not surprise.size:
            return matrix, right, 0
        scale = max(float(np.median(surprise)) / 0.6745, 1e-9)
        limit = TUNING * scale

        def reweighted(pair: tuple[Linearised, Linearised], limit: float = limit) -> Linearised:
            first, last = pair
            return first.reweighted(last.surprise, limit)

        settled = list(in_order(reweighted, zip(parts, settled, strict=True)))
    strange = np.concatenate([np.nan_to_num(part.surprise).ravel() for part in settled]) > 5 * scale
    if np.mean(strange) > GLOSSY:
        return matrix, right, 0
    for one, two, many in in_order(lambda part: part.sums(scale), settled):
        matrix, right, pixels = matrix + one, right + two, pixels + many
    return matrix, right, pixels


def _bends(grid: PixelGrid, lights: LightField, flat_field: FlatField) -> Array:
    """Bend that a flat surface seems to get when a lamp becomes stronger, on a coarse grid.

    Returns
    -------
    (L, h, w) float64 array
        mm per unit of the logarithm of the lamp's strength, of mean 0.
    """
    edge = max(1, -(-max(grid.shape) // BLOCKS))
    coarse = PixelGrid(-(-grid.rows // edge), -(-grid.columns // edge), grid.pixel_size * edge)
    points = coarse.points(0, coarse.rows)
    rays = lights.vectors(points).astype(np.float64)
    rays = np.broadcast_to(rays / rays[..., 2:], (len(lights.lamps), *coarse.shape, 3))
    weights = np.stack([flat_field.at(i, points[0], points[1]).mean(axis=-1) for i in range(len(rays))])
    inverse = least_squares.fit(np.ones(weights.shape), rays, weights, np.inf).inverse
    bends = np.empty(weights.shape)
    for i, (ray, weight) in enumerate(zip(rays, weights, strict=True)):
        turned = least_squares.multiply(inverse, np.moveaxis(ray, -1, 0) * weight)
        bends[i] = simchony(-turned[0] * coarse.pixel_size, turned[1] * coarse.pixel_size)
    return bends


def _enlarged(bends: Array, grid: PixelGrid, start: int, stop: int) -> Array:
    """Rows of coarse maps (L, h, w) on the grid of the photographs, (L, stop - start, W)."""
    rows = np.arange(start, stop) / max(grid.rows - 1, 1) * (bends.shape[1] - 1)
    columns = np.arange(grid.columns) / max(grid.columns - 1, 1) * (bends.shape[2] - 1)
    above, left = (
        np.minimum(place.astype(int), max(count - 2, 0))
        for place, count in ((rows, bends.shape[1]), (columns, bends.shape[2]))
    )
    below, right = np.minimum(above + 1, bends.shape[1] - 1), np.minimum(left + 1, bends.shape[2] - 1)
    lines = bends[:, above] + (bends[:, below] - bends[:, above]) * (rows - above)[None, :, None]
    return np.asarray(lines[:, :, left] + (lines[:, :, right] - lines[:, :, left]) * (columns - left))
