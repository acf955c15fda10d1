"""A tile is tied to heights that somebody measured: from the manifest to the products, and told before it begins."""

import json

import numpy as np
import pytest
import tifffile
import yaml

from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.checking import check_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

RECIPE = {
    "name": "tied",
    "light_model": "measured-poi",
    "detrend": {"images": "flat-field", "height": "known-heights"},
    "normals": "least-squares",
    "integrator": "simchony",
}


@pytest.fixture
def probed(capture):
    """The capture with the true heights of 30 points, and a lamp that lost a tenth of its light since the flats."""
    truth = tifffile.imread(capture / "truth" / "height.tif")
    stand = load_capture(capture)[0].stand
    size = stand.field_mm[0] / truth.shape[1]
    rows, columns = (
        at.ravel()
        for at in np.meshgrid(np.linspace(4, 115, 5).round(), np.linspace(4, 155, 6).round(), indexing="ij")
    )
    z = truth[rows.astype(int), columns.astype(int)] + np.random.default_rng(3).normal(0, 0.02, 30) + 41.0
    x, y = (columns - (truth.shape[1] - 1) / 2) * size, ((truth.shape[0] - 1) / 2 - rows) * size
    lines = [f"{a},{b},{c}" for a, b, c in zip(x, y, z, strict=True)]
    (capture / "probe.csv").write_text("\n".join(["x_mm,y_mm,z_mm", *lines, "9999,0,0"]) + "\n")
    dimmed = capture / "light_1.tif"
    tifffile.imwrite(dimmed, (tifffile.imread(dimmed) * 0.9).astype(np.uint16), photometric="rgb")
    path = capture / "artwork.yaml"
    stated = yaml.safe_load(path.read_text())
    stated["known_heights"] = {"file": "probe.csv", "sigma_mm": 0.02, "registration_mm": 0.5}
    path.write_text(yaml.safe_dump(stated))
    return capture, truth


def digitised(capture, recipe, out):
    outcome = run_directly(
        load_capture(capture)[0], load_recipe(recipe), RunOptions(out=out), lambda *_: None
    )
    assert outcome.state == "done", outcome.message
    return outcome.folder


def error(folder, truth):
    off = tifffile.imread(folder / "height.tif") - truth
    return float(np.nanstd(off))


def test_a_bowed_measurement_is_tied_to_the_probe_and_says_so(probed, tmp_path):
    capture, truth = probed
    loose = {**RECIPE, "detrend": {"images": "flat-field"}}
    before = error(digitised(capture, loose, tmp_path / "loose"), truth)
    folder = digitised(capture, RECIPE, tmp_path / "tied")
    after = error(folder, truth)
    assert before > 0.3
    assert after < before / 5
    trend, height = (tifffile.imread(folder / f"{name}.tif") for name in ("trend", "height"))
    assert (
        np.nanstd(
            trend + height - tifffile.imread(tmp_path / "loose" / folder.parent.name / "r0c0" / "height.tif")
        )
        < 1e-3
    )
    numbers = {number["name"]: number for number in json.loads((folder / "quality.json").read_text())}
    assert numbers["Points within the field"]["value"] == 30
    assert "probe.csv, of 31" in numbers["Points within the field"]["meaning"]
    assert (
        numbers["Difference of the tied height, typical"]["value"]
        < numbers["Difference of the photographed height, typical"]["value"] / 3
    )
    assert len((folder / "known_heights.csv").read_text().splitlines()) == 32
    assert "Known heights" in (folder / "report.html").read_text()
    codes = [warning["code"] for warning in json.loads((folder / "warnings.json").read_text())]
    assert "known-heights-outside" in codes
    stages = json.loads((folder / "provenance.json").read_text())["stages"]
    tied = next(stage for stage in stages if stage["stage"] == "trend")
    assert tied["facts"]["known_heights"]["name"] == "probe.csv"


def test_another_file_or_another_sigma_is_another_result(probed, tmp_path):
    capture, _ = probed
    first = (digitised(capture, RECIPE, tmp_path) / "trend.tif").read_bytes()
    path = capture / "artwork.yaml"
    path.write_text(path.read_text().replace("sigma_mm: 0.02", "sigma_mm: 3"))
    assert (digitised(capture, RECIPE, tmp_path) / "trend.tif").read_bytes() != first


def test_a_check_says_what_is_wrong_with_the_file_and_where_there_is_none(probed):
    capture, _ = probed
    (capture / "probe.csv").write_text("x_mm,y_mm,z_mm\n1,2,three\n")

    def problems(recipe):
        return check_tile(load_capture(capture)[0], load_recipe(recipe), lambda share: None).problems

    assert ["probe.csv:2:" in problem and "'three'" in problem for problem in problems(RECIPE)] == [True]
    assert problems("no-flats") == []
    path = capture / "artwork.yaml"
    stated = yaml.safe_load(path.read_text())
    del stated["known_heights"]
    path.write_text(yaml.safe_dump(stated))
    assert "known_heights: is missing" in problems(RECIPE)[0]
