"""Arrays in, maps out, against analytic truth."""

import numpy as np
import pytest

import nlights
from nlights_core.photographs import development
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.scenes import synthetic_stand
from nlights_core.simulation.surfaces import height_map, normal_field, plane, wave
from nlights_plugins.integrators import Simchony
from nlights_plugins.least_squares import LeastSquares

GRID = nlights.PixelGrid(40, 60, 5.0, camera=(0.0, 0.0, 1540.0))
SURFACE = wave(2.0, 120.0, angle_deg=30.0) + plane(slope_y=0.05)
STAND = synthetic_stand()
NEAR = nlights.LightField(tuple(STAND.lamps), positions=STAND.lamp_positions())
LIGHTS = STAND.lamp_positions() / np.linalg.norm(STAND.lamp_positions(), axis=1, keepdims=True)
NORMALS = normal_field(SURFACE, GRID).normals
ALBEDO = np.tile(np.linspace(0.2, 0.9, GRID.columns, dtype=np.float32), (GRID.rows, 1))


def lit(lights: np.ndarray = LIGHTS) -> np.ndarray:
    """Images (L, H, W) under distant lights."""
    return np.float32(ALBEDO * np.einsum("lk,hwk->lhw", lights, NORMALS))


@pytest.mark.parametrize("solver", ["least-squares", "robust", LeastSquares()])
def test_distant_lights_give_normals_and_albedo(solver):
    found = nlights.solve(lit(), LIGHTS, solver=solver)
    assert angles_between(found.normals, NORMALS).max() < 0.05
    assert np.abs(found.albedo / ALBEDO - 1).max() < 2e-3
    assert (found.normals.unit, found.albedo.unit, found.confidence.unit) == ("", "", "°")
    assert found.normals.grid == nlights.PixelGrid(40, 60, 1.0, unit="px")
    normals, _, confidence = found
    assert normals is found.normals
    assert (confidence >= 0).all()


def test_lamps_near_by_need_a_grid():
    points = GRID.points(0, GRID.rows)
    images = np.float32(ALBEDO * np.einsum("lhwk,hwk->lhw", NEAR.vectors(points), NORMALS))
    found = nlights.solve(images, NEAR, grid=GRID, solver="least-squares")
    assert angles_between(found.normals, NORMALS).max() < 0.05
    assert found.normals.grid == GRID
    with pytest.raises(ValueError, match="grid: is missing, and lamps near by need it"):
        nlights.solve(images, NEAR)


def test_power_and_ambient_light_of_a_light_field_are_heeded():
    power, ambient = np.linspace(0.5, 2, len(LIGHTS))[:, None], np.full(len(LIGHTS), 0.05)
    field = nlights.LightField(tuple(STAND.lamps), directions=LIGHTS, power=power, ambient=ambient)
    images = power[:, :, None] * (lit() + 0.05 * ALBEDO)
    found = nlights.solve(images, field, solver="least-squares")
    assert angles_between(found.normals, NORMALS).max() < 0.1


def test_colours_give_a_coloured_albedo():
    colours = np.array([1.0, 0.5, 0.25], np.float32)
    found = nlights.solve(lit()[..., None] * colours, LIGHTS)
    assert found.albedo.shape == (*GRID.shape, 3)
    assert np.abs(found.albedo / (ALBEDO[..., None] * colours) - 1).max() < 2e-3
    assert angles_between(found.normals, NORMALS).max() < 0.05


def test_nan_and_weight_0_are_samples_that_are_not_used():
    images, weights = lit(), np.ones((len(LIGHTS), *GRID.shape))
    images[0] = np.nan
    images[1, :, :30] = 7
    weights[1, :, :30] = 0
    images[3:, 5, 5] = np.nan
    found = nlights.solve(images, LIGHTS, weights=weights, solver="least-squares")
    known = np.isfinite(found.confidence)
    assert np.argwhere(~known).tolist() == [[5, 5]]
    assert np.isnan(found.normals[5, 5]).all()
    assert angles_between(found.normals, NORMALS)[known].max() < 0.05


def test_large_images_are_read_by_bands(tmp_path, monkeypatch):
    whole = nlights.solve(lit(), LIGHTS)
    images = np.lib.format.open_memmap(tmp_path / "images.npy", "w+", np.float32, (len(LIGHTS), *GRID.shape))
    images[:] = lit()
    seen = []
    monkeypatch.setattr(development, "BAND_BYTES", 50_000)
    monkeypatch.setattr(
        LeastSquares,
        "solve",
        lambda self, *given, _of=LeastSquares.solve: seen.append(1) or _of(self, *given),
    )
    found = nlights.solve(images, LIGHTS)
    assert np.array_equal(found.normals, whole.normals)
    nlights.solve(images, LIGHTS, solver="least-squares")
    assert len(seen) > 10


@pytest.mark.parametrize(
    ("images", "lights", "options", "words"),
    [
        (np.ones((8, 4, 5), np.uint16), LIGHTS, {}, "images: should be linear light as floats.*got uint16"),
        (np.ones((4, 5)), LIGHTS, {}, r"images: should be of shape \(L, H, W\).*got \(4, 5\)"),
        (np.ones((8, 4, 5, 2)), LIGHTS, {}, r"images: .*got \(8, 4, 5, 2\)"),
        (np.ones((2, 4, 5)), LIGHTS[:2], {}, "images: photometric stereo needs at least 3 lamps; got 2"),
        (np.ones((8, 4, 5)), LIGHTS.T, {}, r"lights: should be of shape \(8, 3\).*got \(3, 8\)"),
        (np.ones((8, 4, 5)), np.full((8, 3), np.nan), {}, "lights: should be finite"),
        (np.ones((7, 4, 5)), NEAR, {"grid": GRID}, "lights: of 8 lamps, but there are 7 images"),
        (
            np.ones((8, 4, 5)),
            NEAR,
            {"grid": GRID},
            r"grid: of \(40, 60\) pixels, but the images have \(4, 5\)",
        ),
        (
            np.ones((8, 4, 5)),
            LIGHTS,
            {"weights": np.ones((8, 4))},
            r"weights: should be of shape \(8, 4, 5\)",
        ),
        (
            np.ones((8, 4, 5)),
            LIGHTS,
            {"weights": -np.ones((8, 4, 5))},
            "weights: should be finite, 0 or more",
        ),
        (np.ones((8, 4, 5)), LIGHTS, {"solver": Simchony()}, "normals: should be the name of an algorithm"),
        (
            np.ones((8, 4, 5)),
            LIGHTS,
            {"solver": LeastSquares(), "condition": 9},
            "condition: options go with",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(images, lights, options, words):
    with pytest.raises(ValueError, match=words):
        nlights.solve(images, lights, **options)


def test_solvers_and_options_are_chosen_as_in_a_recipe():
    with pytest.raises(nlights.RecipeError, match=r"solve: normals.use: .* 'robst'; did you mean 'robust'\?"):
        nlights.solve(lit(), LIGHTS, solver="robst")
    with pytest.raises(nlights.RecipeError, match=r"integrate: integrator.stencl: unknown field; .*stencil"):
        nlights.integrate(NORMALS, stencl="trapezoid")


@pytest.mark.parametrize("integrator", ["simchony", "frankot-chellappa", Simchony(perspective=False)])
def test_normals_are_integrated_with_y_up_in_mm(integrator):
    grid = nlights.PixelGrid(40, 60, 5.0)
    truth = height_map(SURFACE, grid).height
    normals = normal_field(SURFACE, grid).normals
    found = nlights.integrate(normals, pixel_size=5.0, integrator=integrator)
    assert (found.unit, found.grid) == ("mm", grid)
    assert np.abs(found - (truth - truth.mean())).max() < 0.1
    pixels = nlights.integrate(normals.astype(float), integrator=integrator)
    assert (pixels.unit, pixels.grid.pixel_size) == ("px", 1.0)
    assert np.abs(5 * pixels - found).max() < 1e-2


def test_a_map_brings_its_grid_and_a_camera_can_be_given():
    normals = nlights.Map(NORMALS, GRID, "")
    truth = height_map(SURFACE, GRID).height
    found = nlights.integrate(normals)
    assert (found.grid, found.unit) == (GRID, "mm")
    assert np.abs(found - (truth - truth.mean())).max() < 0.1
    same = nlights.integrate(NORMALS, pixel_size=5.0, camera=GRID.camera)
    assert np.array_equal(found, same)
    assert nlights.integrate(normals[:20]).unit == "px"


def test_not_known_stays_so_and_does_not_spread():
    grid = nlights.PixelGrid(40, 60, 5.0)
    normals = normal_field(SURFACE, grid).normals.copy()
    normals[10:14, 20:24] = np.nan
    found = nlights.integrate(normals, pixel_size=5.0, confidence=np.full(grid.shape, 0.2))
    assert np.array_equal(np.isnan(found), np.isnan(normals[..., 2]))
    truth = height_map(SURFACE, grid).height
    known = np.isfinite(found)
    assert np.abs(found[known] - (truth - truth[known].mean())[known]).max() < 0.1


@pytest.mark.parametrize(
    ("normals", "options", "words"),
    [
        (np.zeros((4, 5)), {}, r"normals: should be of shape \(H, W, 3\).*got \(4, 5\)"),
        (np.zeros((4, 5, 3), np.uint8), {}, "normals: should be unit vectors as floats; got uint8"),
        (np.full((4, 5, 3), 2.0), {}, "normals: should be unit vectors; got a length of 3.464"),
        (NORMALS, {"pixel_size": 0}, "pixel_size: should be a length above 0, in mm; got 0"),
        (NORMALS, {"confidence": np.ones((4, 5))}, r"confidence: should be of shape \(40, 60\)"),
    ],
)
def test_normals_that_are_none_are_refused_by_name(normals, options, words):
    with pytest.raises(ValueError, match=words):
        nlights.integrate(normals, **options)


def test_a_field_that_does_not_fit_the_memory_is_refused_first():
    with pytest.raises(nlights.TileError, match=r"integrator: simchony: needs .* memory allows 1\.0 MiB"):
        nlights.integrate(NORMALS, memory="1MiB")
    with pytest.raises(nlights.CaptureError, match=r"^memory: 'lots'"):
        nlights.integrate(NORMALS, memory="lots")
