"""Products of calibrated tiles: nearer to the truth than without, and as uncertain as they say."""

import json

import numpy as np
import pytest
import tifffile

from nlights_core.calibration.record import read_calibration
from nlights_core.recipe import load_recipe
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.simulation.evaluation import evaluate


def test_a_varnished_drawing_is_measured_much_better_than_without_a_calibration(
    simulated, without_calibration
):
    """Its highlights are those of Blinn and Phong, which no lobe of a calibration is."""
    capture = simulated("drawing", varnish=True, width=240)
    calibrated, plain = (
        evaluate(capture.products(recipe), capture.folder / "truth")
        for recipe in (load_recipe("default"), without_calibration)
    )
    assert calibrated["angle_mean_deg"] < 0.95 * plain["angle_mean_deg"]
    assert calibrated["height_rms_mm"] < 0.5 * plain["height_rms_mm"]
    assert calibrated["known_share"] > 0.99
    assert calibrated["height_coverage"] > 0.5
    assert 0.6 < calibrated["normals_coverage"] < 0.76


def test_a_varnished_painting_whose_height_is_wrong_is_told(varnished):
    capture, _ = varnished
    maps = capture.products(load_recipe("default"))
    found = evaluate(maps, capture.folder / "truth")
    known = read_calibration(next(capture.store.root.rglob("calibration.json")).parent)
    told = {number.code for number in of_calibration(known, None) if number.warning}
    assert told & {"model-misfit", "two-rings"} or found["height_coverage"] > 0.5


def test_a_level_that_varnish_hides_is_right_or_not_stated(varnished):
    capture, scene = varnished
    capture.products(load_recipe("default"))
    known = read_calibration(next(capture.store.root.rglob("calibration.json")).parent)
    apart = abs(known.shared.level - scene.height.mean())
    assert known.level_uncertainty is None or apart < 2.5 * known.level_uncertainty


def test_satin_paint_is_measured_as_well_as_matt_paint(simulated, satin, matt, without_calibration):
    capture = simulated(paint=satin(0.04, 0.35))
    truth = capture.folder / "truth"
    glossy, plain = (
        evaluate(capture.products(recipe), truth) for recipe in (load_recipe("default"), without_calibration)
    )
    sound = evaluate(matt[0].products(load_recipe("default")), matt[0].folder / "truth")
    assert glossy["angle_mean_deg"] < 1.25 * sound["angle_mean_deg"]
    assert glossy["angle_mean_deg"] < 0.7 * plain["angle_mean_deg"]
    assert glossy["height_rms_mm"] < min(0.03, 0.25 * plain["height_rms_mm"])
    for found in (glossy, sound):
        assert 0.5 < found["height_coverage"] <= 1
        assert 0.62 < found["normals_coverage"] < 0.74


def test_rough_paint_tells_less_of_slopes_and_its_normals_say_so(simulated, rough):
    capture = simulated(paint=rough(0.4))
    found = evaluate(capture.products(load_recipe("default")), capture.folder / "truth")
    assert 0.62 < found["normals_coverage"] < 0.74


def test_a_matt_tile_is_no_worse_for_being_calibrated(matt, without_calibration):
    capture, _ = matt
    calibrated, plain = (
        evaluate(capture.products(recipe), capture.folder / "truth")
        for recipe in (load_recipe("default"), without_calibration)
    )
    assert calibrated["angle_mean_deg"] < 1.03 * plain["angle_mean_deg"]
    assert calibrated["height_rms_mm"] < 0.01


def test_the_height_counts_from_the_plane_of_the_flat(simulated):
    capture = simulated(level=4.0, width=200)
    maps = capture.products(load_recipe("default"))
    found, truth = tifffile.imread(maps / "height.tif"), capture.height
    known = np.isfinite(found)
    # Where lamps' rays meet the flat's plane beside it a pixel may have too few lights left.
    assert known.mean() > 0.95
    assert np.median((found - truth)[known]) == pytest.approx(0, abs=0.1)
    assert (found - truth)[known].std() < 0.03


def test_a_height_is_uncertain_everywhere_where_it_is_known(matt):
    capture, scene = matt
    maps = capture.products(load_recipe("default"))
    stated = tifffile.imread(maps / "height_uncertainty.tif")
    height = tifffile.imread(maps / "height.tif")
    assert (stated.shape, stated.dtype) == (height.shape, np.float32)
    np.testing.assert_array_equal(np.isnan(stated), np.isnan(height))
    assert stated[np.isfinite(stated)].min() > scene.errors.height.min()
    confidence = tifffile.imread(maps / "confidence.tif")
    assert np.isfinite(confidence).mean() > 0.99


def test_without_a_calibration_no_uncertainty_of_the_height_is_stated(matt, without_calibration):
    capture, _ = matt
    assert not (capture.products(without_calibration) / "height_uncertainty.tif").exists()


def test_under_distant_lamps_nothing_is_sought_and_nothing_stated(simulated):
    capture = simulated("plane", width=96)
    record = load_recipe("default").record()
    record["light_model"] = {"use": "measured-poi", "distant": True}
    maps = capture.products(load_recipe({**record, "name": "distant"}))
    assert np.isfinite(tifffile.imread(maps / "height.tif")).all()
    assert not (maps / "height_uncertainty.tif").exists()


def test_the_store_says_what_was_found(varnished):
    capture, scene = varnished
    capture.products(load_recipe("default"))
    record = json.loads(next(capture.store.root.rglob("calibration.json")).read_text(encoding="utf-8"))
    assert record["believed"] == list(scene.found.believed)
    np.testing.assert_allclose(record["values"], scene.found.shared.vector())
