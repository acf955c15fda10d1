"""The contracts, tested by mutants: each fault must be caught by the test meant for it."""

import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from pydantic import Field
from scipy.fft import dctn, idctn

from nlights_core import testing as contracts
from nlights_core.algorithms import (
    KINDS,
    HeightDetrend,
    ImageDetrend,
    Integrator,
    LightModel,
    NormalDetrend,
    NormalSolver,
    Solution,
)
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, LightField, NormalField
from nlights_core.testing import (
    HeightDetrendContract,
    ImageDetrendContract,
    IntegratorContract,
    LightModelContract,
    NormalDetrendContract,
    NormalSolverContract,
)


def failures(contract, algorithm):
    """Names of the contract's tests that an algorithm fails."""
    subject = type("Subject", (contract,), {"algorithm": algorithm})
    failed = set()
    for name in dir(contract):
        if name.startswith("test_"):
            try:
                getattr(subject(), name)()
            except AssertionError:
                failed.add(name)
    return failed


# Correct implementations, one per kind.


class Cosine(Integrator):
    name: ClassVar[str] = "reference"

    def integrate(self, normals):
        p, q = (np.nan_to_num(g.astype(float)) for g in normals.gradient())
        flux = np.diff((p[:, 1:] + p[:, :-1]) / 2, axis=1, prepend=0, append=0)
        flux += np.diff((q[1:] + q[:-1]) / 2, axis=0, prepend=0, append=0)
        rows, columns = (4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2 for n in flux.shape)
        scale = rows[:, None] + columns
        scale[0, 0] = np.inf
        height = idctn(-dctn(flux) / scale)
        height[np.isnan(normals.normals[..., 2])] = np.nan
        return HeightMap((height - np.nanmean(height)).astype(np.float32), normals.grid)


class LeastSquares(NormalSolver):
    name: ClassVar[str] = "reference"

    def solve(self, images, lights, weights):
        lights = np.broadcast_to(lights, (*images.shape, 3)).astype(float)
        known = np.where(weights > 0, images, 0)
        matrix = np.einsum("lhw,lhwi,lhwj->hwij", weights, lights, lights)
        right = np.einsum("lhw,lhwi,lhw->hwi", weights, lights, known)
        values = np.linalg.eigvalsh(matrix)
        good = (values[..., 0] > 1e-5 * values[..., 2]) & ((weights > 0).sum(axis=0) >= 3)
        matrix[~good] = np.eye(3)
        scaled = np.linalg.solve(matrix, right[..., None])[..., 0]
        albedo = np.linalg.norm(scaled, axis=-1)
        normals = scaled / albedo[..., None]
        inverse = np.linalg.inv(matrix)
        along = np.einsum("hwi,hwij,hwj->hw", normals, inverse, normals)
        component = np.sqrt((np.trace(inverse, axis1=2, axis2=3) - along) / 2)
        sigma = component * np.sqrt(known.mean(axis=0) / 40_000) / albedo
        confidence = np.where(good, np.degrees(1.51 * sigma), np.nan)
        normals[~good], albedo[~good] = np.nan, np.nan
        return Solution(
            normals.astype(np.float32),
            albedo.astype(np.float32),
            confidence.astype(np.float32),
            weights.astype(np.float32),
        )


class Parabola(HeightDetrend):
    name: ClassVar[str] = "reference"

    def trend(self, height):
        row, column = (np.linspace(-1, 1, n) for n in height.height.shape)
        v, u = np.meshgrid(row, column, indexing="ij")
        terms = np.stack([u**0, u, v, u * u, u * v, v * v], axis=-1)
        known = np.isfinite(height.height)
        best = np.linalg.lstsq(terms[known], height.height[known].astype(float), rcond=None)[0]
        return (terms @ best).astype(np.float32)


class Residual(NormalDetrend):
    name: ClassVar[str] = "reference"

    def bias(self, reference):
        bias = reference.normals - np.array([0, 0, 1], np.float32)
        unknown = np.isnan(bias).any(axis=-1)
        bias[unknown] = np.nanmean(bias, axis=(0, 1))
        return bias


class Photographed(ImageDetrend):
    name: ClassVar[str] = "reference"
    needs: ClassVar[tuple[str, ...]] = ("flats",)

    def flat_field(self, flats, lights, x, y):
        return flats.copy()


class Measured(LightModel):
    name: ClassVar[str] = "reference"

    def locate(self, tile, read):
        if tile.stand is None:
            raise TileError(f"tile {tile.name}: needs a stand")
        return LightField(tile.lamps, positions=tile.stand.lamp_positions(tile.lamps))


# Mutants: a correct implementation with one fault.


class WrongSign(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(-found.height, found.grid)


class PixelsForMillimetres(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(found.height / np.float32(found.grid.pixel_size), found.grid)


class YDown(Cosine):
    def integrate(self, normals):
        return super().integrate(
            NormalField(normals.normals * np.array([1, -1, 1], np.float32), normals.grid)
        )


class FlippedRows(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(found.height[::-1].copy(), found.grid)


class Periodic(Cosine):
    """A periodic transform loses a plane."""

    def integrate(self, normals):
        p, q = (np.nan_to_num(g.astype(float)) for g in normals.gradient())
        v, u = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n) for n in p.shape), indexing="ij")
        scale = u**2 + v**2
        scale[0, 0] = np.inf
        height = np.fft.ifft2(-1j * (u * np.fft.fft2(p) + v * np.fft.fft2(q)) / scale).real
        height[np.isnan(normals.normals[..., 2])] = np.nan
        return HeightMap((height - np.nanmean(height)).astype(np.float32), normals.grid)


class SpreadingUnknown(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(found.height + np.sum(found.height) * np.float32(0), found.grid)


class InventedHeight(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(np.nan_to_num(found.height), found.grid)


class OverwrittenNormals(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        normals.normals[...] = 0
        return found


class DoubleHeight(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(found.height.astype(float), found.grid)


class CroppedHeight(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        height = np.pad(found.height[1:-1, 1:-1], 1, mode="edge")
        return HeightMap(height[:, :-1], found.grid)


class WrongPerspective(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        factor = 1.0 if normals.grid.camera is None else 1.5
        return HeightMap(found.height * np.float32(factor), found.grid)


class LowestAtZero(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        return HeightMap(found.height - np.nanmin(found.height), found.grid)


class RestlessHeight(Cosine):
    def integrate(self, normals):
        found = super().integrate(normals)
        noise = np.random.default_rng().normal(0, 1e-6, found.height.shape)
        return HeightMap((found.height + noise).astype(np.float32), found.grid)


class ForgetfulOptions(Cosine):
    strength: float = Field(default=1.0, description="something", exclude=True)


class SilentOptions(Cosine):
    strength: float = 1.0


class ShoutedName(Cosine):
    name: ClassVar[str] = "Reference Integrator"


class BoundToAProcess(Cosine):
    def __reduce__(self):
        return (Cosine, ())


class NormalsYDown(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(normals=found.normals * np.array([1, -1, 1], np.float32))


class ScaledNormals(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(normals=found.normals * found.albedo[..., None])


class WrongAlbedo(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(albedo=found.albedo**2)


class UnusedWeights(LeastSquares):
    def solve(self, images, lights, weights):
        clean = np.nan_to_num(images)
        ones = np.ones_like(weights)
        few = (weights > 0).sum(axis=0) < 3
        ones[:, few] = weights[:, few]
        return super().solve(clean, lights, ones)._replace(weights=weights.copy())


class LeakingUnknown(LeastSquares):
    """0 times NaN is NaN."""

    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        spread = np.sum(images * weights, axis=0) * np.float32(0)
        return found._replace(normals=found.normals + spread[..., None])


class InventedWeights(LeastSquares):
    def solve(self, images, lights, weights):
        return super().solve(images, lights, weights)._replace(weights=np.ones_like(weights))


class Guess(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        normals = np.where(np.isnan(found.normals), np.array([0, 0, 1], np.float32), found.normals)
        return found._replace(normals=normals)


class OnlyNearLights(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        if lights.shape[1:3] != images.shape[1:]:
            found.normals[1:] = found.normals[:1]
        return found


class DoubleNormals(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(normals=found.normals.astype(float))


class OverwrittenImages(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        images *= weights / 2
        return found


class OverwrittenWeights(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        weights[0] = 0
        return found


class RowsLeaningOnTheirBand(LeastSquares):
    """Within the tolerance, but the seams between bands would show."""

    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        lean = np.linspace(0, 5e-4, len(found.normals), dtype=np.float32)[:, None, None]
        normals = found.normals + lean * np.array([0, 1, 0], np.float32)
        return found._replace(normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True))


class GuessFromLightsInOnePlane(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        found.normals[np.isnan(found.albedo) & ((weights > 0).sum(axis=0) >= 3)] = [0, 0, 1]
        return found


class RestlessNormals(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        noise = np.random.default_rng().normal(0, 1e-6, found.normals.shape)
        return found._replace(normals=(found.normals + noise).astype(np.float32))


class OneDeskForAll(LeastSquares):
    """What one thread puts there, another takes."""

    desk: ClassVar[dict] = {}

    def solve(self, images, lights, weights):
        self.desk["images"] = images
        time.sleep(0.01)
        return super().solve(self.desk["images"], lights, weights)


class NegativeConfidence(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(confidence=-found.confidence)


class ConfidenceInRadians(LeastSquares):
    def solve(self, images, lights, weights):
        found = super().solve(images, lights, weights)
        return found._replace(confidence=np.radians(found.confidence))


class CorrectedHeight(Parabola):
    """The corrected height in place of the trend."""

    def trend(self, height):
        return height.height - super().trend(height)


class WholeHeight(Parabola):
    """Takes the relief along."""

    def trend(self, height):
        return np.where(np.isnan(height.height), super().trend(height), height.height)


class UnknownTrend(Parabola):
    def trend(self, height):
        return super().trend(height) + height.height * np.float32(0)


class UnknownTakenForLevel(Parabola):
    def trend(self, height):
        return super().trend(HeightMap(np.nan_to_num(height.height), height.grid))


class DoubleTrend(Parabola):
    def trend(self, height):
        return super().trend(height).astype(float)


class OverwrittenHeight(Parabola):
    def trend(self, height):
        trend = super().trend(height)
        height.height[...] -= trend
        return trend


class OppositeBias(Residual):
    def bias(self, reference):
        return -super().bias(reference)


class ReferenceAsBias(Residual):
    def bias(self, reference):
        return np.nan_to_num(reference.normals)


class MeanBias(Residual):
    """A constant is not the distortion."""

    def bias(self, reference):
        bias = super().bias(reference)
        return np.broadcast_to(bias.mean(axis=(0, 1)), bias.shape).astype(np.float32)


class BiasYDown(Residual):
    def bias(self, reference):
        return super().bias(reference) * np.array([1, -1, 1], np.float32)


class UnknownBias(Residual):
    def bias(self, reference):
        return reference.normals - np.array([0, 0, 1], np.float32)


class DoubleBias(Residual):
    def bias(self, reference):
        return super().bias(reference).astype(float)


class OverwrittenReference(Residual):
    def bias(self, reference):
        bias = super().bias(reference)
        reference.normals[...] = 0
        return bias


class InvertedFlatField(Photographed):
    def flat_field(self, flats, lights, x, y):
        return 1 / flats


class FlatFieldUpsideDown(Photographed):
    def flat_field(self, flats, lights, x, y):
        return flats[:, ::-1].copy()


class EachLampNormalised(Photographed):
    """The lamps' powers relative to each other are lost."""

    def flat_field(self, flats, lights, x, y):
        return flats / np.nanmax(flats, axis=(1, 2, 3), keepdims=True)


class ZeroWhereSaturated(Photographed):
    def flat_field(self, flats, lights, x, y):
        return np.nan_to_num(flats)


class SpreadingSaturation(Photographed):
    def flat_field(self, flats, lights, x, y):
        return flats + flats.sum(axis=(1, 2), keepdims=True) * np.float32(0)


class DoubleFlatField(Photographed):
    def flat_field(self, flats, lights, x, y):
        return flats.astype(float)


class OverwrittenFlats(Photographed):
    def flat_field(self, flats, lights, x, y):
        found = flats.copy()
        flats /= 2
        return found


class SignlessFlatField(Photographed):
    def flat_field(self, flats, lights, x, y):
        return -flats


class LampsOfTheStand(Measured):
    """In the stand's order, not in the frames'."""

    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, positions=tile.stand.lamp_positions())


class MeasuredAxes(Measured):
    """Forgets to map the stand's axes to the plane frame."""

    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, positions=found.positions @ tile.stand.axes.matrix())


class LampsYDown(Measured):
    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, positions=found.positions * [1, -1, 1])


class SingleLamps(Measured):
    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, positions=found.positions.astype(np.float32))


class LongDirections(Measured):
    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, directions=found.positions)


class InventedLamps(Measured):
    def locate(self, tile, read):
        if tile.stand is None:
            return LightField(("a",), directions=np.array([[0.0, 0.0, 1.0]]))
        return super().locate(tile, read)


class RestlessLamps(Measured):
    def locate(self, tile, read):
        found = super().locate(tile, read)
        return LightField(found.lamps, positions=found.positions + np.random.default_rng().normal(0, 1e-3))


REFERENCES = {
    IntegratorContract: Cosine,
    NormalSolverContract: LeastSquares,
    HeightDetrendContract: Parabola,
    NormalDetrendContract: Residual,
    ImageDetrendContract: Photographed,
    LightModelContract: Measured,
}

# Each mutant with the test that is there to catch it.
CAUGHT = {
    WrongSign: "a_tilted_plane_is_recovered_in_mm_with_y_up",
    PixelsForMillimetres: "smooth_hills_are_recovered_in_mm",
    YDown: "a_tilted_plane_is_recovered_in_mm_with_y_up",
    FlippedRows: "smooth_hills_are_recovered_in_mm",
    Periodic: "a_tilted_plane_is_recovered_in_mm_with_y_up",
    SpreadingUnknown: "unknown_stays_unknown_and_does_not_spread",
    InventedHeight: "unknown_stays_unknown_and_does_not_spread",
    OverwrittenNormals: "normals_are_not_overwritten",
    DoubleHeight: "the_height_is_float32_on_the_same_grid_with_mean_0",
    CroppedHeight: "the_height_is_float32_on_the_same_grid_with_mean_0",
    WrongPerspective: "hills_under_a_perspective_camera_are_recovered",
    LowestAtZero: "the_height_is_float32_on_the_same_grid_with_mean_0",
    RestlessHeight: "twice_the_same",
    ForgetfulOptions: "its_options_make_the_round_trip_through_json",
    SilentOptions: "every_option_is_described",
    ShoutedName: "is_of_its_kind_and_has_a_hyphenated_name",
    BoundToAProcess: "it_travels_to_a_worker",
    NormalsYDown: "normals_and_albedo_are_exact_under_near_lamps",
    ScaledNormals: "the_solution_is_float32_of_the_bands_shape",
    WrongAlbedo: "normals_and_albedo_are_exact_under_near_lamps",
    UnusedWeights: "samples_of_weight_0_are_not_used",
    LeakingUnknown: "samples_of_weight_0_are_not_used",
    InventedWeights: "samples_of_weight_0_are_not_used",
    Guess: "fewer_than_three_lights_give_nan_and_only_there",
    OnlyNearLights: "distant_lights_are_broadcast_over_the_band",
    DoubleNormals: "the_solution_is_float32_of_the_bands_shape",
    OverwrittenImages: "inputs_are_not_overwritten",
    OverwrittenWeights: "inputs_are_not_overwritten",
    RowsLeaningOnTheirBand: "each_pixel_stands_for_itself",
    GuessFromLightsInOnePlane: "lights_in_one_plane_give_nan",
    RestlessNormals: "twice_the_same",
    OneDeskForAll: "several_threads_may_ask_at_once",
    NegativeConfidence: "the_solution_is_float32_of_the_bands_shape",
    ConfidenceInRadians: "the_confidence_covers_68_percent_of_the_errors",
    CorrectedHeight: "a_smooth_deformation_is_found",
    WholeHeight: "fine_relief_is_left_to_the_artwork",
    UnknownTrend: "the_trend_is_float32_and_finite_where_the_height_is_not_known",
    UnknownTakenForLevel: "the_trend_is_float32_and_finite_where_the_height_is_not_known",
    DoubleTrend: "the_trend_is_float32_and_finite_where_the_height_is_not_known",
    OverwrittenHeight: "the_height_is_not_overwritten_and_the_trend_repeats",
    OppositeBias: "a_constant_tilt_is_removed",
    ReferenceAsBias: "a_reference_without_distortion_has_no_bias",
    MeanBias: "a_smooth_distortion_is_removed",
    BiasYDown: "a_constant_tilt_is_removed",
    UnknownBias: "the_bias_is_float32_and_finite_where_the_reference_is_not_known",
    DoubleBias: "the_bias_is_float32_and_finite_where_the_reference_is_not_known",
    OverwrittenReference: "the_reference_is_not_overwritten_and_the_bias_repeats",
    InvertedFlatField: "the_flat_field_is_that_of_the_lamps_but_for_a_common_factor",
    FlatFieldUpsideDown: "the_flat_field_is_that_of_the_lamps_but_for_a_common_factor",
    EachLampNormalised: "the_flat_field_is_that_of_the_lamps_but_for_a_common_factor",
    ZeroWhereSaturated: "saturated_places_of_a_flat_do_not_spread",
    SpreadingSaturation: "saturated_places_of_a_flat_do_not_spread",
    DoubleFlatField: "the_flat_field_is_positive_float32",
    OverwrittenFlats: "flats_are_not_overwritten_and_the_flat_field_repeats",
    SignlessFlatField: "the_flat_field_is_positive_float32",
    LampsOfTheStand: "lamps_are_found_in_the_order_of_the_frames",
    MeasuredAxes: "lamps_are_found_in_the_order_of_the_frames",
    LampsYDown: "lamps_are_found_in_the_order_of_the_frames",
    SingleLamps: "calibration_is_float64_and_directions_are_unit_vectors",
    LongDirections: "calibration_is_float64_and_directions_are_unit_vectors",
    InventedLamps: "a_tile_that_lacks_what_the_model_needs_is_refused",
    RestlessLamps: "the_record_of_the_lamps_reads_back_and_repeats",
}


def contract_of(algorithm):
    return next(contract for contract in REFERENCES if issubclass(algorithm, contract.kind))


@pytest.mark.parametrize("contract", REFERENCES)
def test_a_correct_implementation_keeps_its_contract(contract):
    assert failures(contract, REFERENCES[contract]()) == set()


@pytest.mark.parametrize("mutant", CAUGHT)
def test_each_mutant_is_caught_by_the_test_meant_for_it(mutant):
    instance = mutant(strength=2.0) if mutant is ForgetfulOptions else mutant()
    assert f"test_{CAUGHT[mutant]}" in failures(contract_of(mutant), instance)


def test_every_test_of_every_contract_catches_a_mutant():
    caught = {contract: set() for contract in REFERENCES}
    for mutant, name in CAUGHT.items():
        caught[contract_of(mutant)].add(f"test_{name}")
    shared = {name for name in dir(contracts.AlgorithmContract) if name.startswith("test_")}
    assert shared <= set.union(*caught.values())
    for contract, names in caught.items():
        own = {name for name in dir(contract) if name.startswith("test_")} - shared
        assert own - names == set()


def test_there_is_a_contract_for_every_kind():
    assert {contract.kind for contract in REFERENCES} == set(KINDS)
    assert {contract.__name__ for contract in REFERENCES} == set(contracts.__all__) - {"AlgorithmContract"}


def test_the_page_on_plugins_quotes_the_example_plugin_whole():
    root = Path(__file__).parents[3]
    page = (root / "docs" / "writing-a-plugin.md").read_text(encoding="utf-8")
    for name in ("nlights_cosine.py", "test_nlights_cosine.py", "pyproject.toml"):
        assert (root / "tests" / "example_plugin" / name).read_text(encoding="utf-8").strip() in page
    for contract in REFERENCES:
        assert f"`{contract.__name__}`" in page
