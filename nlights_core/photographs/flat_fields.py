"""Flat fields: what a flat at z = 0 reads under each lamp, as a smooth function."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.files.arrays import write_array
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order

COLUMNS = 256
"""About how many blocks across a flat field is known on: it is smooth."""

MARGIN = 0.15
"""How far past the frame a flat field is continued, as a share of its longer side: a lamp at 15
degrees reaches 40 mm past the frame for a surface 8 mm high."""

UNKNOWN_LENS = 0.5
"""Vignetting before the flats are looked at, and its standard deviation: a lens darkens the corners by
the natural law (1), unless the raw developer has undone it (0)."""


@dataclass(frozen=True)
class FlatField:
    """A flat field on a coarse grid that reaches past the frame.

    Parameters
    ----------
    logarithm : (L, h, w, C) float32 array
        Natural logarithm of the reading.
    left, top : float
        x and y of the first sample, mm.
    step : float
        Distance of samples, mm.
    camera : tuple of 3 floats, optional
        Centre of projection, mm.  None: the readings have no vignetting.
    vignetting : float
        How much vignetting the readings have, see `vignetting`.
    """

    logarithm: Array
    left: float
    top: float
    step: float
    camera: tuple[float, float, float] | None = None
    vignetting: float = 0.0

    @cached_property
    def brightest(self) -> float:
        """The largest reading of any lamp."""
        return float(np.exp(np.max(self.logarithm)))

    @cached_property
    def shares(self) -> Array:
        """Share of each colour channel in the flat's light, (C,) float32.

        Images divided by the flat field are best mixed to grey by these shares: with shot noise that is
        what counting the photons of all channels together would give, whatever the colour.
        """
        light = np.exp(self.logarithm).mean(axis=(0, 1, 2))
        return np.asarray(light / light.sum(), np.float32)

    def inside(self, grid: PixelGrid) -> Array:
        """Readings in the frame only, (L, h, w, C) float32: for people to look at."""
        x = self.left + self.step * np.arange(self.logarithm.shape[2])
        y = self.top - self.step * np.arange(self.logarithm.shape[1])
        columns = np.abs(x) < grid.columns * grid.pixel_size / 2
        rows = np.abs(y) < grid.rows * grid.pixel_size / 2
        return np.asarray(np.exp(self.logarithm[:, rows][:, :, columns]))

    def at(self, lamp: int, x: Array, y: Array, pixels: Array | None = None) -> Array:
        """Read the flat field at any points, by linear interpolation.

        A lamp's light belongs to the point of the plane that it meets, but the lens's vignetting
        belongs to the pixel through which that light is seen.

        Parameters
        ----------
        lamp : int
            Index of the lamp.
        x, y : (h, w) float32 arrays
            Points of the plane, mm.
        pixels : (2, h, w) array, optional
            x and y where the rays of the pixels meet the plane, mm; None: they are the points.

        Returns
        -------
        (h, w, C) float32 array
            Past the margin, the reading at its edge.
        """
        from scipy.ndimage import map_coordinates

        places = np.stack([(self.top - y) / self.step, (x - self.left) / self.step])
        channels = self.logarithm.shape[-1]
        out = np.empty((*x.shape, channels), np.float32)
        for c in range(channels):
            map_coordinates(self.logarithm[lamp, ..., c], places, out[..., c], order=1, mode="nearest")
        if pixels is not None and self.camera is not None:
            seen, met = (natural_vignetting(self.camera, *place) for place in (pixels, (x, y)))
            out += (np.float32(self.vignetting) * (seen - met))[..., None]
        return np.exp(out, out=out)


def block_size(grid: PixelGrid) -> int:
    """Edge of the blocks that a flat field of this grid is averaged over, px."""
    return max(1, min(round(max(grid.rows, grid.columns) / COLUMNS), min(grid.shape) // 4))


def natural_vignetting(camera: tuple[float, float, float], x: Array, y: Array) -> Array:
    """Logarithm of the fourth power of the cosine between the camera's axis and a ray.

    Parameters
    ----------
    camera : tuple of 3 floats
        Centre of projection, mm; it looks along -z.
    x, y : arrays of one shape
        Where the ray meets the plane, mm.

    Returns
    -------
    array of that shape and precision
    """
    squared = (x - camera[0]) ** 2 + (y - camera[1]) ** 2
    return np.asarray(-2 * np.log1p(squared / camera[2] ** 2))


def vignetting(
    reading: Array, lights: LightField, x: Array, y: Array, camera: tuple[float, float, float]
) -> float:
    """Darkening of a photographed flat by the lens, as a multiple of the natural law's logarithm.

    What all lamps' readings have in common is not yet the lens's: eight lenses aimed at the
    centre darken the corners too.  But a lamp's beam is round across its axis and so longer on the
    plane than wide, and a lens's vignetting is round on the plane.

    Parameters
    ----------
    reading : (L, h, w, C) array
        What the flat reads; NaN where not known.
    lights : LightField
        Near lamps.
    x, y : (w,) and (h,) arrays
        Centres of the samples, mm.
    camera : tuple of 3 floats
        Centre of projection, mm.

    Returns
    -------
    float
        1: the natural law, the fourth power of the cosine; 0: none.

    Notes
    -----
    Of each lamp's logarithm the inverse square law and the cosine are taken off, which its position
    tells.  What remains is fitted by the lamp's strength, the exponent of its beam, a small error
    of its aim in two directions, and vignetting, which is the same for all lamps.  How far
    single lamps disagree about it says how well it is known; `UNKNOWN_LENS` is weighed in
    accordingly.
    """
    assert lights.positions is not None
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))])
    natural = natural_vignetting(camera, points[0], points[1])
    size, share = np.zeros((2, len(reading)))
    for i, position in enumerate(lights.positions):
        seen = reading[i].mean(axis=-1, dtype=np.float64)
        known = np.isfinite(seen) & (seen > 0)
        ray = (position[:, None, None] - points)[:, known]
        distance = np.linalg.norm(ray, axis=0)
        # The beam's own axis is taken through the centre of the field.
        along = np.einsum("k,kn->n", position, ray) / np.linalg.norm(position)
        beam = np.stack([np.ones_like(along), np.log(along / distance), ray[0] / along, ray[1] / along])
        rest = np.log(seen[known]) - np.log(ray[2] / distance**3)
        along_beam = np.linalg.solve(_products(beam), np.einsum("kn,n->k", beam, natural[known]))
        lens = natural[known] - np.einsum("k,kn->n", along_beam, beam)
        size[i], share[i] = np.sum(lens * lens), np.sum(lens * rest)
    found = share.sum() / size.sum()
    count = len(size)
    scatter = np.sum((share - size * found) ** 2) / size.sum() ** 2 * count / max(count - 1, 1)
    trust = UNKNOWN_LENS**2 / (UNKNOWN_LENS**2 + scatter) if count > 1 else 0.0
    return float(trust * found + (1 - trust) * UNKNOWN_LENS)


def extend_beyond_frame(reading: Array, x: Array, y: Array, step: float) -> FlatField:
    """Make a flat field from readings in the frame, continued past it.

    Outside, the logarithm follows a cubic polynomial fitted to the whole frame plus what the
    polynomial misses at the nearest sample of the frame, so that it is continuous.

    Parameters
    ----------
    reading : (L, h, w, C) array
        Positive; NaN where not known (filled the same way, from the nearest known sample).
    x, y : (w,) and (h,) arrays
        Centres of the samples, mm.
    step : float
        Their distance, mm.

    Raises
    ------
    TileError
        When a lamp's reading is known on less than half of the frame.
    """
    from scipy.ndimage import distance_transform_edt

    margin = int(np.ceil(MARGIN * max(reading.shape[1:3])))
    wide_x = x[0] + step * np.arange(-margin, len(x) + margin)
    wide_y = y[0] - step * np.arange(-margin, len(y) + margin)
    count, _, _, channels = reading.shape
    out = np.empty((count, len(wide_y), len(wide_x), channels), np.float32)
    inner = _cubic(x / (step * len(x)), y / (step * len(x)))
    wide = _cubic(wide_x / (step * len(x)), wide_y / (step * len(x)))
    whole = _products(inner)

    def of_lamp(i: int) -> None:
        for c in range(channels):
            known = np.isfinite(reading[i, ..., c]) & (reading[i, ..., c] > 0)
            if known.mean() < 0.5:
                raise TileError(
                    f"flats: the reading of lamp {i + 1} is known on {known.mean():.0%} of the frame only "
                    "(the rest is saturated or black); photograph the flat again"
                )
            values = np.log(np.where(known, reading[i, ..., c], 1.0).astype(np.float64))
            some = inner if known.all() else inner[:, known.ravel()]
            normal = whole if some is inner else _products(some)
            fit = np.linalg.solve(normal, np.einsum("kn,n->k", some, values[known]))
            missed = np.where(known, values - np.einsum("k,kn->n", fit, inner).reshape(values.shape), np.nan)
            if some is not inner:
                nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
                missed = missed[tuple(nearest)]
            out[i, ..., c] = np.einsum("k,kn->n", fit, wide).reshape(out.shape[1:3]) + np.pad(
                missed, margin, mode="edge"
            )

    list(in_order(of_lamp, range(count)))
    return FlatField(out, float(wide_x[0]), float(wide_y[0]), step)


def write_flat_field(folder: Path, flat_field: FlatField) -> None:
    """Write ``flat_field.npy`` and, where its samples are and through what lens, ``flat_field.json``."""
    write_array(folder / "flat_field.npy", flat_field.logarithm)
    names = ("left", "top", "step", "camera", "vignetting")
    place = {name: getattr(flat_field, name) for name in names}
    (folder / "flat_field.json").write_text(json.dumps(place) + "\n", encoding="utf-8")


def read_flat_field(folder: Path) -> FlatField:
    """Read what `write_flat_field` wrote."""
    place = json.loads((folder / "flat_field.json").read_text(encoding="utf-8"))
    if place["camera"] is not None:
        place["camera"] = tuple(place["camera"])
    return FlatField(np.load(folder / "flat_field.npy"), **place)


def _cubic(x: Array, y: Array) -> Array:
    """All monomials of total degree up to 3, (10, h w) float64."""
    return np.stack([np.outer(y**b, x**a).ravel() for a in range(4) for b in range(4 - a)])


def _products(terms: Array) -> Array:
    """Sums of the products of terms (K, N) with each other, (K, K)."""
    # No matrix product: it shares small work out to all cores, and waits long for busy ones.
    return np.asarray(np.einsum("kn,mn->km", terms, terms))
