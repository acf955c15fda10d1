"""The fused normal stage: it finds what the stage in bands of numpy arrays finds."""

import json

import numpy as np
import pytest
import tifffile

from nlights_core import memory
from nlights_core.capture import Encoding
from nlights_core.configurations import load_stand
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.machine import kernel_switch
from nlights_core.manifest import load_capture
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import FlatField, extend_beyond_frame
from nlights_core.simulation.captures import simulate
from nlights_core.solving import band_solving as solving
from nlights_core.solving import fused_solving, kernels, least_squares
from nlights_plugins.least_squares import LeastSquares
from nlights_plugins.median_of_triplets import MedianOfTriplets
from nlights_plugins.progressive import Progressive
from nlights_plugins.rank_trim import RankTrim
from nlights_plugins.robust import Robust

pytest.importorskip("numba")

ARRAYS = ("normals", "confidence", "residual", "used", "saturated", "shadow", "frames")
COLOURS = ("albedo", "reflection")
FILES = ARRAYS + COLOURS
STAND = load_stand("horizontal")


class Foreign(LeastSquares):
    """A solver without a kernel of its own: it sees plain arrays."""

    def solve(self, images, lights, weights):
        usable = least_squares.lit(images, weights, self.shadow)
        found = least_squares.fit(images, lights, usable, self.condition)
        return least_squares.solution(images, lights, usable, found)


@pytest.fixture(scope="module")
def tile(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    simulate(folder, STAND, scene="painting", width=200, varnish=True, seed=2)
    return load_capture(folder)[0]


def near(tile) -> LightField:
    power = 1 + 0.05 * np.arange(8)[:, None] * np.array([1, 0.9, 1.1])
    return LightField(tile.lamps, positions=STAND.lamp_positions(), power=power)


def flat_field(tile, channels: int = 3) -> FlatField:
    """Roughly what the flats show, made of the lamps' geometry, seen through a lens that vignettes."""
    x, y = np.linspace(-248, 248, 62), np.linspace(186, -186, 46)
    points = np.stack([*np.meshgrid(x, y), np.zeros((46, 62))])
    lamps = LightField(tile.lamps, positions=STAND.lamp_positions())
    reading = 0.4 * lamps.vectors(points)[..., 2:] * np.array([1, 0.9, 0.7])[:channels]
    found = extend_beyond_frame(reading.astype(np.float32), x, y, float(x[1] - x[0]))
    return FlatField(found.logarithm, found.left, found.top, found.step, (20.0, -10.0, 1500.0), 0.7)


def height(tile) -> np.ndarray:
    waves = np.sin(np.arange(200) / 20) * np.cos(np.arange(150) / 15)[:, None]
    waves[3, 5] = np.nan
    return (4 * waves).astype(np.float32)


def found(tile, solver, lights, divisor, surface, folder, bias=None) -> dict[str, np.ndarray]:
    folder.mkdir()
    with darkroom(tile, folder) as room:
        solving.solve_tile(room, solver, lights, divisor, surface, folder, lambda share: None, bias, 0.9)
        account = [(e.pixels, e.saturated, e.total) for e in room.exposures.values()]
    agreement = json.loads((folder / "agreement.json").read_text())
    images = {name: np.load(folder / f"{name}.npy") for name in ARRAYS}
    images |= {name: tifffile.imread(folder / f"{name}.tif") for name in COLOURS}
    return images | {"account": np.array(account), "held_out": np.array(agreement["held_out"])}


def assert_both_agree(
    tile, tmp_path, monkeypatch, *, solver=None, lights=None, divisor=None, surface=None, bias=None
):
    """Both ways to solve, after a look at whether both were gone."""
    given = (solver or LeastSquares(), lights or near(tile), divisor or flat_field(tile), surface)
    strips = fused_solving.FusedSolver.strips
    calls = []
    monkeypatch.setattr(
        fused_solving.FusedSolver, "strips", lambda self, meter: calls.append(self) or strips(self, meter)
    )
    monkeypatch.delenv(kernel_switch.SWITCH, raising=False)
    fused = found(tile, *given, tmp_path / "fused", bias)
    monkeypatch.setenv(kernel_switch.SWITCH, "off")
    plain = found(tile, *given, tmp_path / "plain", bias)
    assert len(calls) == 1
    for name in ("used", "saturated", "shadow"):
        np.testing.assert_array_equal(fused[name], plain[name], name)
    for name in ("normals", "albedo", "reflection", "residual", "frames", "account", "held_out"):
        np.testing.assert_allclose(fused[name], plain[name], rtol=1e-4, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(fused["confidence"], plain["confidence"], rtol=1e-3)
    return plain


def rewritten(tile, folder, change):
    """The tile with other photographs."""

    def written(path, name):
        numbers = change(tifffile.imread(path))
        kind = "rgb" if numbers.ndim == 3 else "minisblack"
        tifffile.imwrite(folder / name, numbers, photometric=kind)
        return folder / name

    frames = {lamp: written(path, f"{lamp}.tif") for lamp, path in tile.frames.items()}
    return tile.model_copy(update={"frames": frames, "flats": None, "dark": written(tile.dark, "dark.tif")})


@pytest.mark.parametrize(
    "solver", [LeastSquares(), LeastSquares(shadow=0.3, condition=3.0), RankTrim(), Foreign()]
)
@pytest.mark.parametrize("surface", [None, height])
def test_it_finds_what_bands_find(tile, tmp_path, monkeypatch, solver, surface):
    plain = assert_both_agree(tile, tmp_path, monkeypatch, solver=solver, surface=surface and surface(tile))
    assert np.isfinite(plain["normals"]).mean() > 0.5


@pytest.mark.parametrize("solver", [Robust(), Progressive(), MedianOfTriplets()])
def test_with_solvers_that_discard_by_residuals_nearly_all_pixels_are_alike(
    tile, tmp_path, monkeypatch, solver
):
    # A residual that rounding puts on the other side of a limit changes the weights of its pixel.
    monkeypatch.delenv(kernel_switch.SWITCH, raising=False)
    given = (tile, solver, near(tile), flat_field(tile), height(tile))
    fused = found(*given, tmp_path / "fused")
    monkeypatch.setenv(kernel_switch.SWITCH, "off")
    plain = found(*given, tmp_path / "plain")
    for name in ("normals", "albedo", "residual", "used"):
        alike = np.isclose(fused[name], plain[name], rtol=1e-3, atol=1e-4, equal_nan=True)
        assert alike.mean() > 0.9995, name


@pytest.mark.parametrize("solver", [Robust(), Foreign()])
def test_little_memory_makes_strips_of_few_rows_and_the_same_bits(tile, tmp_path, monkeypatch, solver):
    given = (tile, solver, near(tile), flat_field(tile), height(tile))
    whole = found(*given, tmp_path / "whole")
    monkeypatch.setenv(memory.VARIABLE, "12M")
    strips = found(*given, tmp_path / "strips")
    for name in FILES:
        assert whole[name].tobytes() == strips[name].tobytes(), name


@pytest.mark.parametrize("solver", [LeastSquares(), Foreign()])
def test_outside_the_mask_nothing_is_known(tile, tmp_path, monkeypatch, solver):
    mask = np.zeros((150, 200), np.uint8)
    mask[20:90, 30:190] = 255
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    masked = tile.model_copy(update={"mask": tmp_path / "mask.tif"})
    plain = assert_both_agree(masked, tmp_path, monkeypatch, solver=solver)
    assert np.isnan(plain["normals"][mask == 0]).all()


def test_without_a_dark_frame_both_agree(tile, tmp_path, monkeypatch):
    assert_both_agree(tile.model_copy(update={"dark": None}), tmp_path, monkeypatch)


@pytest.mark.parametrize(
    "change",
    [
        lambda numbers: numbers[..., 1],
        lambda numbers: (numbers >> 8).astype(np.uint8),
        lambda numbers: (numbers / 65535).astype(np.float32),
        lambda numbers: numbers.astype(">u2"),
    ],
    ids=["grey", "8 bit", "float", "big endian"],
)
def test_on_photographs_of_other_kinds_both_agree(tile, tmp_path, monkeypatch, change):
    other = rewritten(tile, tmp_path, change)
    channels = 1 if tifffile.imread(other.dark).ndim == 2 else 3
    lights = LightField(tile.lamps, positions=STAND.lamp_positions())
    assert_both_agree(other, tmp_path, monkeypatch, lights=lights, divisor=flat_field(tile, channels))


@pytest.mark.parametrize(
    "encoding",
    [Encoding(saturation=20_000), Encoding(saturation="none"), Encoding(transfer="srgb")],
    ids=["low level", "no level", "tone curve"],
)
def test_in_other_encodings_both_agree(tile, tmp_path, monkeypatch, encoding):
    assert_both_agree(
        tile.model_copy(update={"encoding": encoding}), tmp_path, monkeypatch, surface=height(tile)
    )


@pytest.mark.parametrize("solver", [LeastSquares(), Foreign()])
def test_under_distant_lamps_both_agree(tile, tmp_path, monkeypatch, solver):
    directions = STAND.lamp_positions() / np.linalg.norm(STAND.lamp_positions(), axis=1, keepdims=True)
    lights = LightField(tile.lamps, directions=directions)
    assert_both_agree(tile, tmp_path, monkeypatch, solver=solver, lights=lights, surface=height(tile))


def test_with_a_flat_field_of_one_channel_for_all_colours_both_agree(tile, tmp_path, monkeypatch):
    assert_both_agree(tile, tmp_path, monkeypatch, divisor=flat_field(tile, 1), surface=height(tile))


def test_both_remove_a_bias_alike(tile, tmp_path, monkeypatch):
    bias = np.zeros((150, 200, 3), np.float32)
    bias[..., 0] = 0.02
    assert_both_agree(tile, tmp_path, monkeypatch, bias=bias)


def test_a_black_photograph_is_refused(tile, tmp_path):
    black = rewritten(tile, tmp_path, np.zeros_like)
    with pytest.raises(TileError, match="all black"):
        found(black, Robust(), near(tile), flat_field(tile), None, tmp_path / "out")


def test_a_solver_derived_from_a_bundled_one_does_its_own_work():
    class Cautious(Robust):
        def solve(self, images, lights, weights):
            return super().solve(images, lights, weights * 0.5)

    assert kernels.rule_of(Robust()) is not None
    assert kernels.rule_of(Cautious()) is None
