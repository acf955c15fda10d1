"""Positions of the lamps: what their uncertainty does to the values that all pixels share, and to the height.

A flat holds the light of each lamp wherever it stands, so a position that is wrong by a millimetre hardly bends the
height by itself.  But where lamps are believed to have changed, it is partly taken for a change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nlights_core.calibration.linearisation import linearise
from nlights_core.calibration.sampling import Pixels, Samples, develop_pixels
from nlights_core.calibration.unknowns import Shared, prior
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.near_light.overview import ReducedRoom
from nlights_core.photographs.flat_fields import FlatField

SHIFT = 1.0
"""Shift of a lamp over which derivatives are taken, mm."""


def bends_by_positions(
    room: ReducedRoom,
    pixels: Pixels,
    lights: LightField,
    flat_field: FlatField,
    z: Array,
    scaled: Array,
    shared: Shared,
    free: tuple[int, ...],
) -> Array:
    """Bends of the height by a millimetre of each coordinate of each lamp, (3 L, h, w) on coarse blocks, mm.

    Parameters
    ----------
    room : ReducedRoom
    pixels : Pixels
        Those that have a say.
    lights, flat_field : LightField, FlatField
        Near lamps, and the flat as it is believed to be.
    z : (N,) array
        Heights, mm.
    scaled : (N, 3) float64 array
        Scaled normals.
    shared : Shared
        What was found.
    free : tuple of int
        Places of the unknowns that were fitted, which answer to a wrong position as well.
    """
    here = develop_pixels(room, pixels, lights, flat_field, z)
    count = len(here.images)
    more = np.zeros((len(scaled), count, count, 3))
    for axis in range(3):
        moved = replace(lights, positions=lights.positions + SHIFT * np.eye(3)[axis])
        change = _change(here, develop_pixels(room, pixels, moved, flat_field, z), scaled) / SHIFT
        for lamp in range(count):
            more[:, lamp, lamp, axis] = change[lamp]
    equations = linearise(
        room, pixels, lights, flat_field, z, scaled, shared, more.reshape(len(scaled), count, -1)
    )
    known = len(shared.vector())
    places = np.array(free, np.intp)
    precisions, _ = prior(shared)
    inner = equations.matrix[np.ix_(places, places)] + np.diag(precisions[places])
    answer = np.linalg.solve(inner, equations.matrix[places, known:])
    return np.asarray(np.tensordot(answer.T, equations.bends[places], 1) - equations.bends[known:])


def _change(here: Samples, there: Samples, scaled: Array) -> Array:
    """Change of what is predicted less what is observed, (L, N), of a matt surface; 0 where it is not known."""
    before, after = (np.einsum("lnk,nk->ln", one.lights, scaled) for one in (here, there))
    with np.errstate(divide="ignore", invalid="ignore"):
        change = after - before * np.where(here.images != 0, there.images / here.images, 1)
    return np.asarray(np.nan_to_num(change))
