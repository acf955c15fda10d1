"""Development: photographs of a tile become bands of linear, dark-free images relative to the flat field."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.capture import Sensor, Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.kernel_switch import available
from nlights_core.memory import band_memory
from nlights_core.photographs.exposures import Exposure
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.images import ImageInfo, Photograph, grey, is_saturated
from nlights_core.photographs.masks import Mask
from nlights_core.photographs.noise import Noise, measure_noise
from nlights_core.photographs.relation import grey_shares, relate, relate_compiled
from nlights_core.photographs.shifted import Shift, ShiftedPhotograph

BAND_BYTES = 64 << 20
"""About what the images and lights of one band may take, where there is memory for it."""

SOLVING = 4
"""As many times as that a solver is expected to take."""

VIEW_COLUMNS = 300
"""About how wide the small views of the photographs are, px."""


Result = TypeVar("Result")


class Rows(Protocol):
    """Protocol of a map that gives its rows for a slice, as an array does."""

    def __getitem__(self, rows: slice, /) -> Array:
        """Some rows."""


class Raw(NamedTuple):
    """A band of rows as it was read.

    Attributes
    ----------
    start, stop : int
        The rows.
    images : (L, h, w, C) float32
        Linear, dark subtracted, divided by the lamps' power.
    saturated : (L, h, w) bool
        Where any channel is at the saturation level.
    inside : (h, w) bool
        The mask.
    """

    start: int
    stop: int
    images: Array
    saturated: Array
    inside: Array


@dataclass
class Band:
    """A band of rows, ready for a normal solver.

    Attributes
    ----------
    start, stop : int
        The rows.
    images : (L, h, w, C) float32
        Linear, dark subtracted, divided by power and flat field.
    weights : (L, h, w) float32
        As `nlights_core.algorithms.NormalSolver.solve` wants them; 0 where saturated or outside the
        mask.
    saturated : (L, h, w) bool
        Where any channel is at the saturation level.
    lights : (L, h, w, 3) or (L, 1, 1, 3) float32
        Such that ``grey images = albedo * (lights . normal + ambient)``.
    ambient : (L, h, w) float32 or None
        Ambient light in the same units.
    grey : (L, h, w) float32
        The images without colour: mixed by the flat field's shares where there is one, which is
        where noise is least, otherwise as the eye does.
    """

    start: int
    stop: int
    images: Array
    weights: Array
    saturated: Array
    lights: Array
    ambient: Array | None
    grey: Array


@dataclass
class Darkroom:
    """The open photographs of a tile: frames or flats, the dark frame and the mask.

    Use `darkroom` to open one.  ``averaged``: of how many exposures each photograph is the mean.  ``veil`` is light
    that frames have and the dark frame lacks, as a share of saturation: it is subtracted.
    """

    grid: PixelGrid
    info: ImageInfo
    photographs: Mapping[str, Photograph]
    paths: Mapping[str, Path]
    dark: Photograph | None
    mask: Mask | None
    subject: str
    sensor: Sensor | None
    averaged: int = 1
    veil: float = 0.0
    exposures: dict[str, Exposure] = field(default_factory=dict)
    _views: list[Array] = field(default_factory=list)

    @cached_property
    def noise(self) -> Noise:
        """The camera's noise: as the capture states it, or measured in these photographs.

        Set it to what the flats said where there are any: they show noise without texture.
        """
        channels = self.info.channels
        if self.sensor is not None:
            return Noise.of_sensor(self.sensor, channels, self.dark is not None)
        smooth = self.subject == "flats"
        found = None
        for mask in (self.mask, None):  # a narrow mask may hold no whole block
            found = found or measure_noise(
                self.photographs.values(), self.dark, smooth=smooth, mask=mask, averaged=self.averaged
            )
        return found or Noise(np.ones(channels), np.zeros(channels))

    def raw(self, start: int, stop: int, lights: LightField) -> Raw:
        """Read a band of every photograph."""
        shape = (stop - start, self.grid.columns)
        inside = np.ones(shape, bool)
        if self.mask is not None:
            inside = self.mask.band(start, stop)
        dark = self.dark.band(start, stop) if self.dark is not None else None
        if dark is not None:
            self.exposures.setdefault("dark", Exposure()).add(grey(dark).ravel(), is_saturated(dark).ravel())
        count = len(self.photographs)
        images = np.empty((count, *shape, self.info.channels), np.float32)
        saturated = np.empty((count, *shape), bool)
        limited = bool(np.isfinite(self.info.saturation))
        for i, (lamp, photograph) in enumerate(self.photographs.items()):
            images[i] = photograph.band(start, stop)
            saturated[i] = limited & is_saturated(images[i])
            if dark is not None:
                images[i] -= dark
            exposure = self.exposures.setdefault(lamp, Exposure())
            exposure.add(grey(images[i])[inside], saturated[i][inside])
        step = self.view_step
        self.add_view(images[:, -start % step :: step, ::step].copy())
        if self.veil:
            images -= np.float32(self.veil)
        images /= lights.power.astype(np.float32)[:, None, None, :]
        return Raw(start, stop, images, saturated, inside)

    @property
    def view_step(self) -> int:
        """Step in rows and columns of the photographs from one pixel of the views to the next."""
        return max(1, self.grid.columns // VIEW_COLUMNS)

    def add_view(self, images: Array) -> None:
        """Take in what the views show of a band, (L, h, w, C) float32: linear, dark subtracted."""
        self._views.append(images)

    def views(self) -> Array:
        """Small views of the photographs read so far, (L, h, w, C) float32: for people to look at."""
        return np.concatenate(self._views, axis=1)

    def bands(
        self,
        work: Callable[[Band], Result],
        lights: LightField,
        flat_field: FlatField | None,
        height: Rows | None = None,
    ) -> Iterator[tuple[Band, Result]]:
        """Develop all bands and work on them, on all cores; then check the exposures.

        Parameters
        ----------
        work : callable
            What is done with a band, in any thread.
        lights : LightField
            The lamps.
        flat_field : FlatField, optional
            What a flat reads; the images are divided by it along each lamp's ray.
        height : (H, W) array, optional
            Height of the pass before, mm; None: the plane.

        Yields
        ------
        Band, object
            From top to bottom, and what ``work`` returned.

        Raises
        ------
        TileError
            When a photograph is black or saturated throughout, or cannot be read.
        """

        def worked(raw: Raw) -> tuple[Band, Result]:
            before = None if height is None else height[raw.start : raw.stop]
            band = self.develop(raw, lights, flat_field, before)
            return band, work(band)

        places = bands_of_grid(self.grid, len(self.photographs) * (self.info.channels * 4 + 24))
        # Read one after the other: a photograph serves one thread at a time, and views are kept in order.
        yield from in_order(worked, (self.raw(*place, lights) for place in places))
        self.check()

    def develop(
        self, raw: Raw, lights: LightField, flat_field: FlatField | None, height: Array | None = None
    ) -> Band:
        """Make a band ready for a solver; ``raw`` may be developed again at another height.

        Parameters
        ----------
        raw : Raw
            What `raw` read.
        lights, flat_field : LightField, FlatField or None
            See `bands_of_grid`.
        height : (h, w) array, optional
            Height of these rows, mm.
        """
        points = self.grid.points(raw.start, raw.stop, height)
        # The lens dims by the pixel, not by where the lamp's ray meets the plane.
        pixels = None if height is None else self.grid.points(raw.start, raw.stop)[:2]
        return self.develop_points(raw, lights, flat_field, points, pixels)

    def develop_points(
        self, raw: Raw, lights: LightField, flat_field: FlatField | None, points: Array, pixels: Array | None
    ) -> Band:
        """Do as `develop` does, for pixels whose points of the surface are given.

        Parameters
        ----------
        raw : Raw
            Their readings.
        lights, flat_field : LightField, FlatField or None
            See `bands_of_grid`.
        points : (3, h, w) array
            Of the surface, mm.
        pixels : (2, h, w) array, optional
            Where the rays of the pixels meet the plane, mm; None: in those points.
        """
        weights = np.where(raw.saturated | ~raw.inside, np.float32(0), np.float32(1))
        images, ambient, shares = raw.images, None, None
        if lights.ambient.any():
            ambient = np.broadcast_to(
                lights.ambient.astype(np.float32)[:, None, None], images.shape[:3]
            ).copy()
        if flat_field is None:
            vectors = lights.vectors(points)
            mix = grey_shares(images.shape[-1], None)
            # Without a flat field it is not known where each lamp is bright: all weigh the same.
            weights /= self.noise.photons(lights.power.astype(np.float32), mix).mean()
        else:
            images = images.copy()
            shares = flat_field.shares if images.shape[-1] == len(flat_field.shares) else None
            mix = grey_shares(images.shape[-1], flat_field)
            if lights.near and ambient is None and available():
                photons = mix**2 * self.noise.gain / lights.power
                vectors = relate_compiled(images, weights, lights, flat_field, points, pixels, photons)
            else:
                vectors, ambient = relate(
                    images, weights, ambient, lights, flat_field, points, pixels, self.noise, mix
                )
        mixed = grey(images, shares)
        self.noise.with_readout(weights, mixed, mix)
        weights /= np.float32(PHOTONS)
        saturated = raw.saturated & raw.inside
        return Band(raw.start, raw.stop, images, weights, saturated, vectors, ambient, mixed)

    def check(self) -> None:
        """Refuse a photograph that turned out black or saturated throughout."""
        for fault in self.faults():
            raise fault

    def faults(self) -> Iterator[TileError]:
        """Faults of the exposures of what was read so far, one by one; none where all is well."""
        beyond = self._beyond_range()
        if beyond is not None:
            yield beyond  # what is measured against a wrong range says nothing more
            return
        dark = self.exposures.pop("dark", None)
        if dark is not None and self.dark is not None and dark.saturated > 0.5 * dark.pixels:
            yield TileError(
                f"{self.dark.path}: dark: {dark.saturated / dark.pixels:.1%} of its pixels are saturated; "
                "photograph it again with the lens covered"
            )
        for lamp, exposure in self.exposures.items():
            try:
                exposure.check(f"{self.subject}.{lamp}", self.paths[lamp])
            except TileError as fault:
                yield fault

    def _beyond_range(self) -> TileError | None:
        """Fault of numbers that mean something else than the capture says: nobody need photograph again.

        No photograph is brighter than saturation on average.
        """
        for name, exposure in self.exposures.items():
            photograph = self.dark if name == "dark" else self.photographs[name]
            mean = exposure.total / max(exposure.pixels, 1)
            if photograph is None or mean <= 1 or not np.isfinite(self.info.saturation):
                continue
            level = self.info.saturation
            said = "the level that encoding.saturation states"
            if photograph.encoding.saturation is None:
                said = f"what a file of {self.info.dtype} numbers holds at saturation unless the capture says more"
            return TileError(
                f"{photograph.path}: {name if name == 'dark' else f'{self.subject}.{name}'}: its numbers are "
                f"{mean * level:.6g} on average, above {level:g}, {said}; state the number at which the sensor "
                "saturates in encoding.saturation (65535 for the range of 16 bits), or none if nothing is saturated"
            )
        return None


@contextmanager
def darkroom(
    tile: Tile,
    scratch: Path,
    *,
    flats: bool = False,
    shifts: Mapping[str, Shift] | None = None,
) -> Iterator[Darkroom]:
    """Open the photographs of a tile (or of its flats) together.

    ``shifts`` are taken out while frames are read: by lamp.  Flats and dark frame belong to the
    sensor and stay.

    Raises
    ------
    TileError
        When they are missing, unreadable or do not fit together.
    """
    info = survey(tile)
    paths = tile.flats if flats else tile.frames
    if paths is None:
        raise TileError(f"{tile.artwork}/{tile.name}: flats: are missing; add them to artwork.yaml")
    with ExitStack() as stack:

        def opened(path: Path) -> Photograph:
            return stack.enter_context(Photograph(path, tile.encoding, scratch))

        def framed(lamp: str, path: Path) -> Photograph:
            shift = (shifts or {}).get(lamp)
            if shift is None or not any(shift[:2]):
                return opened(path)
            # One photograph serves one thread, so each has its own dark frame.
            own = opened(tile.dark) if tile.dark else None
            return stack.enter_context(ShiftedPhotograph(path, tile.encoding, scratch, own, shift))

        mask = Mask(tile.mask) if tile.mask and not flats else None
        if mask is not None:
            mask.require_some()
        yield Darkroom(
            grid=grid_of(tile, info),
            info=info,
            photographs={lamp: framed(lamp, path) for lamp, path in paths.items()},
            paths=paths,
            dark=opened(tile.dark) if tile.dark else None,
            mask=mask,
            subject="flats" if flats else "frames",
            sensor=tile.sensor,
            averaged=(tile.flats_averaged or 1) if flats else 1,
        )


def bands_of_grid(grid: PixelGrid, bytes_per_pixel: int) -> Iterator[tuple[int, int]]:
    """Cut a grid into bands of rows, as (start, stop), of `BAND_BYTES` or what the memory allows."""
    size = min(BAND_BYTES, band_memory() // SOLVING)
    rows = max(1, min(grid.rows, size // max(1, bytes_per_pixel * grid.columns)))
    for start in range(0, grid.rows, rows):
        yield start, min(start + rows, grid.rows)
