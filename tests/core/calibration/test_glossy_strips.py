"""Gloss is taken out of strips of photographs as numpy takes it out of bands."""

from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from nlights_core import stages
from nlights_core.calibration.record import read_calibration
from nlights_core.configurations import load_stand
from nlights_core.machine.kernel_switch import SWITCH
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.store import Store


@pytest.fixture(scope="module")
def varnished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("varnished")
    simulate(folder / "capture", load_stand("horizontal"), scene="painting", width=160, varnish=True, seed=1)
    store, recipe = Store(folder / "store"), load_recipe("default")
    (tile,) = load_capture(folder / "capture")

    def call(stage, *arguments):
        work = stage(store, *arguments)
        store.ensure(work)
        return work.ref

    lights = call(stages.lights, tile, recipe.light_model)
    flat_field = call(stages.flat_field, tile, recipe.detrend.images, lights)
    calibration = call(stages.calibration, tile, lights, flat_field, recipe.calibration.groups())
    work = stages.normals(store, tile, recipe.normals, lights, flat_field, None, calibration, True)
    return SimpleNamespace(work=work, found=read_calibration(store.path(calibration)))


def images_of(work, folder):
    """What the stage writes into a new folder."""
    folder.mkdir()
    work.make(folder, lambda share: None)
    arrays = {path.stem: np.load(path) for path in folder.glob("*.npy")}
    return arrays | {path.stem: tifffile.imread(path) for path in folder.glob("*.tif")}


def test_strips_and_bands_of_a_varnished_painting_give_the_same(varnished, tmp_path, monkeypatch):
    assert "gloss" in varnished.found.believed
    strips = images_of(varnished.work, tmp_path / "strips")
    monkeypatch.setenv(SWITCH, "off")
    bands = images_of(varnished.work, tmp_path / "bands")
    assert strips.keys() == bands.keys()
    for name, image in strips.items():
        if image.dtype == np.uint8:
            assert np.mean(image != bands[name]) < 1e-3, name
        else:
            np.testing.assert_allclose(image, bands[name], atol=2e-4, err_msg=name)
