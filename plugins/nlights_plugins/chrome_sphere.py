"""The chrome-sphere light model: one direction per lamp from its highlight on mirror spheres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import LightModel, Read
from nlights_core.capture import Sphere, Tile
from nlights_core.capture_warnings import CaptureWarning, warn
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.lamps.sphere_search import (
    LEAST_LAMPS,
    LEAST_SUPPORT,
    Found,
    find_spheres,
    log_of,
    outline_around,
    place_circle,
    support_of,
)
from nlights_core.lamps.spheres import (
    circle_of_mask,
    doubt_of_directions,
    fit_circle,
    highlight_centre,
    mirror_direction,
    to_grey,
)
from nlights_core.machine.progress import part, tell

LAMPS = 16
"""Photographs in which spheres are searched for, about."""

SEARCHED = 1600
"""Longer side of the photographs in which spheres are searched for, px."""

RADIUS = 300
"""Radius at which an outline is placed, px: to a thousandth of the sphere's size."""

BESIDE = 0.03
"""Radii by which a stated circle may miss the outline that is seen: they turn lamps by 2 to 4 degrees."""

CONTRADICTION_DEG = 25.0
"""Angle between two spheres' directions of a lamp; a near lamp seen from both ends of a field has less."""

REMEDY = (
    "give the sphere's outline in even light, its circle_px (column, row, radius), points_px or mask, or photographs "
    "in which it is sharp and at least 3 % of the longer side wide"
)
"""What to do where no sphere was found."""


class ChromeSphere(LightModel):
    """Distant lamps, each in the direction that its highlight on chrome spheres tells.

    PSBox's method [1]_ without its clicking: the spheres are found in the photographs (best in one
    in even light, ``outline``) unless the capture states their circles.  The directions of several
    spheres are averaged.  Known errors are 2 to 3 degrees, and the whole field gets one direction: a
    baseline for measured positions.

    References
    ----------
    .. [1] Y. Xiong, PSBox, 2014: ``FindLightDirectionFromChromeSphere.m``.
    """

    name: ClassVar[str] = "chrome-sphere"
    needs: ClassVar[tuple[str, ...]] = ("spheres",)

    highlight: float = Field(
        default=250 / 255,
        gt=0,
        le=1,
        description="fraction of saturation from which on a pixel of the sphere belongs to the highlight",
    )

    def locate(self, tile: Tile, read: Read) -> LightField:
        """Find the lamps from the tile's chrome spheres.

        Parameters
        ----------
        tile : Tile
            ``tile.spheres`` holds a photograph of each sphere under each lamp.
        read : Read
            How to look at a photograph.

        Returns
        -------
        LightField
            Distant, unit power.

        Raises
        ------
        TileError
            When there is no sphere, a lamp's photograph is missing, no sphere or no highlight is
            found, a stated circle lies beside the sphere that is seen, or the directions are those
            of no rig.
        """
        if not tile.spheres:
            raise TileError(f"tile {tile.name}: chrome-sphere needs spheres, but the capture has none")
        seen: list[tuple[Array, Array]] = []
        # All spheres of the same photographs are found at once, however often they are listed.
        listed = [s for k, s in enumerate(tile.spheres) if s not in tile.spheres[:k]]
        for k, sphere in enumerate(listed):
            with part(k / len(listed), (k + 1) / len(listed)):
                seen += _Probe(tile, sphere, read, self.highlight).directions()
        _check_agreement(tile, seen)
        total = np.sum([directions for _, directions in seen], axis=0)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return LightField(lamps=tile.lamps, directions=total / length)


class _Probe:
    """Photographs of one or more spheres, all of the same kind of description."""

    def __init__(self, tile: Tile, sphere: Sphere, read: Read, highlight: float) -> None:
        missing = [lamp for lamp in tile.lamps if lamp not in sphere.frames]
        if missing:
            raise TileError(f"tile {tile.name}: spheres: no photograph for lamp {', '.join(missing)}; add it")
        self._tile, self._sphere, self._read, self._highlight = tile, sphere, read, highlight
        self._first = sphere.outline or sphere.frames[tile.lamps[0]]
        # Enough lamps to see how highlights wander, spread over all.
        every = -(-len(tile.lamps) // LAMPS)
        self._some = tile.lamps[::every]

    def directions(self) -> list[tuple[Array, Array]]:
        """Circle (3,), px, and directions of all lamps (L, 3), unit vectors, of each sphere."""
        stated = _stated(self._tile, self._sphere, self._read)
        circles = self._search() if stated is None else [stated]
        spots, cuttings = self._look(circles)
        found = []
        for circle, places, cutting in zip(circles, spots, cuttings, strict=True):
            if stated is None:
                circle, _ = cutting.placed(circle)
            else:
                self._doubt_outline(circle, cutting)
            directions = np.array([mirror_direction(spot, circle) for spot in places])
            self._refuse_impossible(circle, directions)
            found.append((circle, directions))
        return found

    def _search(self) -> list[Array]:
        """Circles of the spheres in the photographs, to a pixel of the reduced ones."""
        spheres, others = self._found()
        if not spheres:
            best = others[0] if others else None
            seen = (
                "there is no circle in it"
                if best is None
                else f"the likeliest circle, {_said(best.circle)}, shows {100 * best.support:.0f} % of its outline "
                f"({100 * LEAST_SUPPORT:.0f} % needed) and a small highlight of {100 * best.lamps:.0f} % of the "
                f"lamps ({100 * LEAST_LAMPS:.0f} % needed)"
            )
            raise TileError(f"{self._first}: no chrome sphere found: {seen}; {REMEDY}")
        # What is seen much less well than the best is a glint on something round.
        return [sphere.circle for sphere in spheres if sphere.support > 0.6 * spheres[0].support]

    def _found(self) -> tuple[list[Found], list[Found]]:
        """Spheres, and circles that are none; px of the whole photographs."""
        # Spheres of 3 % of the longer side are 24 px wide then.
        factor = max(1, round(max(self._read(self._first).shape[:2]) / SEARCHED))
        greys = [self._grey(self._sphere.frames[lamp], factor) for lamp in self._some]
        even = self._grey(self._sphere.outline, factor) if self._sphere.outline else None
        shift = np.array([0.5, 0.5, 0]) * (factor - 1)
        found = [
            replace(one, circle=one.circle * factor + shift) for one in find_spheres(np.stack(greys), even)
        ]
        return [one for one in found if one.is_sphere], [one for one in found if not one.is_sphere]

    def _grey(self, path: Path, factor: int) -> Array:
        return to_grey(self._read(path, reduce=factor)).astype(np.float32)

    def _look(self, circles: list[Array]) -> tuple[list[list[Array]], list[_Cutting]]:
        """Highlights of all lamps in each circle, px, and what is around the circles."""
        spots: list[list[Array]] = [[] for _ in circles]
        cuttings = [_Cutting(circle) for circle in circles]
        for i, lamp in enumerate(self._tile.lamps):
            tell(i / len(self._tile.lamps))
            path = self._sphere.frames[lamp]
            photograph = self._read(path)
            for circle, places, cutting in zip(circles, spots, cuttings, strict=True):
                cut, corner = _crop(photograph, circle)
                places.append(self._spot(path, lamp, to_grey(cut), circle - corner) + corner[:2])
                if lamp in self._some and not self._sphere.outline:
                    cutting.add(photograph)
        if self._sphere.outline:
            photograph = self._read(self._sphere.outline)
            for cutting in cuttings:
                cutting.add(photograph)
        return spots, cuttings

    def _spot(self, path: Path, lamp: str, grey: Array, circle: Array) -> Array:
        try:
            spot = highlight_centre(grey, circle, self._highlight)
        except ValueError as fault:
            raise TileError(
                f"{path}: no highlight on the chrome sphere of lamp {lamp}: {fault}; expose the sphere "
                "so that only the lamp's reflection saturates, set 'highlight', or check that the circle lies on the "
                "sphere"
            ) from fault
        if mirror_direction(spot, circle)[2] <= 0:
            raise TileError(
                f"{path}: the highlight of lamp {lamp} is so close to the sphere's outline that the lamp "
                "would be behind the artwork; check circle_px and stray reflections"
            )
        return spot

    def _doubt_outline(self, circle: Array, cutting: _Cutting) -> None:
        """Refuse a stated circle beside the sphere that is seen; warn of one a little beside it."""
        support = cutting.support(circle)
        stated = f"tile {self._tile.name}: the stated circle of the sphere, {_said(circle)}"
        if support >= LEAST_SUPPORT:
            seen = cutting.around(circle, support)
        else:
            near, clear = cutting.placed(circle)
            seen = near if clear else None
            if seen is None:
                others = [one.circle for one in self._found()[0]]
                seen = min(others, key=lambda other: _apart(other, circle), default=None)
        if seen is not None and _apart(seen, circle) > BESIDE:
            raise TileError(
                f"{stated}, is not where the outline of one is seen, {_said(seen)}; state that, or nothing, to "
                "have it found"
            )
        if seen is not None or support >= LEAST_SUPPORT:
            return
        warn(
            CaptureWarning(
                code="sphere-outline",
                sentence=f"{stated}: its outline is hardly seen in {self._first.name} ({100 * support:.0f} % of "
                "it), so that nobody checked it; compare it with the photograph",
                value=round(100 * support, 1),
                unit="%",
            )
        )

    def _refuse_impossible(self, circle: Array, directions: Array) -> None:
        if doubt := doubt_of_directions(directions, self._tile.lamps):
            raise TileError(
                f"{self._first}: the circle {_said(circle)} is no chrome sphere's under these lamps: {doubt}; "
                f"{REMEDY}"
            )


class _Cutting:
    """Surroundings of a circle in the photographs, in pixels that place its outline well."""

    def __init__(self, circle: Array) -> None:
        self._factor = max(1, round(circle[2] / RADIUS))
        self._around = circle * np.array([1, 1, 1.6]) + np.array([0, 0, 8])
        self._greys: list[Array] = []
        self._corner = np.zeros(3)

    def add(self, photograph: Array) -> None:
        """Cut it out of one more photograph."""
        cut, self._corner = _crop(photograph, self._around)
        grey, k = to_grey(cut), self._factor
        h, w = (size // k * k for size in grey.shape)
        self._greys.append(grey[:h, :w].reshape(h // k, k, w // k, k).mean(axis=(1, 3)).astype(np.float32))

    def _image(self) -> Array:
        return log_of(np.median(self._greys, axis=0))

    def _shift(self) -> Array:
        return np.asarray(np.array([0.5, 0.5, 0]) * (self._factor - 1))

    def support(self, circle: Array) -> float:
        """Share of the circle's outline that is seen."""
        if not min(self._image().shape):
            return 0.0
        return support_of(self._image(), self._inside(circle))

    def around(self, circle: Array, support: float) -> Array | None:
        """The outline within which the circle is only the edge of the mirrored table, if one is seen."""
        found = outline_around(self._image(), self._inside(circle), support)
        return self._outside(found[0]) if found else None

    def placed(self, circle: Array) -> tuple[Array, bool]:
        """The circle along the outline, px of the whole photograph; the same, and false, where none is seen."""
        found, support = place_circle(self._image(), self._inside(circle))
        clear = support >= LEAST_SUPPORT
        return (self._outside(found), True) if clear else (circle, False)

    def _inside(self, circle: Array) -> Array:
        return np.asarray((circle - self._corner - self._shift()) / self._factor)

    def _outside(self, circle: Array) -> Array:
        return np.asarray(circle * self._factor + self._shift() + self._corner)


def _stated(tile: Tile, sphere: Sphere, read: Read) -> Array | None:
    """Circle as stated, from clicked points or from a mask, (3,) px; None where it is to be found."""
    if sphere.circle_px is not None:
        return np.array(sphere.circle_px, float)
    if sphere.points_px is not None:
        if len(sphere.points_px) < 3:
            raise TileError(
                f"tile {tile.name}: spheres.points_px: a circle needs 3 points, got {len(sphere.points_px)}"
            )
        return fit_circle(np.array(sphere.points_px, float))
    if sphere.mask is None:
        return None
    try:
        return circle_of_mask(to_grey(read(sphere.mask)))
    except ValueError as fault:
        raise TileError(f"{sphere.mask}: no sphere in the mask: {fault}; paint the sphere white") from fault


def _check_agreement(tile: Tile, seen: list[tuple[Array, Array]]) -> None:
    """Refuse spheres that contradict each other: one of the circles lies on something else."""
    for k, (circle, directions) in enumerate(seen):
        for other, its in seen[:k]:
            angle = float(np.degrees(np.median(np.arccos(np.clip((directions * its).sum(axis=1), -1, 1)))))
            if angle > CONTRADICTION_DEG:
                raise TileError(
                    f"tile {tile.name}: the spheres at {_said(other)} and {_said(circle)} contradict each other: "
                    f"{angle:.0f} degrees between their directions of a lamp (median; {CONTRADICTION_DEG:.0f} at the "
                    "most); one of them is no chrome sphere: state circle_px of those that are"
                )


def _apart(a: Array, b: Array) -> float:
    """Distance of two circles, in radii of the second."""
    return float(max(np.hypot(a[0] - b[0], a[1] - b[1]), abs(a[2] - b[2])) / b[2])


def _said(circle: Array) -> str:
    return "[" + ", ".join(f"{value:.1f}" for value in circle) + "]"


def _crop(photograph: Array, circle: Array) -> tuple[Array, Array]:
    """The square around a circle, and its corner: column, row, 0."""
    left, top = np.maximum(np.floor(circle[:2] - circle[2]).astype(int), 0)
    right, bottom = np.maximum(np.ceil(circle[:2] + circle[2]).astype(int) + 1, 0)
    return photograph[top:bottom, left:right], np.array([left, top, 0])
