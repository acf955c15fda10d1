"""The normal stage in one go: the photographs' numbers become the stage's images strip by strip.

What `nlights_core.solving.band_solving` does with bands of arrays, with the same results.  Every core reads a strip
of rows and works on it, and one thread hands the finished ones out in order.  How many strips there are at
a time, and how large they are, bounds the memory.  A solver that has a kernel sees blocks of pixels in the
processor's cache; any other sees plain arrays of the strip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np

from nlights_core.algorithms import NormalSolver
from nlights_core.contracts import verbs
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.machine.band_threads import cores, in_order
from nlights_core.memory import band_memory
from nlights_core.photographs.blocks import BLOCK, SAMPLE, USABLE, VALUE, X, Y, Z
from nlights_core.photographs.compiled_development import COUNTED, SCRATCH, cells, develop
from nlights_core.photographs.development import Band, Darkroom, Rows
from nlights_core.photographs.exposures import Exposure
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.photographs.images import EYE
from nlights_core.photographs.relation import grey_shares
from nlights_core.photographs.strips import Blocks, Optics, Strip
from nlights_core.solving.agreement import AgreementMeter
from nlights_core.solving.compiled_delivery import deliver, strip_solver, take_solution
from nlights_core.solving.compiled_solutions import FOUND
from nlights_core.solving.correction import Correction
from nlights_core.solving.kernels import Images, rule_of, scratch
from nlights_core.solving.least_squares import UsableLights
from nlights_core.solving.rules import Rule

STRIP = 1 << 19
"""Pixels of a strip, about: what is kept of it stays in the processor's outer cache."""

SOLVING = 4
"""As many times as its samples and colours a solver of plain arrays is expected to take."""

PLAIN_STRIP = 1 << 16
"""Pixels of a strip whose samples a solver sees as plain arrays: it makes many more of them."""


@dataclass(frozen=True)
class FusedSolver:
    """Solver of a tile in strips.

    Parameters
    ----------
    room : Darkroom
        The open photographs.
    solver : NormalSolver
        Does its work by a kernel, if it has one.
    lights : LightField
        Without ambient light.
    flat_field : FlatField
        What a flat reads.
    height : (H, W) array or None
        Height of the pass before, mm.
    shadow : float
        Share of the brightest sample below which one is counted as shadow.
    white : float
        Albedo of the flat.
    correction : Correction, optional
        Takes out of the samples what is not of a matt surface.  With it a solver sees plain arrays, also one that
        has a kernel.
    """

    room: Darkroom
    solver: NormalSolver
    lights: LightField
    flat_field: FlatField
    height: Rows | None
    shadow: float
    white: float
    correction: Correction | None = None

    def strips(self, meter: AgreementMeter) -> Iterator[tuple[int, int, Images]]:
        """Solve all strips from top to bottom, then check the exposures.

        Parameters
        ----------
        meter : AgreementMeter
            Is shown some pixels at the end.

        Yields
        ------
        start, stop : int
            The rows.
        images : Images
            Good until the next strip is asked for.

        Raises
        ------
        TileError
            When a photograph is black or saturated throughout, or cannot be read.
        """
        seen: list[Strip] = []
        step, view_step = meter.step, self.room.view_step
        reading = Lock()

        def work(place: tuple[int, int, Array, Images]) -> tuple[int, Images, int, Array, Strip, Strip]:
            start, stop, numbers, images = place
            # A photograph serves one thread at a time; meanwhile the other cores solve.
            with reading:
                strip = self._strip(start, stop, numbers)
            sample = _thinned(strip, -start % step, step // 2, step)
            view = _thinned(strip, -start % view_step, 0, view_step)
            return start, images, *self._solved(strip, images), sample, view

        for start, images, pixels, totals, sample, view in in_order(work, self._places()):
            self._account(pixels, totals)
            seen.append(sample)
            self._view(view)
            yield start, start + len(images.normals), images
        self.room.check()
        meter.look(self._developed(_joined(seen))[1])

    def _account(self, pixels: int, totals: Array) -> None:
        """Take a strip's sums over its pixels inside the mask into the account of the exposures."""
        names = [*self.room.photographs, "dark"][: self._count]
        for name, (grey, saturated) in zip(
            names, totals.reshape(-1, 2, BLOCK).sum(axis=-1, dtype=np.float64), strict=True
        ):
            exposure = self.room.exposures.setdefault(name, Exposure())
            exposure.pixels += pixels
            exposure.saturated += int(saturated)
            exposure.total += float(grey)

    @cached_property
    def _rule(self) -> Rule | None:
        return None if self.correction else rule_of(self.solver)

    @cached_property
    def _count(self) -> int:
        """Photographs, the dark frame included."""
        return len(self.room.photographs) + (self.room.dark is not None)

    @cached_property
    def _plain(self) -> bool:
        """Test whether the files' own numbers can be taken."""
        dark = self.room.dark
        return all(p.plain for p in (*self.room.photographs.values(), *([dark] if dark else [])))

    def _images(self, rows: int) -> Images:
        shape, channels = (rows, self.room.grid.columns), self.room.info.channels
        normals = np.empty((*shape, 3), np.float32)
        albedo, reflection = np.empty((2, *shape, channels), np.float32)
        confidence, residual = np.empty((2, *shape), np.float32)
        used, saturated, shadow = np.empty((3, *shape), np.uint8)
        return Images(normals, albedo, reflection, confidence, residual, used, saturated, shadow)

    def _places(self) -> Iterator[tuple[int, int, Array, Images]]:
        """Rows of strips, with room for their numbers and images; it is used again when they are done."""
        grid, info = self.room.grid, self.room.info
        # `in_order` has one strip a core under way when it asks for another.
        spare = cores() + 1
        kind = info.dtype if self._plain else np.dtype(np.float32)
        rows = max(1, min(grid.rows, self._pixels(kind) // grid.columns))
        numbers = np.empty((spare, self._count, rows, info.columns * info.channels), kind)
        images = [self._images(rows) for _ in range(spare)]
        for turn, start in enumerate(range(0, grid.rows, rows)):
            stop = min(start + rows, grid.rows)
            yield (
                start,
                stop,
                numbers[turn % spare],
                Images(*(i[: stop - start] for i in images[turn % spare])),
            )

    def _pixels(self, kind: np.dtype[Any]) -> int:
        """Pixels of a strip, of which there is one a core and one more at a time."""
        channels, lamps = self.room.info.channels, len(self.lights.lamps)
        size = self._count * channels * kind.itemsize + 4 * (7 + 2 * channels)
        if self._rule:
            return min(STRIP, band_memory() // size)
        # In blocks six numbers a sample and three colours; as arrays, and in the solver's hands, several times that.
        return min(PLAIN_STRIP, band_memory() // (size + SOLVING * lamps * 4 * 9))

    def _strip(self, start: int, stop: int, numbers: Array) -> Strip:
        """Read rows of all photographs into a buffer."""
        room = self.room
        photographs = [*room.photographs.values(), *([room.dark] if room.dark else [])]
        for buffer, photograph in zip(numbers, photographs, strict=True):
            out = buffer[: stop - start].reshape(stop - start, -1, room.info.channels)
            if self._plain:
                photograph.numbers(start, stop, out)
            else:
                out[:] = photograph.band(start, stop)
        inside, height = np.empty((0, 0), np.uint8), np.empty((0, 0), np.float32)
        if room.mask is not None:
            inside = room.mask.band(start, stop).view(np.uint8)
        if self.height is not None:
            # What is read-only would be another type to the kernel, and compiled once more.
            height = np.require(self.height[start:stop], np.float32, ["C", "W"])
        x, y = room.grid.x().astype(np.float32), room.grid.y(start, stop).astype(np.float32)
        return Strip(numbers, inside, height, x, y)

    def _view(self, strip: Strip) -> None:
        shape = (self._count, len(strip.y), len(strip.x), self.room.info.channels)
        light = strip.numbers.reshape(shape) * self.optics.scale[0]
        lamps = len(self.room.photographs)
        self.room.add_view(light[:lamps] - light[lamps:] if self._count > lamps else light)

    def _solved(self, strip: Strip, images: Images) -> tuple[int, Array]:
        """Solve a strip: how many pixels are inside the mask, and totals of the photographs."""
        white = np.float32(self.white)
        if self._rule:
            assert isinstance(self.solver, UsableLights)
            work = scratch(len(self.lights.lamps), self._rule)
            blocks = self._blocks(work.samples)
            limits = np.float32(self.shadow), np.float32(self.solver.shadow)
            solve_strip = strip_solver(self._rule.kernel)
            solve_strip(strip, self.optics, *limits, self._rule.limits, white, blocks, work, images)
        else:
            blocks, band, removed = self._developed(strip)
            found = np.empty((len(blocks.samples), FOUND), np.float32)
            solution = verbs.solve(self.solver, band.grey, band.lights, band.weights)
            normals, albedo, uncertainty, used = (np.require(p, np.float32, ["C", "W"]) for p in solution)
            take_solution(blocks.samples, normals, albedo, uncertainty, used, found)
            deliver(blocks, found, 0, white, images)
            if removed is not None:
                # The apparent colour is that of the photographs, with all that shines.
                images.reflection[:] += white * removed[..., : images.reflection.shape[-1]]
        pixels = np.count_nonzero(strip.inside) if strip.inside.size else images.residual.size
        return int(pixels), blocks.totals[: self._count]

    def _developed(self, strip: Strip) -> tuple[Blocks, Band, Array | None]:
        """A strip in blocks, corrected; as a solver sees it; and what was taken out of the apparent colour."""
        rows, columns = len(strip.y), len(strip.x)
        lamps = len(self.lights.lamps)
        count = rows * -(-columns // BLOCK)
        blocks = self._blocks(np.empty((count, lamps, SAMPLE), np.float32))
        develop(strip, self.optics, 0, np.float32(self.shadow), np.float32(0), blocks)
        removed = self.correction.of_strip(strip, self.optics, blocks) if self.correction else None

        def plane(offset: int) -> Array:
            planes = blocks.samples[..., offset : offset + BLOCK].reshape(rows, -1, lamps, BLOCK)
            return np.moveaxis(planes, 2, 0).reshape(lamps, rows, -1)[..., :columns]

        grey, weights = plane(VALUE), plane(USABLE)
        rays = np.stack([plane(k) for k in (X, Y, Z)], axis=-1)
        saturated = np.zeros(grey.shape, bool)
        return blocks, Band(0, rows, grey[..., None], weights, saturated, rays, None, grey), removed

    def _blocks(self, samples: Array) -> Blocks:
        size, lamps, _ = samples.shape
        return Blocks(
            samples,
            np.empty((size, lamps, 3 * BLOCK), np.float32),
            np.empty((size, COUNTED), np.float32),
            np.zeros((lamps + 1, 2 * BLOCK), np.float32),
            np.zeros(SCRATCH, np.float32),
        )

    def _scale(self) -> tuple[float, float, float]:
        """Light per number, the number at which the sensor saturates, and the largest light there is."""
        if self._plain:
            return next(iter(self.room.photographs.values())).scale
        return 1.0, 1.0 if np.isfinite(self.room.info.saturation) else np.inf, np.inf

    @cached_property
    def optics(self) -> Optics:
        """Constants of all pixels."""
        room, lights, flat_field = self.room, self.lights, self.flat_field
        channels = room.info.channels
        mix = grey_shares(channels, flat_field)
        eye = EYE if channels > 1 else np.ones(1)
        power = np.broadcast_to(lights.power, (len(lights.lamps), channels))
        lamps = np.zeros((len(power), 4, 3))
        for lamp, p in zip(lamps, power, strict=True):
            lamp[:, :channels] = 1 / p, mix, mix**2 * room.noise.gain / p, eye
        places = lights.positions
        if places is None:
            assert lights.directions is not None
            places = lights.directions / lights.directions[:, 2:]
        lens = (0.0, 0.0, 0.0, 0.0)
        if flat_field.camera is not None:
            x, y, z = flat_field.camera
            lens = (x, y, z**-2, 4 * flat_field.vignetting / np.log(2))
        constant = room.noise.readout.mean() / (room.noise.gain.mean() ** 2 * np.sum(mix**2))

        def single(values: Any) -> Array:
            return np.ascontiguousarray(values, np.float32)

        return Optics(
            scale=single(self._scale()),
            lamps=single(lamps),
            positions=single(places),
            near=single([lights.near]),
            camera=single(room.grid.camera or (0.0, 0.0, np.inf)),
            flat_field=_cells(flat_field.logarithm),
            flat_field_shape=flat_field.logarithm.shape[1:3],
            place=single([flat_field.left, flat_field.top, flat_field.step]),
            lens=single(lens),
            limits=single([1e6 / flat_field.brightest, constant]),
        )


def _cells(logarithm: Array) -> Array:
    """Cells of `Optics.flat_field`, of a flat field's natural logarithm (L, H, W, C)."""
    lamps, rows, columns, channels = logarithm.shape
    value = (logarithm * (-1 / np.log(2))).astype(np.float32)
    found = np.zeros((lamps, rows * columns, 12), np.float32)
    cells(value.reshape(lamps, rows * columns, channels), columns, found)
    return found


def _thinned(strip: Strip, row: int, column: int, step: int) -> Strip:
    """Every so many pixels of a strip, copied."""
    count, columns = len(strip.numbers), len(strip.x)
    channels = strip.numbers.shape[2] // columns
    here = (slice(row, len(strip.y), step), slice(column, None, step))
    numbers = strip.numbers.reshape(count, -1, columns, channels)[:, *here]
    return Strip(
        numbers.reshape(count, numbers.shape[1], numbers.shape[2] * channels).copy(),
        strip.inside[here].copy(),
        strip.height[here].copy(),
        strip.x[here[1]].copy(),
        strip.y[here[0]].copy(),
    )


def _joined(strips: list[Strip]) -> Strip:
    """Strips below each other as one."""
    numbers, inside, height, x, y = zip(*strips, strict=True)
    return Strip(
        np.concatenate(numbers, axis=1),
        np.concatenate(inside),
        np.concatenate(height),
        x[0],
        np.concatenate(y),
    )
