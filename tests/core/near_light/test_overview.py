"""The overview: block means that are those of all pixels, heights that come back to their pixels."""

import numpy as np
import pytest
import tifffile

from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.manifest import load_capture
from nlights_core.near_light.overview import Enlarged, block_edge, reduced_room, thinned_room
from nlights_core.photographs.block_means import middle_lines
from nlights_core.photographs.development import darkroom
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.stages import flat_field, lights, overview
from nlights_core.store import Store


@pytest.fixture(scope="module")
def relief(tmp_path_factory):
    """1051 columns: blocks of 2 x 2 pixels, and one column that fills none."""
    folder = tmp_path_factory.mktemp("relief") / "capture"
    simulate(folder, load_stand("vertical-dark"), scene="relief", width=1051, seed=3)
    return folder


def test_thinned_photographs_are_every_other_pixel_where_it_lies(relief, tmp_path):
    tile = load_capture(relief)[0]
    with darkroom(tile, tmp_path) as room:
        small = reduced_room(room, lambda _: None)
    thin = thinned_room(small)
    assert small.grid.columns % 2 == 1  # an odd length and an even one
    assert small.grid.rows % 2 == 0
    np.testing.assert_array_equal(thin.images, small.images[:, ::2, ::2])
    np.testing.assert_array_equal(thin.inside, small.inside[::2, ::2])
    np.testing.assert_allclose(thin.grid.x(), small.grid.x()[::2])
    np.testing.assert_allclose(thin.grid.y(), small.grid.y()[::2])
    np.testing.assert_array_equal(thin.noise.gain, small.noise.gain)


def test_blocks_hold_the_means_of_their_pixels_and_know_saturation(relief, tmp_path):
    tile = load_capture(relief)[0]
    first = next(iter(tile.frames.values()))
    with darkroom(tile, tmp_path) as room:
        small = reduced_room(room, lambda _: None)
        unit = LightField(tile.lamps, positions=load_stand("vertical-dark").lamp_positions())
        raw = small.raw(10, 12, unit)
    assert block_edge(1051) == 2
    assert small.grid.shape == (tifffile.imread(first).shape[0] // 2, 525)
    assert small.grid.pixel_size == pytest.approx(2 * 500 / 1051)
    # Blocks lie where their pixels do, though one column fills none: lamps would seem to stand elsewhere.
    np.testing.assert_allclose(small.grid.x(), room.grid.x()[:-1].reshape(-1, 2).mean(axis=1))
    light = tifffile.imread(first)[20:24, :1050] / 65535 - tifffile.imread(tile.dark)[20:24, :1050] / 65535
    expected = light.reshape(2, 2, 525, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(raw.images[0], expected, atol=1e-6)
    assert not raw.saturated.any()


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("factor", [1, 2, 3, 7])
def test_blocks_lie_where_their_pixels_do(factor, whole):
    grid = PixelGrid(41, 62, 0.5, camera=(0, 0, 900))
    small = grid.reduced(factor, whole)
    across, down = small.columns * factor, small.rows * factor
    # Pixels in a row go on beside the photograph where the last blocks do.
    x = grid.x()[0] + grid.pixel_size * np.arange(across)
    y = grid.y()[0] - grid.pixel_size * np.arange(down)
    np.testing.assert_allclose(small.x(), x.reshape(-1, factor).mean(axis=1))
    np.testing.assert_allclose(small.y(), y.reshape(-1, factor).mean(axis=1))
    assert small.shape == ((41 // factor, 62 // factor) if whole else (-(-41 // factor), -(-62 // factor)))


@pytest.mark.parametrize("block", range(1, 30))
def test_lines_that_are_looked_at_lie_in_the_middle_of_a_block(block):
    lines = middle_lines(block, 4)
    assert np.mean(lines) == (block - 1) / 2
    assert min(block, 4) <= len(lines) <= min(block, 5)


@pytest.mark.parametrize("factor", [1, 3, 4])
def test_a_plane_comes_back_to_its_pixels(factor):
    shape = (41, 62)
    row, column = np.indices(shape, dtype=np.float32)
    plane = 0.5 * column - 0.2 * row
    rows, columns = (n // factor for n in shape)
    blocks = plane[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    found = Enlarged(blocks.mean(axis=(1, 3)), factor, shape)[0:41]
    assert found.shape == shape
    assert found.dtype == np.float32
    inner = (slice(factor, rows * factor - factor), slice(factor, columns * factor - factor))
    np.testing.assert_allclose(found[inner], plane[inner], atol=1e-4)


def test_what_is_not_known_takes_the_nearest_height():
    height = np.full((6, 8), 2.0, np.float32)
    height[2:, 5:] = np.nan
    np.testing.assert_array_equal(Enlarged(height, 3, (18, 24))[4:17], np.full((13, 24), 2))


def test_the_height_of_a_relief_is_found_but_for_its_constant(relief, tmp_path):
    tile, recipe, store = load_capture(relief)[0], load_recipe("default"), Store(tmp_path / "store")
    lamps = lights(store, tile, recipe.light_model)
    store.ensure(lamps)
    white = flat_field(store, tile, recipe.detrend.images, lamps.ref)
    store.ensure(white)
    work = overview(store, tile, lamps.ref, white.ref, 2)
    store.ensure(work)
    truth = tifffile.imread(relief / "truth" / "height.tif")
    found = Enlarged(np.load(store.path(work.ref) / "height.npy"), 2, truth.shape)[0 : len(truth)]
    # Its constant is free, which bends it by 0.1 mm for each mm: a calibration finds it, an overview does not.
    assert np.abs(found.mean()) < 0.01
    assert np.std(found - truth) < 0.15
