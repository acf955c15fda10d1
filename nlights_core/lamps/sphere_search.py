"""Search for chrome spheres in photographs: circles whose highlight wanders with the lamps.

Circles alone are everywhere: coins, plates, heads.  A mirror sphere has, under every lamp, one small
bright spot inside its circle, and under every lamp at another place.  So circles are proposed by their
edges, placed by their outlines, and believed by their highlights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array
from nlights_core.lamps.spheres import fit_circle

LEAST_SUPPORT = 0.5
"""Share of the outline that must be seen before a circle is believed: photographed spheres show 0.5
to 0.9, noise pretends 0.2 and the shadows around a sphere 0.4."""

LEAST_LAMPS = 0.8
"""Share of the lamps whose highlight must be seen in the circle: spheres show all, coins and stones few."""

SMALLEST = 10.0
"""Radius of the smallest circle that is proposed, px of the photographs given."""

OCTAVE = 12
"""Radius, px of a reduced photograph, from which to twice as much small circles are voted for."""

VOTED = 250
"""Longer side of the photographs in which large circles are voted for, px."""

PROPOSALS = 12
"""Circles that each size proposes."""

SPOT = 0.05
"""Share of a disc that a highlight takes at the most: that of a lamp with a radius of 25 degrees."""

HORIZON = np.sqrt(2)
"""How much larger the outline is than the ring, often stronger, where the mirrored table begins."""


@dataclass(frozen=True)
class Found:
    """A circle that may be a sphere's.

    Attributes
    ----------
    circle : (3,) float64 array
        Column and row of the centre, radius; px.
    support : float
        Share of the rays, from 0 to 1, whose edge lies within 2 % of the radius of the circle;
        chance alone gives a quarter.
    lamps : float
        Share of the lamps that show one small highlight in it, each at its own place.
    """

    circle: Array
    support: float
    lamps: float

    @property
    def is_sphere(self) -> bool:
        """Test whether outline and highlights are those of a sphere."""
        return self.support >= LEAST_SUPPORT and self.lamps >= LEAST_LAMPS


def find_spheres(photographs: Array, outlined: Array | None = None) -> list[Found]:
    """Circles in the photographs, the likeliest spheres first, none within another.

    Parameters
    ----------
    photographs : (L, h, w) array
        Grey photographs under all lamps.
    outlined : (h, w) array, optional
        A photograph in even light, which shows the outline better.

    Returns
    -------
    list of Found
        Spheres before what is none; empty where there is no circle at all.
    """
    even = np.median(photographs, axis=0) if outlined is None else outlined
    image = log_of(even)
    lights = wandering(photographs)
    votes_from = image if outlined is not None else log_of(np.mean(photographs, axis=0))
    found: list[Found] = []
    for start in _proposals(votes_from):
        circle, support = place_circle(image, start)
        # A ring within a ring within the outline: a wall's edge, the table's, the sphere's.
        for _ in range(2):
            circle, support = outline_around(image, circle, support) or (circle, support)
        if support > 0 and _within(circle, image.shape):
            found.append(Found(circle, support, share_of_highlights(lights, circle)))
    found.sort(key=lambda one: (one.is_sphere, one.lamps * one.support), reverse=True)
    alone: list[Found] = []
    for one in found:
        rivals = [k for k, other in enumerate(alone) if _overlap(one.circle, other.circle)]
        if not rivals:
            alone.append(one)
        elif one.is_sphere and _is_outline_of(one, alone[rivals[0]]):
            alone[rivals[0]] = one
    return alone


def log_of(image: Array) -> Array:
    """Logarithm with a floor at one hundredth of the median: edges in the dark count too."""
    return np.asarray(np.log(image + 0.01 * np.median(image) + 1e-3))


def wandering(photographs: Array) -> Array:
    """Excess of each photograph over the median of all: what moves with the lamps."""
    return np.asarray(photographs - np.median(photographs, axis=0))


def place_circle(image: Array, start: Array) -> tuple[Array, float]:
    """Circle along the outline near a start.

    The outermost place along each of 720 rays where brightness still changes half as fast as at its
    steepest, because near its limb the sphere mirrors what is just outside and the steepest place
    lies a little inside.  A robust fit passes over stand, reflections and shadows.

    Parameters
    ----------
    image : (h, w) array
        Of `log_of`.
    start : (3,) array
        Column and row of the centre, radius; px.

    Returns
    -------
    circle : (3,) float64 array
    support : float
        As in `Found`; 0 where there is no outline.
    """
    circle = np.asarray(start, float)
    for width in (0.08, 0.04, 0.02):
        # Small circles are not known to a few per cent yet: two pixels at least.
        points, _ = outline_points(image, circle, max(width, 2 / circle[2]))
        if len(points) < 3:
            return circle, 0.0
        circle = fit_circle(points, tolerance=max(0.5, 0.002 * circle[2]))
        if not _near(circle, start):
            return np.asarray(start, float), 0.0
    return circle, support_of(image, circle)


def outline_around(image: Array, circle: Array, support: float) -> tuple[Array, float] | None:
    """Outline of the sphere in which a circle is the ring where the mirrored table begins; None where it is none.

    Parameters
    ----------
    image : (h, w) array
        Of `log_of`.
    circle : (3,) array
    support : float
        Of the circle.

    Returns
    -------
    circle, support : as of `place_circle`
    """
    outer, seen = place_circle(image, circle * np.array([1, 1, HORIZON]))
    larger = outer[2] > 1.3 * circle[2] and support > 0
    return (outer, seen) if larger and seen >= max(LEAST_SUPPORT, 0.6 * support) else None


def support_of(image: Array, circle: Array) -> float:
    """Share of the rays whose edge lies on a circle; see `Found`."""
    # Judged in a wide ring: in a narrow one any edge is close to the circle.
    width = max(0.08, 4 / circle[2])
    points, seen = outline_points(image, circle, width)
    distance = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]
    return float(np.mean(np.abs(distance) < width / 4 * circle[2])) * seen if len(points) else 0.0


def outline_points(image: Array, circle: Array, width: float) -> tuple[Array, float]:
    """Outermost strong edge on each ray within ``width`` radii; points (n, 2), share of rays."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    # Only the circle's surroundings are smoothed: there may be many circles in a large photograph.
    reach = circle[2] * (1 + width) + 4
    left, top = np.maximum(np.floor(circle[:2] - reach), 0).astype(int)
    right, bottom = np.maximum(np.ceil(circle[:2] + reach), 0).astype(int) + 1
    part = image[top:bottom, left:right]
    radius = np.arange(circle[2] * (1 - width), circle[2] * (1 + width), 0.5)[:, None]
    if len(radius) < 2 or min(part.shape) < 3:
        return np.empty((0, 2)), 0.0
    blur = max(0.7, circle[2] / 300)
    smooth = gaussian_filter(part, blur)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    column, row = circle[0] + radius * np.cos(angle), circle[1] + radius * np.sin(angle)
    brightness = map_coordinates(smooth, [row - top, column - left], order=1, mode="nearest")
    change = np.abs(np.gradient(brightness, axis=0))
    h, w = image.shape
    change[(column < 1) | (column > w - 2) | (row < 1) | (row > h - 2)] = 0
    steepest = change.max(axis=0)
    outermost = len(radius) - 1 - (change >= 0.5 * steepest)[::-1].argmax(axis=0)
    clear = (steepest > 0.5 * np.median(steepest)) & (steepest > 0)
    # A sharp edge so blurred changes half as fast at 1.18 standard deviations.
    at = radius[outermost, 0] - 1.18 * blur
    points = circle[:2] + at[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return points[clear], float(clear.mean())


def share_of_highlights(lights: Array, circle: Array) -> float:
    """Share of the lamps that show one small highlight in a circle, each at its own place.

    Parameters
    ----------
    lights : (L, h, w) array
        Of `wandering`.
    circle : (3,) array

    Returns
    -------
    float
        From 0 to 1.
    """
    left, top = np.maximum(np.floor(circle[:2] - circle[2]), 0).astype(int)
    right, bottom = np.maximum(np.ceil(circle[:2] + circle[2]), 0).astype(int) + 1
    part = lights[:, top:bottom, left:right]
    rows, columns = np.mgrid[: part.shape[1], : part.shape[2]]
    # A lamp in front of the artwork is mirrored within 0.71 radii; further out is the table.
    inside = np.hypot(columns + left - circle[0], rows + top - circle[1]) < 0.75 * circle[2]
    if inside.sum() < 9:
        return 0.0
    columns, rows = np.asarray(columns)[inside], np.asarray(rows)[inside]
    spots = []
    for disc in part[:, inside]:
        peak, usual = float(disc.max()), float(np.median(np.abs(disc)))
        if peak <= 0:
            continue
        bright = disc > 0.5 * peak
        spot = np.array([np.median(columns[bright]), np.median(rows[bright])])
        near = np.hypot(columns[bright] - spot[0], rows[bright] - spot[1]) < max(2.0, 0.2 * circle[2])
        # A highlight of a few pixels is as small as it can be.
        small = bright.sum() <= max(9, SPOT * inside.sum())
        if peak > max(6 * usual, 0.02) and small and near.mean() >= 0.7:
            spots.append(spot)
    if len(spots) < 2:
        return 0.0
    places = np.array(spots)
    spread = np.sqrt(places.var(axis=0).sum())
    return len(spots) / len(lights) if spread > 0.06 * circle[2] else 0.0


def _proposals(image: Array) -> list[Array]:
    """Circles for which an image's edges vote, small ones in finer pictures; px of the image."""
    h, w = image.shape
    found: list[Array] = []
    coarsest = max(1, round(max(h, w) / VOTED))
    factor, first = 1, SMALLEST
    while factor < coarsest:
        small = _reduced(image, factor)
        radii = np.arange(int(first), 2 * OCTAVE + 1)
        found += [_in_whole(c, factor) for c in _small_circles(small, radii)]
        factor, first = factor * 2, OCTAVE
    small = _reduced(image, coarsest)
    least = max(3, int(min(OCTAVE, 0.12 * min(small.shape))))
    radii = np.arange(least, int(0.55 * min(small.shape)) + 1)
    return found + [_in_whole(c, coarsest) for c in _large_circles(small, radii)]


def _in_whole(circle: Array, factor: int) -> Array:
    # The centre of a block of pixels lies half a block, less half a pixel, after its first one.
    return np.asarray(circle * factor + np.array([0.5, 0.5, 0]) * (factor - 1))


def _reduced(image: Array, factor: int) -> Array:
    h, w = (size // factor * factor for size in image.shape)
    return np.asarray(image[:h, :w].reshape(h // factor, factor, w // factor, factor).mean(axis=(1, 3)))


def _edges(image: Array) -> Array:
    from skimage.feature import canny

    quantiles = {"use_quantiles": True, "low_threshold": 0.7, "high_threshold": 0.9}
    edges: Array = canny(image, sigma=1.5, **quantiles)  # type: ignore[no-untyped-call]
    return edges


def _large_circles(image: Array, radii: Array) -> list[Array]:
    """Circles for which each edge votes with all circles through it."""
    from scipy.ndimage import gaussian_filter
    from skimage.transform import hough_circle

    if not len(radii):
        return []
    # Votes are blurred over neighbouring circles: a photographed outline is no perfect circle.
    votes = hough_circle(_edges(image), radii, full_output=True)  # type: ignore[no-untyped-call]
    return [
        np.array([column - radii[-1], row - radii[-1], radii[k]], float)
        for k, row, column in _peaks(gaussian_filter(votes, 1))
    ]


def _small_circles(image: Array, radii: Array) -> list[Array]:
    """Circles for which each edge votes along its gradient alone: many edges, short ways."""
    from scipy.ndimage import gaussian_filter

    rows, columns = np.nonzero(_edges(image))
    if not len(rows):
        return []
    smooth = gaussian_filter(image, 1.5)
    down, across = (d[rows, columns] for d in np.gradient(smooth))
    length = np.hypot(down, across)
    length[length == 0] = 1
    margin = radii[-1]
    shape = image.shape[0] + 2 * margin, image.shape[1] + 2 * margin
    votes = np.zeros((len(radii), *shape), np.float32)
    for k, radius in enumerate(radii):
        for side in (-1, 1):
            row = np.round(rows + side * radius * down / length).astype(int) + margin
            column = np.round(columns + side * radius * across / length).astype(int) + margin
            count = np.bincount(row * shape[1] + column, minlength=shape[0] * shape[1])
            votes[k] += count.reshape(shape) / np.float32(2 * np.pi * radius)
    votes = gaussian_filter(votes, (1, 1.5, 1.5))
    return [np.array([column - margin, row - margin, radii[k]], float) for k, row, column in _peaks(votes)]


def _peaks(votes: Array) -> list[tuple[int, int, int]]:
    """Places of the most votes, none beside another."""
    from scipy.ndimage import maximum_filter

    height = votes.max(axis=0)
    tops = (height == maximum_filter(height, size=5)) & (height > 0)
    rows, columns = np.nonzero(tops)
    best = np.argsort(height[rows, columns])[::-1][:PROPOSALS]
    return [
        (int(votes[:, r, c].argmax()), int(r), int(c)) for r, c in zip(rows[best], columns[best], strict=True)
    ]


def _near(circle: Array, start: Array) -> bool:
    return bool(
        np.hypot(circle[0] - start[0], circle[1] - start[1]) < 0.3 * start[2] + 3
        and 0.7 * start[2] - 3 < circle[2] < 1.4 * start[2] + 3
    )


def _within(circle: Array, shape: tuple[int, ...]) -> bool:
    h, w = shape
    return bool(0 <= circle[0] < w and 0 <= circle[1] < h and circle[2] < 0.6 * min(h, w))


def _is_outline_of(outer: Found, inner: Found) -> bool:
    """Test whether a circle is seen nearly as well as one within it: what is mirrored lies within."""
    apart = np.hypot(*(outer.circle[:2] - inner.circle[:2]))
    larger = outer.circle[2] > 1.2 * inner.circle[2]
    return bool(larger and apart < 0.15 * outer.circle[2] and outer.support > 0.7 * inner.support)


def _overlap(a: Array, b: Array) -> bool:
    return bool(np.hypot(a[0] - b[0], a[1] - b[1]) < max(a[2], b[2]))
