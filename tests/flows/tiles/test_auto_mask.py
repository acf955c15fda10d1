"""What is not the artwork is proposed, and left out where the manifest asks for it."""

import json

import numpy as np
import pytest
import tifffile
import yaml

from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.store import Store
from nlights_flows.tiles.checking import check_tile
from nlights_flows.tiles.planning import plan
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

RECIPE = {
    "name": "quick",
    "light_model": "measured-poi",
    "detrend": {"images": "flat-field"},
    "normals": "least-squares",
    "integrator": "simchony",
    "passes": 2,
}


@pytest.fixture
def on_a_table(capture):
    """The painting on a dark table that is seen at the left and below."""
    inside = np.zeros((120, 160), bool)
    inside[:100, 30:] = True
    dark = tifffile.imread(capture / "dark.tif").astype(float)
    for path in capture.glob("light_*.tif"):
        light, flat = tifffile.imread(path), tifffile.imread(capture / "flat" / path.name)
        table = (dark + 0.05 * (flat - dark)).round().astype(np.uint16)
        tifffile.imwrite(path, np.where(inside[..., None], light, table), photometric="rgb")
    return capture, inside


def stating_auto(capture):
    path = capture / "artwork.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "mask": "auto"}))


def run(capture, out):
    outcome = run_directly(
        load_capture(capture)[0], load_recipe(RECIPE), RunOptions(out=out), lambda *_: None
    )
    assert outcome.state == "done", outcome.message
    return outcome


def checked(capture):
    return check_tile(load_capture(capture)[0], load_recipe(RECIPE), lambda share: None)


def test_a_table_is_proposed_and_not_used(on_a_table, tmp_path):
    capture, _ = on_a_table
    finding = checked(capture)
    assert "left (dark), bottom (dark)" in finding.proposal
    assert finding.record()["proposal"] == finding.proposal
    assert (finding.warnings, finding.problems) == ([], [])
    folder = run(capture, tmp_path).folder
    assert np.isfinite(tifffile.imread(folder / "height.tif")).mean() > 0.99
    page = (folder / "report.html").read_text()
    assert "seem to be something other than the artwork" in page
    assert "The artwork&#39;s border" in page


def test_auto_leaves_the_table_out_and_is_kept(on_a_table, tmp_path):
    capture, inside = on_a_table
    stating_auto(capture)
    assert (checked(capture).problems, checked(capture).proposal) == ([], "")
    outcome = run(capture, tmp_path)
    known = np.isfinite(tifffile.imread(outcome.folder / "height.tif"))
    assert not known[~inside].any()
    assert known[inside].mean() > 0.9
    page = (outcome.folder / "report.html").read_text()
    assert "left out (mask: auto)" in page
    numbers = {n["name"]: n["value"] for n in json.loads((outcome.folder / "quality.json").read_text())}
    assert numbers["Known share"] > 99
    assert run_again(capture, tmp_path) == "unchanged"


def run_again(capture, out):
    return run_directly(
        load_capture(capture)[0], load_recipe(RECIPE), RunOptions(out=out), lambda *_: None
    ).state


def test_auto_takes_all_of_an_artwork_that_fills_the_field(capture, tmp_path):
    assert checked(capture).proposal == ""
    stating_auto(capture)
    folder = run(capture, tmp_path).folder
    assert np.isfinite(tifffile.imread(folder / "height.tif")).mean() > 0.99
    assert "artwork&#39;s border" not in (folder / "report.html").read_text()


def test_a_plan_names_the_mask_first_and_the_manifest_may_leave_it_to_one_tile(two_tiles, tmp_path):
    path = two_tiles / "artwork.yaml"
    path.write_text(path.read_text().replace("{name: a}", "{name: a, mask: auto}"))
    tiles = load_capture(two_tiles)
    assert [tile.auto_mask for tile in tiles] == [True, False]
    steps = [[step.ref.stage for step in plan(tile, load_recipe(RECIPE), Store(tmp_path))] for tile in tiles]
    assert "mask" in steps[0]
    assert "mask" not in steps[1]


def test_a_photograph_that_cannot_be_read_is_one_problem(on_a_table):
    capture, _ = on_a_table
    stating_auto(capture)
    path = capture / "light_3.tif"
    path.write_bytes(path.read_bytes()[:60000])
    problems = checked(capture).problems
    assert len(problems) == 1
    assert "light_3.tif" in problems[0]
