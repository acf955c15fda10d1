"""Warnings: what a capture's own photographs say against the files that describe it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.configurations import load_stand
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.simulation.evaluation import evaluate
from nlights_flows.tiles.console import warnings_of
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Outcome, run_directly


@pytest.fixture(scope="module")
def drawing(tmp_path_factory) -> Path:
    """Photographed on the vertical stand with its darkening fabric."""
    folder = tmp_path_factory.mktemp("captures") / "drawing"
    simulate(folder, load_stand("vertical-dark"), scene="drawing", width=240, seed=5)
    return folder


def digitised(capture: Path, stand: str, recipe: str, place: Path) -> Outcome:
    tile = load_capture(capture, stand=stand)[0]
    outcome = run_directly(tile, load_recipe(recipe), RunOptions(out=place / "out"), lambda *_: None)
    assert outcome.state == "done", outcome.message
    return outcome


def numbers(outcome: Outcome) -> dict[str, float | None]:
    assert outcome.folder is not None
    return {row["name"]: row["value"] for row in json.loads((outcome.folder / "quality.json").read_text())}


def test_the_right_stand_file_is_not_doubted(drawing, tmp_path):
    outcome = digitised(drawing, "vertical-dark", "default", tmp_path)
    assert warnings_of(outcome) == []
    assert numbers(outcome)["Flat fit, rms"] < 60


def test_the_stand_as_it_was_before_the_fabric_is_doubted(drawing, tmp_path):
    outcome = digitised(drawing, "vertical-open", "default", tmp_path)
    (warning,) = warnings_of(outcome)
    assert "do not fit the stand 'vertical-open'" in warning
    assert "measure its points of interest again" in warning
    assert warning in (outcome.folder / "report.html").read_text().replace("&#39;", "'")
    # The flats that were photographed with the same lamps make the shift of up to 19 mm harmless.
    assert evaluate(outcome.folder, drawing / "truth")["height_rms_mm"] < 0.05


def test_without_flats_the_flat_is_not_in_this_recipe(drawing, tmp_path):
    recipe = tmp_path / "computed.yaml"
    recipe.write_text(
        "light_model: {use: measured-poi, emission: true}\ndetrend: {images: inverse-square}\n"
        "normals: robust\nintegrator: simchony\n"
    )
    outcome = digitised(drawing, "vertical-dark", str(recipe), tmp_path)
    rows = json.loads((outcome.folder / "quality.json").read_text())
    (row,) = [row for row in rows if row["name"] == "Flat fit, rms"]
    assert row["value"] is None
    assert row["missing"] == "not in this recipe"


def test_lamps_that_are_not_as_stated_are_calibrated_on_the_artwork(drawing, tmp_path):
    errors = {}
    for refine in (False, True):
        recipe = tmp_path / "recipe.yaml"
        recipe.write_text(
            f"light_model: {{use: measured-poi, emission: true, refine: {str(refine).lower()}}}\n"
            "detrend: {images: inverse-square}\nnormals: robust\nintegrator: simchony\n"
        )
        outcome = digitised(drawing, "vertical-dark", str(recipe), tmp_path)
        errors[refine] = evaluate(outcome.folder, drawing / "truth")
    assert errors[True]["angle_mean_deg"] < 0.6 * errors[False]["angle_mean_deg"]
    assert errors[True]["height_rms_mm"] < 0.6 * errors[False]["height_rms_mm"]


def test_light_of_the_room_is_no_reason_to_measure_the_stand_again(drawing, tmp_path):
    """Light that the dark frame lacks, in photographs and flats alike: it makes flats unlike the stand's lamps."""
    capture = tmp_path / "capture"
    shutil.copytree(drawing, capture)
    for path in [*capture.glob("light_*.tif"), *(capture / "flat").glob("*.tif")]:
        image = tifffile.imread(path).astype(np.int64) + 900
        tifffile.imwrite(path, np.minimum(image, 65535).astype(np.uint16), photometric="rgb")
    outcome = digitised(capture, "vertical-dark", "default", tmp_path)
    codes = [row["code"] for row in json.loads((outcome.folder / "warnings.json").read_text())]
    assert "additive-light" in codes
    assert "stand" not in codes
    assert numbers(outcome)["Doubt of the stand's file"] > 9.5
    assert "points of interest again" not in (outcome.folder / "report.html").read_text()
