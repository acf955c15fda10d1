"""The height's constant and the lamps' drift, found in photographs whose truth is known."""

import numpy as np
import pytest
import tifffile

from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.manifest import load_capture
from nlights_core.near_light.levelling import Level, find_level, read_level, write_level
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.stages import flat_field, lights
from nlights_core.store import Store


@pytest.fixture(scope="module", params=["relief", "painting"])
def scene(request, tmp_path_factory):
    """A tile, its lamps, its flat field and its true height."""
    folder = tmp_path_factory.mktemp(request.param)
    simulate(folder / "capture", load_stand("horizontal"), scene=request.param, width=240, seed=4)
    tile, recipe, store = load_capture(folder / "capture")[0], load_recipe("default"), Store(folder / "store")
    first = lights(store, tile, recipe.light_model)
    store.ensure(first)
    second = flat_field(store, tile, recipe.detrend.images, first.ref)
    store.ensure(second)
    stand = load_stand("horizontal")
    field = LightField(tile.lamps, positions=stand.lamp_positions())
    return (
        tile,
        field,
        read_flat_field(store.path(second.ref)),
        tifffile.imread(folder / "capture/truth/height.tif"),
    )


def found(scene, field, height, tmp_path, assumed=None) -> Level:
    tile, _, flat_field, _ = scene
    with darkroom(tile, tmp_path) as room:
        return find_level(room, field, flat_field, height, assumed)


@pytest.mark.parametrize("lost", [0.0, -0.7, 3.0])
def test_a_constant_that_was_lost_is_found(scene, tmp_path, lost):
    _, field, _, truth = scene
    result = found(scene, field, truth - np.float32(lost), tmp_path)
    assert result.offset == pytest.approx(lost, abs=0.2)
    assert result.uncertainty is not None
    assert result.uncertainty < 0.2


def test_lamps_that_drifted_since_the_flats_are_found_and_not_taken_for_height(scene, tmp_path):
    _, field, _, truth = scene
    drift = 1 + np.random.default_rng(3).normal(0, 0.01, 8)
    # Images divided by too large a power are those of a lamp that has become weaker.
    # The height is the true one, as it would be measured with lamps known to be that strong.
    result = found(scene, field.stronger(1 / drift), truth, tmp_path, drift / drift.mean())
    assert result.offset == pytest.approx(0, abs=0.2)
    ratio = result.strengths / drift
    np.testing.assert_allclose(ratio / ratio.mean(), 1, atol=3e-3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lamps_five_millimetres_off_hardly_move_the_level_and_are_not_taken_for_drift(scene, tmp_path, seed):
    _, field, _, truth = scene
    moved = field.positions + np.random.default_rng(seed).normal(0, 5, (8, 3))
    result = found(scene, LightField(field.lamps, positions=moved), truth, tmp_path)
    assert result.offset == pytest.approx(0, abs=0.3)
    np.testing.assert_allclose(result.strengths, 1, atol=1e-3)


def test_noise_is_not_taken_for_height(tmp_path):
    simulate(tmp_path / "c", load_stand("vertical-dark"), scene="plane", width=240, seed=4)
    random = np.random.default_rng(5)
    for path in (tmp_path / "c").glob("light_*.tif"):
        frame = tifffile.imread(path)
        noisy = frame + random.normal(0, 1500, frame.shape)
        tifffile.imwrite(path, np.clip(np.rint(noisy), 0, 65534).astype(np.uint16), photometric="rgb")
    tile, recipe, store = load_capture(tmp_path / "c")[0], load_recipe("default"), Store(tmp_path / "store")
    first = lights(store, tile, recipe.light_model)
    store.ensure(first)
    second = flat_field(store, tile, recipe.detrend.images, first.ref)
    store.ensure(second)
    field = LightField(tile.lamps, positions=load_stand("vertical-dark").lamp_positions())
    with darkroom(tile, tmp_path) as room:
        divisor = read_flat_field(store.path(second.ref))
        result = find_level(room, field, divisor, np.zeros(room.grid.shape, np.float32))
    assert result.uncertainty is not None
    assert abs(result.offset) < result.uncertainty < 1


def test_gloss_is_not_taken_for_height(tmp_path):
    simulate(tmp_path / "c", load_stand("horizontal"), scene="painting", width=240, seed=4, varnish=True)
    tile, recipe, store = load_capture(tmp_path / "c")[0], load_recipe("default"), Store(tmp_path / "store")
    first = lights(store, tile, recipe.light_model)
    store.ensure(first)
    second = flat_field(store, tile, recipe.detrend.images, first.ref)
    store.ensure(second)
    field = LightField(tile.lamps, positions=load_stand("horizontal").lamp_positions())
    with darkroom(tile, tmp_path) as room:
        result = find_level(
            room, field, read_flat_field(store.path(second.ref)), np.zeros(room.grid.shape, np.float32)
        )
    assert result.uncertainty is None
    assert result.offset == 0
    np.testing.assert_array_equal(result.strengths, 1)


def test_a_height_that_is_nowhere_known_has_no_level(scene, tmp_path):
    _, field, _, truth = scene
    result = found(scene, field, np.full_like(truth, np.nan), tmp_path)
    assert result == Level(0.0, None, result.strengths)


def test_a_level_is_read_back_as_it_was_written(tmp_path):
    write_level(tmp_path, Level(0.5, 0.1, np.array([1.01, 0.99])))
    again = read_level(tmp_path)
    assert (again.offset, again.uncertainty) == (0.5, 0.1)
    np.testing.assert_array_equal(again.strengths, [1.01, 0.99])
