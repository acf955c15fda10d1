"""The chrome-sphere light model: one direction per lamp from its highlight on mirror spheres."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import LightModel, Read
from nlights_core.capture import Sphere, Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.lamps.spheres import (
    circle_of_mask,
    find_circle,
    fit_circle,
    highlight_centre,
    mirror_direction,
    to_grey,
)

LEAST_SUPPORT = 0.35
"""Share of the outline that must be seen before a circle is believed: photographed spheres show 0.5
to 0.9, noise pretends 0.2."""


class ChromeSphere(LightModel):
    """Distant lamps, each in the direction that its highlight on chrome spheres tells.

    PSBox's method [1]_ without its clicking: the circle is found in the photographs (best in one
    in even light, ``outline``) unless the capture states it.  The directions of several spheres
    are averaged.  Known errors are 2 to 3 degrees, and the whole field gets one direction: a
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
            When there is no sphere, a lamp's photograph is missing, no circle or no highlight is
            found, or a highlight says that its lamp is behind the artwork.
        """
        if not tile.spheres:
            raise TileError(f"tile {tile.name}: chrome-sphere needs spheres, but the capture has none")
        total = sum(self._directions(tile, sphere, read) for sphere in tile.spheres)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return LightField(lamps=tile.lamps, directions=total / length)

    def _directions(self, tile: Tile, sphere: Sphere, read: Read) -> Array:
        """Directions of all lamps from one sphere, (L, 3) float64 unit vectors."""
        missing = [lamp for lamp in tile.lamps if lamp not in sphere.frames]
        if missing:
            raise TileError(f"tile {tile.name}: spheres: no photograph for lamp {', '.join(missing)}; add it")
        circle = _circle(tile, sphere, read)
        directions = np.empty((len(tile.lamps), 3))
        for i, lamp in enumerate(tile.lamps):
            path = sphere.frames[lamp]
            photograph, local = _crop(read(path), circle)
            try:
                spot = highlight_centre(to_grey(photograph), local, self.highlight)
            except ValueError as fault:
                raise TileError(
                    f"{path}: no highlight on the chrome sphere of lamp {lamp}: {fault}; expose the sphere "
                    "so that only the lamp's reflection saturates, or set 'highlight'"
                ) from fault
            directions[i] = mirror_direction(spot, local)
            if directions[i, 2] <= 0:
                raise TileError(
                    f"{path}: the highlight of lamp {lamp} is so close to the sphere's outline that the lamp "
                    "would be behind the artwork; check circle_px and stray reflections"
                )
        return directions


def _circle(tile: Tile, sphere: Sphere, read: Read) -> Array:
    """Circle of the sphere: as stated, from clicked points, from a mask, or found; (3,) px."""
    if sphere.circle_px is not None:
        return np.array(sphere.circle_px, float)
    if sphere.points_px is not None:
        if len(sphere.points_px) < 3:
            raise TileError(
                f"tile {tile.name}: spheres.points_px: a circle needs 3 points, got {len(sphere.points_px)}"
            )
        return fit_circle(np.array(sphere.points_px, float))
    if sphere.mask is not None:
        try:
            return circle_of_mask(to_grey(read(sphere.mask)))
        except ValueError as fault:
            raise TileError(
                f"{sphere.mask}: no sphere in the mask: {fault}; paint the sphere white"
            ) from fault
    seen = [sphere.outline] if sphere.outline else [sphere.frames[lamp] for lamp in tile.lamps]
    first = seen[0]
    # A thousand pixels place the outline to a thousandth of the sphere's size.
    factor = max(1, round(max(read(first).shape[:2]) / 1000))
    greys = [to_grey(read(path, reduce=factor)) for path in seen]
    circle, support = find_circle(np.stack(greys))
    if support < LEAST_SUPPORT:
        raise TileError(
            f"{first}: no circle found: only {100 * support:.0f} % of the best one's outline is seen "
            f"({100 * LEAST_SUPPORT:.0f} % needed); give the sphere's outline, circle_px, points_px or mask"
        )
    # The centre of a block of pixels lies half a block, less half a pixel, after its first one.
    return np.asarray(circle * factor + np.array([0.5, 0.5, 0]) * (factor - 1))


def _crop(photograph: Array, circle: Array) -> tuple[Array, Array]:
    """The square around a circle, and the circle in its coordinates."""
    left, top = np.maximum(np.floor(circle[:2] - circle[2]).astype(int), 0)
    right, bottom = np.maximum(np.ceil(circle[:2] + circle[2]).astype(int) + 1, 0)
    return photograph[top:bottom, left:right], circle - np.array([left, top, 0])
