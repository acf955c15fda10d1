"""Contracts of the kinds that know the light: light models and detrends of the images."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from nlights_core.algorithms import ImageDetrend, LightModel
from nlights_core.capture import Sphere, Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.testing.algorithms import AlgorithmContract, expect


class LightModelContract(AlgorithmContract):
    """The lamps of a tile that a stand, a chrome sphere and photographs of a card describe.

    A model that needs something else overrides `tile` (and `read`).

    Attributes
    ----------
    algorithm : LightModel
        What is tested.
    tolerance_deg : float
        Greatest error of a lamp's direction from the field's centre.
    """

    algorithm: ClassVar[LightModel]
    kind = LightModel
    tolerance_deg: ClassVar[float] = 1.0
    circle_px: ClassVar[tuple[float, float, float]] = (80.25, 79.5, 60.0)

    def tile(self) -> Tile:
        """A tile on the synthetic stand; its frames are not in the order of the stand's lamps."""
        stand = synthetic_stand()
        order = tuple(reversed(stand.lamps))
        spheres = Sphere(
            frames={lamp: Path(f"/sphere/{lamp}.tif") for lamp in order}, circle_px=self.circle_px
        )
        frames = {lamp: Path(f"/frame/{lamp}.tif") for lamp in order}
        return Tile(artwork="contract", name="r0c0", stand=stand, frames=frames, spheres=(spheres,))

    def true_directions(self) -> Array:
        """Unit vectors from the field's centre to the lamps, (8, 3), in the order of the frames."""
        positions = synthetic_stand().lamp_positions(self.tile().lamps)
        return np.asarray(positions / np.linalg.norm(positions, axis=1, keepdims=True))

    def read(self, path: Path, *, reduce: int = 1, linear: bool = True) -> Array:
        """Photographs without files: a chrome sphere's highlight, or an evenly grey card."""
        lamps = self.tile().lamps
        index = lamps.index(path.stem)
        if path.parent.name == "sphere":
            image = self.highlight(self.true_directions()[index])
        else:
            grid = PixelGrid(150, 200, 2.5)
            field = LightField((path.stem,), positions=synthetic_stand().lamp_positions((path.stem,)))
            image = 0.1 * field.vectors(grid.points(0, grid.rows))[0, ..., 2]
        rows, columns = (n // reduce for n in image.shape)
        blocks = image[: rows * reduce, : columns * reduce].reshape(rows, reduce, columns, reduce)
        return np.repeat(blocks.mean(axis=(1, 3))[..., None], 3, axis=2).astype(np.float32)

    def highlight(self, direction: Array) -> Array:
        """A chrome sphere seen from far away, (160, 160): its normal halves light and view."""
        column, row, radius = self.circle_px
        half = direction + np.array([0.0, 0.0, 1.0])
        half /= np.linalg.norm(half)
        rows, columns = np.mgrid[:160, :160]
        beside = np.hypot(columns - column - radius * half[0], rows - row + radius * half[1])
        on_sphere = np.hypot(columns - column, rows - row) < radius
        return np.asarray(0.02 * on_sphere + 0.97 * np.exp(-((beside / 2.0) ** 2)))

    def test_lamps_are_found_in_the_order_of_the_frames(self) -> None:
        """Find them in the plane frame, whatever axes the stand was measured in."""
        tile = self.tile()
        found = self.algorithm.locate(tile, self.read)
        expect(found.lamps == tile.lamps, f"lamps must be in the order of the frames, not {found.lamps}")
        places = found.positions if found.positions is not None else found.directions
        assert places is not None
        error = float(angles_between(places, self.true_directions()).max())
        expect(error <= self.tolerance_deg, f"a lamp's direction is wrong by {error:.3g} degrees")

    def test_calibration_is_float64_and_directions_are_unit_vectors(self) -> None:
        """Pixels are float32, calibration is float64."""
        found = self.algorithm.locate(self.tile(), self.read)
        for what in ("positions", "directions", "axes", "exponents", "power", "ambient"):
            array = getattr(found, what)
            expect(array is None or array.dtype == np.float64, f"{what} must be float64")
        for what, units in (("directions", found.directions), ("axes", found.axes)):
            unit = units is None or np.abs(np.linalg.norm(units, axis=1) - 1).max() < 1e-9
            expect(unit, f"{what} must be unit vectors")
        expect((found.power > 0).all(), "powers must be positive")

    def test_the_record_of_the_lamps_reads_back_and_repeats(self) -> None:
        """The light field is stored as JSON; equal keys mean equal results."""
        first, second = (self.algorithm.locate(self.tile(), self.read).record() for _ in range(2))
        expect(first == second, "two runs differ")
        expect(LightField.from_record(first).record() == first, "the record does not read back")

    def test_a_tile_that_lacks_what_the_model_needs_is_refused(self) -> None:
        """Raise `TileError`, so that the other tiles go on."""
        bare = self.tile().model_copy(update={"stand": None, "spheres": (), "lights": None})
        try:
            self.algorithm.locate(bare, self.read)
        except TileError as fault:
            expect(len(str(fault)) > 0, "the fault must say what is missing")
        else:
            expect(False, "lamps were invented for a tile that does not describe them")


class ImageDetrendContract(AlgorithmContract):
    """Contract of readings of a flat under eight near lamps without lenses.

    Attributes
    ----------
    algorithm : ImageDetrend
        What is tested.
    tolerance : float
        Greatest relative error of the flat field, after one common factor is removed.
    """

    algorithm: ClassVar[ImageDetrend]
    kind = ImageDetrend
    tolerance: ClassVar[float] = 0.02
    grid: ClassVar[PixelGrid] = PixelGrid(45, 60, 500 / 60, camera=(0.0, 0.0, 1540.0))

    def lamps(self) -> LightField:
        """Eight lamps of the synthetic stand, of equal power."""
        stand = synthetic_stand()
        return LightField(tuple(stand.lamps), positions=stand.lamp_positions())

    def true_flat_field(self) -> Array:
        """(8, 45, 60, 3) float32: the irradiance of the plane, in three equal channels."""
        irradiance = self.lamps().vectors(self.grid.points(0, self.grid.rows))[..., 2:]
        return np.repeat(irradiance, 3, axis=-1)

    def flat_field(self, flats: Array) -> Array:
        """Flat field that the algorithm returns."""
        given = flats if "flats" in self.algorithm.needs else None
        return self.algorithm.flat_field(given, self.lamps(), self.grid.x(), self.grid.y())

    def check_flat_field(self, flat_field: Array, where: Array) -> None:
        """The flat field is the true one but for a factor that all lamps share."""
        ratio = (flat_field / self.true_flat_field())[where]
        error = float(np.abs(ratio / np.median(ratio) - 1).max())
        expect(error <= self.tolerance, f"the flat field is wrong by {100 * error:.3g} %")

    def test_the_flat_field_is_that_of_the_lamps_but_for_a_common_factor(self) -> None:
        """Powers of the lamps relative to each other decide the normals."""
        flats = self.true_flat_field()
        self.check_flat_field(self.flat_field(flats), np.ones(flats.shape, bool))

    def test_the_flat_field_is_positive_float32(self) -> None:
        """The images are divided by it."""
        flats = self.true_flat_field()
        flat_field = self.flat_field(flats)
        expect(flat_field.dtype == np.float32, f"the flat field must be float32, not {flat_field.dtype}")
        shapes = (flats.shape, (*flats.shape[:3], 1))
        expect(
            flat_field.shape in shapes,
            f"the flat field must have one of the shapes {shapes}, not {flat_field.shape}",
        )
        expect((flat_field > 0).all(), "the flat field must be positive")

    def test_saturated_places_of_a_flat_do_not_spread(self) -> None:
        """Bridge the flat field there, at most five times less exactly, or give NaN; elsewhere it is right."""
        flats = self.true_flat_field()
        flats[2, 20:22, 30:32] = np.nan
        flat_field = np.broadcast_to(self.flat_field(flats), flats.shape)
        known = np.isfinite(flats)
        expect(np.isfinite(flat_field[known]).all(), "NaN spread to where the flat is known")
        self.check_flat_field(flat_field, known)
        bridged = (flat_field / self.true_flat_field())[~known] / np.median(
            (flat_field / self.true_flat_field())[known]
        )
        error = float(np.abs(bridged[np.isfinite(bridged)] - 1).max(initial=0))
        expect(error <= 5 * self.tolerance, f"the flat field was bridged wrongly, by {100 * error:.3g} %")

    def test_flats_are_not_overwritten_and_the_flat_field_repeats(self) -> None:
        """Flats serve every tile; equal keys mean equal results."""
        flats = self.true_flat_field()
        before = flats.copy()
        first = self.flat_field(flats)
        expect(np.array_equal(flats, before), "the flats were overwritten")
        expect(np.array_equal(first, self.flat_field(before)), "two runs differ")
