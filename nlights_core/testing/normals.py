"""Contracts of the kinds that make normals: solvers and detrends of the normals."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np

from nlights_core.algorithms import PHOTONS, NormalDetrend, NormalSolver, Solution
from nlights_core.fields import LightField, NormalField
from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.simulation.surfaces import Surface, bow, height_map, normal_field, plane, wave
from nlights_core.testing.algorithms import GRID, AlgorithmContract, expect, expect_array, holed


class NormalSolverContract(AlgorithmContract):
    """Normals from images that follow Lambert's law exactly, without shadows.

    Attributes
    ----------
    algorithm : NormalSolver
        What is tested.
    tolerance_deg : float
        Greatest angle to the true normal.
    """

    algorithm: ClassVar[NormalSolver]
    kind = NormalSolver
    tolerance_deg: ClassVar[float] = 0.05
    grid: ClassVar[PixelGrid] = PixelGrid(12, 16, 10.0, camera=(0.0, 0.0, 1540.0))
    surface: ClassVar[Surface] = wave(2.0, 120.0, angle_deg=30.0) + plane(slope_y=0.05)

    def lit(self, *, distant: bool = False) -> tuple[Array, Array, Array]:
        """Images, lights and weights of eight lamps, without noise.

        Returns
        -------
        images : (8, 12, 16) float32
        lights : (8, 12, 16, 3) or, if distant, (8, 1, 1, 3) float32
        weights : (8, 12, 16) float32, all 1
        """
        positions = synthetic_stand().lamp_positions()
        names = tuple(synthetic_stand().lamps)
        field = LightField(names, positions=positions)
        if distant:
            units = positions / np.linalg.norm(positions, axis=1, keepdims=True)
            field = LightField(names, directions=units)
        heights = height_map(self.surface, self.grid).height
        lights = field.vectors(self.grid.points(0, self.grid.rows, heights))
        shading = np.einsum("lhwk,hwk->lhw", lights, self.true_normals())
        images = (self.true_albedo() * shading).astype(np.float32)
        return images, lights, np.ones_like(images)

    def true_normals(self) -> Array:
        """(12, 16, 3) float32."""
        return normal_field(self.surface, self.grid).normals

    def true_albedo(self) -> Array:
        """(12, 16) float32, from 0.2 at the left to 0.9 at the right."""
        return np.tile(np.linspace(0.2, 0.9, self.grid.columns, dtype=np.float32), (self.grid.rows, 1))

    def check_exact(self, found: Solution, where: Array | None = None) -> None:
        """Check normals and albedo against the truth, where ``where`` is true."""
        chosen = np.ones(self.grid.shape, bool) if where is None else where
        angles = angles_between(found.normals, self.true_normals())[chosen]
        expect(np.isfinite(angles).all(), "normals are unknown that follow from the images")
        expect(angles.max() <= self.tolerance_deg, f"normals wrong by {angles.max():.3g} degrees")
        ratio = found.albedo[chosen] / self.true_albedo()[chosen]
        expect(np.abs(ratio - 1).max() < 2e-3, f"albedo wrong by a factor up to {ratio.max():.3g}")

    def test_normals_and_albedo_are_exact_under_near_lamps(self) -> None:
        """Each pixel has lights of its own."""
        self.check_exact(self.algorithm.solve(*self.lit()))

    def test_distant_lights_are_broadcast_over_the_band(self) -> None:
        """Lights of shape (L, 1, 1, 3)."""
        self.check_exact(self.algorithm.solve(*self.lit(distant=True)))

    def test_the_solution_is_float32_of_the_bands_shape(self) -> None:
        """Unit normals; confidence and weights not negative."""
        images, lights, weights = self.lit()
        found = self.algorithm.solve(images, lights, weights)
        shape = self.grid.shape
        expect_array(found.normals, (*shape, 3), "normals")
        expect_array(found.albedo, shape, "albedo")
        expect_array(found.confidence, shape, "confidence")
        expect_array(found.weights, images.shape, "weights")
        length = np.linalg.norm(found.normals, axis=-1)
        expect(np.abs(length - 1).max() < 1e-5, "normals must be unit vectors")
        expect((found.confidence >= 0).all(), "the confidence is an angle, and must not be negative")
        expect((found.weights >= 0).all(), "weights must not be negative")

    def test_the_confidence_covers_68_percent_of_the_errors(self) -> None:
        """Degrees, under the photon noise that weights of 1 state."""
        images, lights, weights = (np.concatenate([array] * 10, axis=1) for array in self.lit())
        noise = np.random.default_rng(0).standard_normal(images.shape).astype(np.float32)
        noisy = images + noise * np.sqrt(np.maximum(images, 0) / PHOTONS)
        found = self.algorithm.solve(noisy, lights, weights)
        angles = angles_between(found.normals, np.concatenate([self.true_normals()] * 10))
        share = float(np.mean(angles <= found.confidence))
        expect(abs(share - 0.68) < 0.1, f"the confidence covers {share:.0%} of the errors, not 68 %")

    def test_samples_of_weight_0_are_not_used(self) -> None:
        """Let neither a saturated value nor NaN leak through a weight of 0."""
        images, lights, weights = self.lit()
        images[1, 4], weights[1, 4] = 50.0, 0.0
        images[6, 7], weights[6, 7] = np.nan, 0.0
        found = self.algorithm.solve(images, lights, weights)
        self.check_exact(found)
        expect((found.weights[1, 4] == 0).all(), "a discarded sample was given a weight")
        expect((found.weights[6, 7] == 0).all(), "a discarded sample was given a weight")

    def test_fewer_than_three_lights_give_nan_and_only_there(self) -> None:
        """Give NaN, never a guess."""
        images, lights, weights = self.lit()
        weights[2:, 5, 3] = 0
        found = self.algorithm.solve(images, lights, weights)
        expect(np.isnan(found.normals[5, 3]).all(), "a normal was guessed from two lights")
        others = np.ones(self.grid.shape, bool)
        others[5, 3] = False
        self.check_exact(found, others)

    def test_lights_in_one_plane_give_nan(self) -> None:
        """Eight lamps in a row do not determine a normal."""
        _, lights, weights = self.lit(distant=True)
        angles = np.linspace(-1, 1, 8)
        lights[:, 0, 0] = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
        images = 0.5 * np.einsum("lhwk,hwk->lhw", lights, self.true_normals())
        found = self.algorithm.solve(images.astype(np.float32), lights, weights)
        expect(np.isnan(found.normals).all(), "normals were guessed from lights in one plane")

    def test_each_pixel_stands_for_itself(self) -> None:
        """Bands may be cut anywhere."""
        images, lights, weights = self.lit()
        whole = self.algorithm.solve(images, lights, weights).normals
        part = self.algorithm.solve(images[:, 3:7], lights[:, 3:7], weights[:, 3:7]).normals
        expect(np.abs(whole[3:7] - part).max() < 1e-5, "a band's solution depends on the rows beside it")

    def test_inputs_are_not_overwritten(self) -> None:
        """Images, lights and weights are used again after the solution."""
        inputs = self.lit()
        before = [array.copy() for array in inputs]
        self.algorithm.solve(*inputs)
        for what, array, kept in zip(("images", "lights", "weights"), inputs, before, strict=True):
            expect(np.array_equal(array, kept), f"the {what} were overwritten")

    def test_twice_the_same(self) -> None:
        """The store takes equal keys for equal results."""
        first, second = (self.algorithm.solve(*self.lit()).normals for _ in range(2))
        expect(np.array_equal(first, second), "two runs differ")

    def test_several_threads_may_ask_at_once(self) -> None:
        """Every core solves a band of its own with the same object."""
        images, lights, weights = self.lit()
        darker = [images * np.float32(1 - 0.1 * k) for k in range(8)]
        alone = [self.algorithm.solve(one, lights, weights).albedo for one in darker]
        with ThreadPoolExecutor(4) as pool:
            together = pool.map(lambda one: self.algorithm.solve(one, lights, weights).albedo, darker)
            alike = [np.array_equal(*both) for both in zip(alone, together, strict=True)]
        expect(all(alike), "bands that are solved at the same time disturb each other")


class NormalDetrendContract(AlgorithmContract):
    """The systematic distortion of normals, from a reference that is flat in truth.

    Attributes
    ----------
    algorithm : NormalDetrend
        What is tested.
    tolerance_deg : float
        What may remain of a tilt of 1 degree, and on average of a distortion that changes from
        -1 to 1 degree over the field.
    """

    algorithm: ClassVar[NormalDetrend]
    kind = NormalDetrend
    tolerance_deg: ClassVar[float] = 0.1

    def reference(self, surface: Surface) -> NormalField:
        """Normals that a flat would seem to have; (48, 64, 3) float32."""
        return normal_field(surface, GRID)

    def remaining(self, surface: Surface) -> Array:
        """Angle to the true normal (0, 0, 1) once the bias is removed, degrees, (48, 64)."""
        reference = self.reference(surface)
        corrected = reference.normals - self.algorithm.bias(reference)
        return angles_between(corrected, np.array([0.0, 0.0, 1.0]))

    def test_a_reference_without_distortion_has_no_bias(self) -> None:
        """Leave alone what is right."""
        bias = self.algorithm.bias(self.reference(plane()))
        expect(np.abs(bias).max() < 1e-5, "a bias was found on a perfect reference")

    def test_a_constant_tilt_is_removed(self) -> None:
        """The sign of the bias: reference minus truth, y up."""
        left = float(self.remaining(plane(np.tan(np.radians(1)), np.tan(np.radians(-0.5)))).max())
        expect(left <= self.tolerance_deg, f"{left:.3g} degrees of a constant tilt are left")

    def test_a_smooth_distortion_is_removed(self) -> None:
        """The normals of a bow: from -1 to 1 degree across the field."""
        sag = np.tan(np.radians(1)) * 32.0 / 2
        left = float(self.remaining(bow(sag, 32.0, 48.0)).mean())
        expect(left <= self.tolerance_deg, f"{left:.3g} degrees of a smooth distortion are left on average")

    def test_the_bias_is_float32_and_finite_where_the_reference_is_not_known(self) -> None:
        """It is subtracted everywhere."""
        reference = self.reference(plane(0.02, -0.01))
        truth = reference.normals.copy()
        reference.normals[holed(GRID.shape)] = np.nan
        bias = self.algorithm.bias(reference)
        expect_array(bias, truth.shape, "bias")
        expect(np.isfinite(bias).all(), "the bias must be finite everywhere")
        left = float(angles_between(truth - bias, np.array([0.0, 0.0, 1.0])).mean())
        expect(left <= self.tolerance_deg, f"unknown pixels distort the bias: {left:.3g} degrees are left")

    def test_the_reference_is_not_overwritten_and_the_bias_repeats(self) -> None:
        """The reference serves every tile; equal keys mean equal results."""
        reference = self.reference(plane(0.02, -0.01))
        before = reference.normals.copy()
        first = self.algorithm.bias(reference)
        expect(np.array_equal(reference.normals, before), "the reference was overwritten")
        expect(np.array_equal(first, self.algorithm.bias(NormalField(before, GRID))), "two runs differ")
