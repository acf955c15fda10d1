"""Gloss: light that is brighter than the other lamps predict, as a glossy edge that faces one lamp is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter

from nlights_core.frames import Array
from nlights_core.machine.band_threads import in_order
from nlights_core.movement.details import Detail, Surroundings
from nlights_core.movement.fine_structure import SMOOTH, filled
from nlights_core.reduced_light.places import unexplained
from nlights_core.reduced_light.relative_light import FEWEST

BLOCK = 64
"""Edge of the blocks over which a lamp's direction is taken to be the same, samples."""

BRIGHTER = 0.08
"""How much brighter than predicted is gloss, as a share of the mean light of a block.  A wrong movement of 1 px
leaves as much at many edges, so this is for movements that are nearly known."""

GLOSSY = 3
"""Lamps at most that are glossy at one place."""

ROUNDS = 4
"""In which the light of several glossy lamps at one place settles."""


def without_gloss(detail: Detail, around: Surroundings) -> Detail:
    """Put what the other lamps predict where a lamp's light is much brighter.

    Parameters
    ----------
    detail : Detail
        Whose photographs lie on each other.
    around : Surroundings

    Returns
    -------
    Detail
        A little smoother, so that noise is not taken for gloss.
    """
    light, known = filled(detail.images)
    found = np.asarray(uniform_filter(light, (1, SMOOTH, SMOOTH)), np.float32)
    _, height, width = found.shape
    corners = np.meshgrid(range(0, height, BLOCK), range(0, width, BLOCK), indexing="ij")
    tops, lefts = (one.ravel() for one in corners)
    half = BLOCK * detail.scale / 2
    rows, columns = detail.top + tops * detail.scale + half, detail.left + lefts * detail.scale + half
    vectors = around.vectors(rows, columns)
    lit = [around.lit(y - half, y + half, x - half, x + half) for y, x in zip(rows, columns, strict=True)]
    free = unexplained(vectors, np.stack(lit, axis=1).astype(np.float32)).astype(np.float32)

    def clean(k: int) -> None:
        some = np.flatnonzero(lit[k])
        if len(some) >= FEWEST:
            block = found[:, tops[k] : tops[k] + BLOCK, lefts[k] : lefts[k] + BLOCK]
            block[some] = _clean(block[some], free[k][np.ix_(some, some)])

    list(in_order(clean, range(len(tops))))
    return replace(detail, images=found if known is None else np.where(known, found, np.float32(np.nan)))


def _clean(block: Array, free: Array) -> Array:
    """A block of the light of lamps that all light it, by what three numbers a place leave of them (L, L)."""
    light = block.reshape(len(block), -1)
    apart_by = free / np.maximum(np.diag(free), np.float32(0.02))[:, None]
    apart = apart_by @ light
    least = BRIGHTER * float(light.mean())
    glossy = np.zeros(light.shape, bool)
    places = np.arange(light.shape[1])
    # Three lamps must be left that determine the place, and one that confirms it.
    for _ in range(min(GLOSSY, len(light) - 4)):
        above = np.where(glossy, -np.inf, apart)
        most = np.argmax(above, axis=0)
        new = above[most, places] > least
        if not new.any():
            break
        glossy[most[new], places[new]] = True
        for _ in range(ROUNDS):
            light = np.where(glossy, light - apart_by @ light, light)
        apart = apart_by @ light
    return np.asarray(light.reshape(block.shape))
