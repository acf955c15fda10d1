"""Detrends of images: the flat field, photographed or computed."""

from typing import ClassVar

import numpy as np
from pydantic import Field

from nlights_core.algorithms import ImageDetrend
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array


class PhotographedFlats(ImageDetrend):
    """The photographed flats, smoothed.

    Power, emission and fall-off of every lamp, and the lens's vignetting, are in the
    photograph; no model of them is needed.  Source: the paper, section 2.2 C; numerics,
    section 1 (lights relative to the flat field).
    """

    name: ClassVar[str] = "flat-field"
    needs: ClassVar[tuple[str, ...]] = ("flats",)

    smoothing: float = Field(
        default=0.01,
        gt=0,
        le=0.1,
        description="standard deviation of the smoothing, as a share of the frame's width: the "
        "flat's own texture and noise are finer, the light's fall-off is not",
    )

    def flat_field(self, flats: Array | None, lights: LightField, x: Array, y: Array) -> Array:
        assert flats is not None  # the stage sees to it, by `needs`
        blur = self.smoothing * len(x)
        out = np.empty_like(flats)
        for i in range(len(flats)):
            for c in range(flats.shape[-1]):
                out[i, ..., c] = smoothed(flats[i, ..., c], blur)
        return out


def smoothed(reading: Array, blur: float) -> Array:
    """Smooth a positive reading without flattening its curvature or bending its border.

    The logarithm is blurred by a Gaussian and what the blur took away is blurred once more and
    added back (so that cubic trends survive); past the border it is continued by point
    reflection.  Unknown samples are bridged first and stay bridged.

    Parameters
    ----------
    reading : (h, w) array
        NaN, zero and negative values are not known.
    blur : float
        Standard deviation, in samples.

    Returns
    -------
    (h, w) float32 array
        NaN everywhere when less than half is known.

    Examples
    --------
    >>> ramp = np.exp(np.linspace(0, 1, 40) * np.ones((30, 1)))
    >>> bool(np.allclose(smoothed(ramp, 2.0), ramp, rtol=1e-5))
    True
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    known = np.isfinite(reading) & (reading > 0)
    if known.mean() < 0.5:
        return np.full(reading.shape, np.nan, np.float32)
    values = np.log(np.where(known, reading, 1.0).astype(np.float64))
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    reach = [min(int(np.ceil(4 * blur)), size - 1) for size in values.shape]
    pads = [(r, r) for r in reach]
    inside = tuple(slice(r, r + size) for r, size in zip(reach, values.shape, strict=True))

    def blurred(values: Array) -> Array:
        wide = np.pad(values, pads, mode="reflect", reflect_type="odd")
        return np.asarray(gaussian_filter(wide, blur, mode="nearest")[inside])

    once = blurred(values)
    return np.asarray(np.exp(once + blurred(values - once)), np.float32)


class InverseSquare(ImageDetrend):
    """The flat field computed from the lamps' positions: inverse square law and cosine.

    For captures without flats.  The emission of the lamps is part of it where the
    light model states it; their power is 1 unless it was calibrated on the artwork (see
    `nlights_core.lamps.emission_on_artwork`).
    """

    name: ClassVar[str] = "inverse-square"

    def flat_field(self, flats: Array | None, lights: LightField, x: Array, y: Array) -> Array:
        if not lights.near:
            raise TileError(
                "detrend.images: inverse-square needs lamps at known positions, but the light model gives "
                "distant ones; use measured-poi without distant, or leave detrend.images out"
            )
        points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
        return np.ascontiguousarray(lights.vectors(points)[..., 2:])
