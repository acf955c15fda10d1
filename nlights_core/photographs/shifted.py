"""Photographs that moved against the others, brought back while they are read."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polygrid2d

from nlights_core.capture import Encoding
from nlights_core.frames import Array
from nlights_core.photographs.images import Photograph, is_saturated
from nlights_core.photographs.tone_curves import BELOW_ONE

REACH = 8
"""Samples to each side that a value between samples is made of: a cubic spline's weights are below 1e-4 there."""

SPOILT = 3
"""Samples to each side of a place, of which none may be saturated: beyond, a weight is below 0.03."""


class Shift(NamedTuple):
    """Shift of a photograph against the others.

    Attributes
    ----------
    right, down : float
        How far the picture moved, px.
    light : tuple of tuples of float
        Logarithm of the lamp's light over the field, as coefficients of a polynomial in row and column from -1 to 1:
        where the artwork moved, the light did not.  Empty: the camera moved, and the light with the picture.
    """

    right: float
    down: float
    light: tuple[tuple[float, ...], ...] = ()


FILE = "shifts.json"
"""Where the shifts of a tile's photographs stand."""


def shifts_by_lamp(folder: Path) -> dict[str, Shift]:
    """Read the shifts to take out, which an alignment wrote."""
    record = json.loads((folder / FILE).read_text(encoding="utf-8"))
    return {
        lamp: Shift(right, down, tuple(tuple(row) for row in light))
        for lamp, (right, down, light) in record["shifts"].items()
    }


def noise_left(shifts: Iterable[Shift]) -> float:
    """Standard deviation of noise in photographs brought back, as a share of what it was, rms over the photographs.

    A value between samples is a mean of several: half a pixel aside each way, 0.57 of the variance is left.
    """
    left = [
        float(np.prod([np.sum(_weights(_parted(move)[1]) ** 2) for move in shift[:2]])) for shift in shifts
    ]
    return float(np.sqrt(np.mean(left)))


class ShiftedPhotograph(Photograph):
    """A photograph whose picture is brought back, and the sensor's own pattern left where it is.

    Parameters
    ----------
    path, encoding, scratch
        As for `Photograph`.
    dark : Photograph or None
        It belongs to the sensor, so it is taken off before and put on again.
    shift : Shift

    Notes
    -----
    Values between samples are a cubic spline's, which blurs least. A place that rests on a saturated sample is
    saturated, and so is one that was not in the photograph: no solver uses it.
    """

    def __init__(
        self,
        path: Path,
        encoding: Encoding,
        scratch: Path | None,
        dark: Photograph | None,
        shift: Shift,
    ) -> None:
        super().__init__(path, encoding, scratch)
        self._dark, self._shift = dark, shift

    @property
    def plain(self) -> bool:
        """Light is not the file's number: False."""
        return False

    def band(self, start: int, stop: int) -> Array:
        """Light in a band of rows, as `Photograph.band` gives it; the same whatever the bands are."""
        from scipy.ndimage import correlate1d, maximum_filter1d

        info = self.info
        (right, across), (down, along) = (_parted(value) for value in self._shift[:2])
        first, last = start + down - REACH, stop + down + REACH
        inside = np.clip([first, last], 0, info.rows)
        if inside[1] <= inside[0]:
            inside = np.array([0, 1]) if last <= 0 else np.array([info.rows - 1, info.rows])
        light = super().band(*inside.tolist())
        spoilt = is_saturated(light) if np.isfinite(info.saturation) else np.zeros(light.shape[:2], bool)
        if self._dark is not None:
            light -= self._dark.band(*inside.tolist())
        rows = np.clip(np.arange(first, last), *(inside - [0, 1])) - inside[0]
        columns = np.clip(np.arange(right - REACH, info.columns + right + REACH), 0, info.columns - 1)
        kept = (slice(REACH, -REACH), slice(REACH, -REACH))
        wide = np.ascontiguousarray(light[rows][:, columns])
        wide = correlate1d(wide, _weights(along), axis=0)[REACH:-REACH]
        found = correlate1d(wide, _weights(across), axis=1)[:, REACH:-REACH]
        if self._shift.light:
            found *= self._brighter(np.arange(start, stop))[..., None]
        if self._dark is not None:
            found += self._dark.band(start, stop)
        if np.isfinite(info.saturation):
            near = spoilt[rows][:, columns].astype(np.uint8)
            for axis in (0, 1):
                near = maximum_filter1d(near, 2 * SPOILT + 1, axis=axis)
            unknown = near[kept] > 0
            unknown |= _outside(np.arange(start, stop) + down + along, info.rows)[:, None]
            unknown |= _outside(np.arange(info.columns) + right + across, info.columns)
            np.minimum(found, BELOW_ONE, out=found)
            found[unknown] = 1
        return np.asarray(found)

    def _brighter(self, rows: Array) -> Array:
        """Light at some rows over that at which the artwork was photographed, (h, w) float32."""
        shape, light = (self.info.rows, self.info.columns), np.array(self._shift.light)
        columns = np.arange(shape[1])
        here = light_at(light, rows, columns, shape)
        there = light_at(light, rows + self._shift.down, columns + self._shift.right, shape)
        return np.asarray(np.exp(here - there), np.float32)


def light_at(light: Array, rows: Array, columns: Array, shape: tuple[int, int]) -> Array:
    """Logarithm of a lamp's light at rows and columns of photographs of a shape, (h, w); see `Shift`."""
    y, x = ((2 * place + 1) / size - 1 for place, size in zip((rows, columns), shape, strict=True))
    return np.asarray(polygrid2d(y, x, light))


def _parted(move: float) -> tuple[int, float]:
    """Whole pixels of a movement, and what is left: -0.5 to 0.5."""
    whole = round(move)
    return whole, float(move - whole)


def _weights(fraction: float) -> Array:
    """Weights of a cubic spline's value ``fraction`` of a sample after the middle one, (2 `REACH` + 1,)."""
    from scipy.ndimage import shift

    if not fraction:
        return np.asarray(np.eye(2 * REACH + 1)[REACH])
    impulse = np.zeros(8 * REACH + 1)
    impulse[4 * REACH] = 1
    # What an impulse gives at all places is, read backwards, what all samples give at one.
    weights = shift(impulse, -fraction, order=3)[::-1][3 * REACH : 5 * REACH + 1]
    return np.asarray(weights / weights.sum())


def _outside(places: Array, count: int) -> Array:
    """Test which places between samples lie outside a line of samples."""
    return np.asarray((places < -0.01) | (places > count - 0.99), bool)
