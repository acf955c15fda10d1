"""Compiled development and levelling say what numpy says, and leave out what is not known."""

import numpy as np
import pytest

from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.machine.kernel_switch import SWITCH, available
from nlights_core.manifest import load_capture
from nlights_core.near_light.levelling import find_level
from nlights_core.near_light.linearisation import Strip, linearise
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.stages import flat_field, lights
from nlights_core.store import Store

pytestmark = pytest.mark.skipif(not available(), reason="there are no compiled loops to compare")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A painting's tile, its lamps and its flat field, seen through a lens."""
    folder = tmp_path_factory.mktemp("painting")
    simulate(folder / "capture", load_stand("horizontal"), scene="painting", width=240, seed=4)
    tile, recipe, store = load_capture(folder / "capture")[0], load_recipe("default"), Store(folder / "store")
    first = lights(store, tile, recipe.light_model)
    store.ensure(first)
    second = flat_field(store, tile, recipe.detrend.images, first.ref)
    store.ensure(second)
    field = LightField(tile.lamps, positions=load_stand("horizontal").lamp_positions())
    return tile, field, read_flat_field(store.path(second.ref))


def by_both(monkeypatch, work):
    """What compiled loops find, and what numpy does."""
    compiled = work()
    monkeypatch.setenv(SWITCH, "off")
    return compiled, work()


@pytest.mark.parametrize("raised", [None, 3.0, -20.0])
def test_compiled_development_is_that_of_numpy(scene, tmp_path, monkeypatch, raised):
    tile, field, flat_field = scene
    assert flat_field.vignetting != 0
    field = field.stronger(np.linspace(0.8, 1.2, len(field.lamps)))
    with darkroom(tile, tmp_path) as room:
        raw = room.raw(20, 40, field)
        raw.saturated[2, :5] = True
        height = None
        if raised is not None:
            height = (raised + np.random.default_rng(0).normal(size=raw.inside.shape)).astype(np.float32)
            height[3, 7] = np.nan
        compiled, plain = by_both(monkeypatch, lambda: room.develop(raw, field, flat_field, height))
    for name in ("images", "lights", "grey", "weights"):
        np.testing.assert_allclose(getattr(compiled, name), getattr(plain, name), rtol=1e-5, atol=1e-6)
    assert not compiled.weights[2, :5].any()


def test_a_flat_field_of_one_channel_divides_every_colour(scene, tmp_path, monkeypatch):
    tile, field, flat_field = scene
    grey = flat_field.logarithm.mean(axis=-1, keepdims=True)
    computed = type(flat_field)(
        grey, flat_field.left, flat_field.top, flat_field.step, flat_field.camera, flat_field.vignetting
    )
    with darkroom(tile, tmp_path) as room:
        raw = room.raw(0, 20, field)
        compiled, plain = by_both(monkeypatch, lambda: room.develop(raw, field, computed))
    assert plain.images.shape[-1] == 3
    for name in ("images", "lights", "grey", "weights"):
        np.testing.assert_allclose(getattr(compiled, name), getattr(plain, name), rtol=1e-5, atol=1e-6)


def test_a_flat_field_that_is_dark_somewhere_leaves_the_sample_out_in_either_way(
    scene, tmp_path, monkeypatch
):
    tile, field, flat_field = scene
    logarithm = flat_field.logarithm.copy()
    logarithm[1, :, : logarithm.shape[2] // 2] = -40
    dark = type(flat_field)(
        logarithm, flat_field.left, flat_field.top, flat_field.step, flat_field.camera, flat_field.vignetting
    )
    with darkroom(tile, tmp_path) as room:
        raw = room.raw(0, 20, field)
        compiled, plain = by_both(monkeypatch, lambda: room.develop(raw, field, dark))
    assert (plain.weights[1] == 0).any()
    np.testing.assert_array_equal(compiled.weights == 0, plain.weights == 0)
    np.testing.assert_allclose(compiled.images, plain.images, rtol=1e-5, atol=1e-6)


def test_compiled_normal_equations_are_those_of_numpy(scene, tmp_path, monkeypatch):
    tile, field, flat_field = scene
    random = np.random.default_rng(1)
    count = len(field.lamps)
    with darkroom(tile, tmp_path) as room:
        raw = room.raw(50, 54, field)
        raw.saturated[:6, 1, :30] = True
        height = random.normal(0, 0.5, raw.inside.shape).astype(np.float32)
        height[2, :9] = np.nan
        strip = Strip(raw, height, random.normal(size=(count, *height.shape)))

        def sums():
            part = linearise(room, field, flat_field, strip, 0.1, np.full(count, 0.01), np.zeros(count))
            again = part.reweighted(part.surprise, 2.0)
            return again.sums(1.3)

        (matrix, right, pixels), (others, others_right, others_pixels) = by_both(monkeypatch, sums)
    assert pixels == others_pixels == height.size - 30 - 9
    np.testing.assert_allclose(matrix, others, rtol=1e-3, atol=1e-4 * np.abs(others).max())
    np.testing.assert_allclose(right, others_right, rtol=1e-3, atol=1e-4 * np.abs(others_right).max())


def test_the_level_is_the_same_with_and_without_compiled_loops(scene, tmp_path, monkeypatch):
    tile, field, flat_field = scene
    with darkroom(tile, tmp_path) as room:
        height = np.zeros(room.grid.shape, np.float32)
        compiled, plain = by_both(monkeypatch, lambda: find_level(room, field, flat_field, height))
    assert plain.uncertainty is not None
    assert compiled.uncertainty == pytest.approx(plain.uncertainty, rel=1e-4)
    # A thousandth of what is known about it.
    assert compiled.offset == pytest.approx(plain.offset, abs=1e-3 * plain.uncertainty)
    np.testing.assert_allclose(compiled.strengths, plain.strengths, atol=1e-6)


@pytest.mark.parametrize("kernels", ["on", "off"])
def test_what_is_not_known_of_a_height_does_not_keep_its_level_from_being_found(
    scene, tmp_path, monkeypatch, kernels
):
    monkeypatch.setenv(SWITCH, kernels)
    tile, field, flat_field = scene
    with darkroom(tile, tmp_path) as room:
        height = np.zeros(room.grid.shape, np.float32)
        whole = find_level(room, field, flat_field, height)
        height[:, :40] = np.nan
        some = find_level(room, field, flat_field, height)
    assert some.uncertainty is not None
    assert some.offset == pytest.approx(whole.offset, abs=0.05)
