"""Evaluation: errors of known size are measured as such."""

import math

import numpy as np
import pytest
import tifffile

from nlights_core.errors import CaptureError, TileError
from nlights_core.simulation.evaluation import angles_between, evaluate


def write(folder, normals, height):
    folder.mkdir()
    tifffile.imwrite(folder / "normals.tif", normals, photometric="rgb")
    tifffile.imwrite(folder / "height.tif", height)
    return folder


def upright(tilt_deg=0.0):
    normals = np.zeros((6, 8, 3), np.float32)
    normals[..., 0], normals[..., 2] = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    return normals


@pytest.fixture
def truth(tmp_path):
    return write(tmp_path / "truth", upright(), np.zeros((6, 8), np.float32))


def test_the_truth_has_no_error(truth):
    found = evaluate(truth, truth)
    coverages = found.pop("normals_coverage"), found.pop("height_coverage")
    assert found == {
        "angle_mean_deg": 0,
        "angle_median_deg": 0,
        "angle_p95_deg": 0,
        "height_rms_mm": 0,
        "height_max_mm": 0,
        "known_share": 1,
    }
    assert np.isnan(coverages).all()  # the folder states no uncertainty


def test_a_tilt_of_all_normals_is_measured(tmp_path, truth):
    found = evaluate(write(tmp_path / "out", upright(0.5), np.zeros((6, 8), np.float32)), truth)
    for name in ("angle_mean_deg", "angle_median_deg", "angle_p95_deg"):
        assert found[name] == pytest.approx(0.5, rel=1e-5)


def test_mean_median_and_95th_percentile_are_told_apart(tmp_path, truth):
    normals = upright()
    normals[0, :6] = upright(8.0)[0, :6]
    found = evaluate(write(tmp_path / "out", normals, np.zeros((6, 8), np.float32)), truth)
    assert found["angle_mean_deg"] == pytest.approx(1.0, rel=1e-5)
    assert found["angle_median_deg"] == 0
    assert found["angle_p95_deg"] == pytest.approx(8.0, rel=1e-5)


def test_a_constant_height_is_free_but_a_tilt_is_an_error(tmp_path, truth):
    level = np.full((6, 8), 7.0, np.float32)
    assert evaluate(write(tmp_path / "level", upright(), level), truth)["height_max_mm"] == 0
    tilted = level + np.arange(8, dtype=np.float32)
    found = evaluate(write(tmp_path / "tilted", upright(), tilted), truth)
    assert found["height_max_mm"] == pytest.approx(3.5)
    assert found["height_rms_mm"] == pytest.approx(math.sqrt((8**2 - 1) / 12))


def test_unknown_pixels_count_only_in_the_known_share(tmp_path, truth):
    normals, height = upright(), np.zeros((6, 8), np.float32)
    normals[0], height[:, 0] = np.nan, np.nan
    found = evaluate(write(tmp_path / "out", normals, height), truth)
    assert found["known_share"] == pytest.approx(35 / 48)
    assert found["angle_mean_deg"] == 0


def test_products_that_know_nothing_have_no_error_to_state(tmp_path, truth):
    found = evaluate(write(tmp_path / "out", upright() * np.nan, np.zeros((6, 8), np.float32)), truth)
    assert found["known_share"] == 0
    assert math.isnan(found["angle_mean_deg"])


def test_coverage_is_the_share_of_errors_within_their_own_uncertainty(tmp_path, truth):
    normals, height = upright(0.5), np.zeros((6, 8), np.float32)
    height[:3], height[3:] = 7.1, 6.9  # 0.1 mm off after the best constant, which is free
    out = write(tmp_path / "out", normals, height)
    stated = np.full((6, 8), 0.6, np.float32)
    stated[0] = 0.4
    tifffile.imwrite(out / "confidence.tif", stated)
    tifffile.imwrite(out / "height_uncertainty.tif", np.where(stated < 0.5, 0.2, 0.05).astype(np.float32))
    found = evaluate(out, truth)
    assert found["normals_coverage"] == pytest.approx(40 / 48)
    assert found["height_coverage"] == pytest.approx(8 / 48)


def test_a_right_uncertainty_covers_68_percent_and_half_of_it_38(tmp_path, truth):
    shape, random = (400, 400), np.random.default_rng(3)
    wide = write(
        tmp_path / "wide", np.broadcast_to([0, 0, 1], (*shape, 3)).astype(np.float32), np.zeros(shape)
    )
    sigma = random.uniform(0.01, 0.3, shape)
    out = write(
        tmp_path / "out", tifffile.imread(wide / "normals.tif"), 5 + sigma * random.normal(size=shape)
    )
    for factor, share in ((1, 0.683), (0.5, 0.383)):
        tifffile.imwrite(out / "height_uncertainty.tif", (factor * sigma).astype(np.float32))
        assert evaluate(out, wide)["height_coverage"] == pytest.approx(share, abs=0.005)


def test_pixels_without_a_stated_uncertainty_or_without_a_height_have_no_coverage(tmp_path, truth):
    height = np.zeros((6, 8), np.float32)
    height[:, 0] = np.nan
    out = write(tmp_path / "out", upright(0.5), height)
    stated = np.full((6, 8), 0.4, np.float32)
    stated[:, 1:3], stated[:, 0] = 0.6, 0.6  # the first column's height is not known, so it does not count
    stated[:, 3:6] = np.nan
    tifffile.imwrite(out / "confidence.tif", stated)
    tifffile.imwrite(out / "height_uncertainty.tif", np.full((6, 8), np.nan, np.float32))
    found = evaluate(out, truth)
    assert found["normals_coverage"] == pytest.approx(2 / 4)
    assert math.isnan(found["height_coverage"])


def test_an_uncertainty_of_another_size_is_refused(tmp_path, truth):
    for name in ("confidence.tif", "height_uncertainty.tif"):
        out = write(tmp_path / name, upright(), np.zeros((6, 8), np.float32))
        tifffile.imwrite(out / name, np.ones((3, 4), np.float32))
        with pytest.raises(TileError, match=rf"{name}: has the size \(3, 4\).*\(6, 8\)"):
            evaluate(out, truth)
        (out / name).write_text("no image")
        with pytest.raises(TileError, match=r"is no readable TIFF"):
            evaluate(out, truth)


def test_faults_name_the_file_and_the_sizes(tmp_path, truth):
    small = write(tmp_path / "small", upright()[:4], np.zeros((4, 8), np.float32))
    with pytest.raises(TileError, match=r"normals\.tif: has the size \(4, 8, 3\).*\(6, 8, 3\)"):
        evaluate(small, truth)
    (small / "height.tif").unlink()
    with pytest.raises(TileError, match=r"small/height\.tif: is missing"):
        evaluate(small, truth)
    with pytest.raises(CaptureError, match=r"nowhere/normals\.tif: is missing"):
        evaluate(truth, tmp_path / "nowhere")
    (truth / "height.tif").write_text("no image")
    with pytest.raises(CaptureError, match=r"height\.tif: is no readable TIFF"):
        evaluate(write(tmp_path / "out", upright(), np.zeros((6, 8), np.float32)), truth)


def test_tiny_angles_survive_float32():
    tilted = np.array([np.float32(1e-5), 0, 1], np.float32)
    assert angles_between(tilted, np.array([0, 0, 1])) == pytest.approx(np.degrees(1e-5), rel=1e-6)
