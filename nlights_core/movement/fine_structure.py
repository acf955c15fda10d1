"""Fine structure: what the details of several photographs have in common, as sums of products over tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import shift, uniform_filter

from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.movement.details import Detail, Surroundings
from nlights_core.reduced_light.places import unexplained
from nlights_core.reduced_light.relative_light import FEWEST

SMOOTH, WIDE = 3, 9
"""Fine structure is a mean over 3 x 3 samples less the mean over 9 x 9: noise below it is averaged, and light
that the model of the lamps does not explain is broader."""

BRIGHTEST = np.float32(1.5)
"""Light above this, relative to the mean of the lamps, is cut off: it is a highlight, which moves by itself."""

EDGE, LEAST_EDGE = 32, 8
"""Edge of a tile, px, and at least so many samples: over it a lamp's direction hardly changes, and where shadows
are cast, small tiles between them are left."""

TINY = 1e-30
"""What keeps a share of nothing from dividing by zero."""

NEAR = 20
"""How far from every shadow that is seen a tile is clear of the steep step that casts it, px."""

EVEN = np.float32(0.1)
"""Least typical disagreement of a tile, as a share of that of all: below, weights would be those of noise."""

UNKNOWN = 0.3
"""A lamp of whose tile more than this share is not known is left out there."""


@dataclass(frozen=True)
class FineStructure:
    """Sums of products over T tiles of the fine structure of L photographs and its two gradients.

    Attributes
    ----------
    products : (T, 3L, 3L) float64 array
        Relative to the local light, without what three numbers a place explain: ``x . products . x``
        is what the photographs leave unexplained after a combination x of them, of their gradients
        to the right and of those downwards.
    grams : (T, 3L, 3L) float64 array
        The same sums as they are: products of the fine structure and the gradients with each other.
    freedom : (T, L, L) float64 array
        What takes off the explained part; 0 for lamps that a tile leaves out.
    places : (T, 2) float array
        Row and column of each tile's middle, px.
    sizes : (T,) float array
        Samples of each tile.
    clear : (T,) bool array
        Whether no shadow is seen on the tile, nor within ``NEAR`` of it.
    """

    products: Array
    grams: Array
    freedom: Array
    places: Array
    sizes: Array
    clear: Array

    @property
    def lamps(self) -> int:
        """Number L of photographs."""
        return int(self.freedom.shape[1])

    @cached_property
    def quarters(self) -> Array:
        """Quarter that each tile belongs to, (T,): 0 to 3, of about as many tiles each."""
        lower = self.places[:, 0] > np.median(self.places[:, 0])
        right = np.zeros(len(lower), bool)
        for half in (lower, ~lower):
            if half.any():
                right[half] = self.places[half, 1] > np.median(self.places[half, 1])
        return np.asarray(2 * lower + right)

    def part(self, some: Array) -> FineStructure:
        """Some of the tiles, by a mask (T,)."""
        return FineStructure(*(getattr(self, one.name)[some] for one in fields(self)))

    def share(self) -> float:
        """Unexplained share of the fine structure, over all tiles."""
        return float(self.left().sum()) / max(float(self._whole().sum()), TINY)

    def shares(self) -> Array:
        """The same of every tile, (T,)."""
        return np.asarray(self.left() / np.maximum(self._whole(), TINY))

    def _whole(self) -> Array:
        """Fine structure that unrelated photographs would leave, (T,)."""
        return np.asarray(np.einsum("tii,tii->t", self.grams[:, : self.lamps, : self.lamps], self.freedom))

    def left(self) -> Array:
        """Rest that is left unexplained in every tile, (T,)."""
        return np.asarray(self.products[:, : self.lamps, : self.lamps].sum(axis=(1, 2)))


def fine_structure(
    details: Sequence[Detail], around: Surroundings, moves: Array, robust: bool = False
) -> FineStructure:
    """Sum the products of details of one size.

    Parameters
    ----------
    details : sequence of Detail
    around : Surroundings
    moves : (L, 2) array
        Movement right and down that is taken back before, px.
    robust : bool
        Whether samples that the photographs disagree about much, as they do about highlights, have little say.

    Returns
    -------
    FineStructure
    """
    parts = [_of_detail(detail, around, moves, robust) for detail in details]
    return join(parts)


def join(parts: Sequence[FineStructure]) -> FineStructure:
    """The tiles of several fine structures of the same photographs."""
    return FineStructure(
        *(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(FineStructure))
    )


def _of_detail(detail: Detail, around: Surroundings, moves: Array, robust: bool) -> FineStructure:
    count, height, width = detail.images.shape
    pixels = moves / detail.scale
    margin = int(np.ceil(np.abs(pixels).max()))
    border = margin + WIDE // 2 + 2
    images, known = filled(detail.images)
    level = uniform_filter(images.mean(axis=0), WIDE)
    level = np.maximum(level, 1e-2 * float(np.abs(level).mean()) + 1e-9)
    stack = np.empty((3, count, height, width), np.float32)

    def prepare(i: int) -> None:
        image = images[i]
        if pixels[i].any():
            image = shift(image, -pixels[i, ::-1], order=3, mode="nearest")
        smooth = np.minimum(uniform_filter(image, SMOOTH) / level, BRIGHTEST)
        smooth -= uniform_filter(smooth, WIDE)
        stack[0, i] = smooth
        np.subtract(smooth[:, 2:], smooth[:, :-2], out=stack[1, i, :, 1:-1])
        np.subtract(smooth[2:], smooth[:-2], out=stack[2, i, 1:-1])

    list(in_order(prepare, range(count)))
    rows, columns = height - 2 * border, width - 2 * border
    if min(rows, columns) < 4:
        empty = np.zeros((0, 3 * count, 3 * count))
        none = empty[:, :count, :count]
        return FineStructure(empty, empty, none, np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool))
    edge = max(EDGE // detail.scale, LEAST_EDGE)
    edge = edge if min(rows, columns) >= 3 * edge else max(4, min(rows, columns) // 3)
    down, across = rows // edge, columns // edge
    high, wide = rows // down, columns // across

    def cut(maps: Array) -> Array:
        inner = maps[..., border : border + down * high, border : border + across * wide]
        blocks = inner.reshape(*maps.shape[:-2], down, high, across, wide)
        return np.moveaxis(blocks, (-4, -2), (0, 1)).reshape(down * across, *maps.shape[:-2], high * wide)

    included = np.ones((down * across, count), bool)
    tiles = cut(stack)
    if known is not None:
        reach = WIDE + SMOOTH + 2 * margin
        missing: Array = np.stack([uniform_filter((~one).astype(np.float32), reach) for one in known])
        unsure: Array = cut(missing) > 1e-5
        included &= unsure.mean(axis=-1) < UNKNOWN
        usable: Array = ~np.any(unsure & included[:, :, None], axis=1)
        tiles = tiles * usable[:, None, None, :]
    middle_y = detail.top + (border + (np.arange(down) + 0.5) * high) * detail.scale
    middle_x = detail.left + (border + (np.arange(across) + 0.5) * wide) * detail.scale
    y, x = (places.ravel() for places in np.meshgrid(middle_y, middle_x, indexing="ij"))
    half_y, half_x = high * detail.scale / 2, wide * detail.scale / 2
    lit = [around.lit(b - half_y, b + half_y, a - half_x, a + half_x) for b, a in zip(y, x, strict=True)]
    included &= np.stack(lit)
    wide_y, wide_x = half_y + NEAR, half_x + NEAR
    near = [around.lit(b - wide_y, b + wide_y, a - wide_x, a + wide_x) for b, a in zip(y, x, strict=True)]
    clear = np.all(near, axis=1)
    some = np.flatnonzero((included.sum(axis=1) >= FEWEST) & tiles.any(axis=(1, 2, 3)))
    flat = tiles[some].reshape(len(some), 3 * count, high * wide)
    vectors = around.vectors(y[some], x[some])
    freedom = unexplained(vectors.astype(float), included[some].T.astype(float))
    if robust and len(some):
        flat *= _trust(flat[:, :count], freedom)[:, None]
    grams = (flat @ flat.swapaxes(1, 2)).astype(float)
    grams[:, count:] *= 0.5  # central differences are over two samples
    grams[:, :, count:] *= 0.5
    places = np.stack([y[some], x[some]], axis=1)
    sizes = np.full(len(tiles), float(high * wide)) if known is None else usable.sum(axis=1).astype(float)
    products = grams * np.tile(freedom, (1, 3, 3))
    return FineStructure(products, grams, freedom, places, sizes[some], clear[some])


def _trust(tiles: Array, freedom: Array) -> Array:
    """Square roots of the weights of the samples (T, N) of tiles (T, L, N), by what the lamps leave unexplained."""
    squares = ((freedom.astype(np.float32) @ tiles) ** 2).sum(axis=1)
    typical = np.median(squares, axis=1, keepdims=True)
    # A tile in which nearly all is explained has no highlights.
    typical = np.maximum(typical, EVEN * float(np.median(squares)) + np.float32(TINY))
    return np.asarray(1 / np.sqrt(1 + squares / typical))


def brought_back(detail: Detail, moves: Array) -> Detail:
    """A detail whose photographs' movements, px, are taken back."""
    images, known = filled(detail.images)
    found = images.copy()
    for i in np.flatnonzero(moves.any(axis=1)):
        found[i] = shift(images[i], -moves[i, ::-1] / detail.scale, order=3, mode="nearest")
    if known is not None:
        reach = 2 * int(np.ceil(np.abs(moves / detail.scale).max())) + 1
        missing: Array = uniform_filter((~known).astype(np.float32), (1, reach, reach))
        found[missing > 1e-5] = np.nan
    return replace(detail, images=found)


def filled(images: Array) -> tuple[Array, Array | None]:
    """Images in which the mean of the other lamps stands where one is not known, and what is known, if not all."""
    known = np.isfinite(images)
    if known.all():
        return images, None
    there = np.where(known, images, np.float32(0))
    mean = there.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, images, mean), known
