"""The weekly look at the flat: figures against analytic truth, lamps that change, limits."""

import json
import shutil

import numpy as np
import pytest
import tifffile
import yaml

from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_flows.nights.flat_check import check_flat, flatness, last_check, levels

LIMITS = {"height_range_mm": 1.0, "normals_rms_deg": 0.5, "level_percent": 5.0}


def test_a_bowl_has_the_rms_and_the_range_that_its_equation_gives():
    # z = a (x^2 - 1/3) on [-1, 1] has no plane in it, an rms of a sqrt(4/45), and a range of a.
    columns = np.linspace(-1, 1, 4001)
    height = np.tile(0.6 * columns**2, (30, 1)) + 5.0 + 0.01 * np.arange(30)[:, None]
    found = flatness(height, np.broadcast_to([0.0, 0.0, 1.0], (30, 4001, 3)))
    assert found["height_rms_mm"] == pytest.approx(0.6 * np.sqrt(4 / 45), rel=0.01)
    assert found["height_range_mm"] == pytest.approx(0.6, rel=0.02)


def test_normals_that_all_lean_by_an_angle_are_scattered_by_that_angle():
    # Round a cone of half angle t about a tilted axis, the mean is the axis.
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    t = np.radians(0.7)
    cone = np.stack([np.sin(t) * np.cos(turn), np.sin(t) * np.sin(turn), np.full(400, np.cos(t))], axis=-1)
    tilt = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    found = flatness(np.zeros((20, 20)), (cone @ tilt.T).reshape(20, 20, 3))
    assert found["normals_rms_deg"] == pytest.approx(0.7, abs=1e-6)


def test_what_is_not_known_does_not_count_and_nothing_known_is_not_flat():
    height, normals = np.full((10, 10), np.nan), np.full((10, 10, 3), np.nan)
    assert np.isnan(flatness(height, normals)["height_range_mm"])
    height[:5], normals[:5] = 1.0, (0, 0, 1)
    assert flatness(height, normals)["height_range_mm"] == pytest.approx(0, abs=1e-9)


@pytest.fixture
def tile(capture):
    """A capture whose artwork is the flat: its flats photographed again, the third lamp 10 % weaker."""
    manifest = yaml.safe_load((capture / "artwork.yaml").read_text())
    for n in range(1, 9):
        shutil.copy(capture / "flat" / f"light_{n}.tif", capture / f"light_{n}.tif")
    path = capture / "light_3.tif"
    dark = tifffile.imread(capture / "dark.tif").astype(float)
    weaker = dark + 0.9 * (tifffile.imread(path) - dark)
    tifffile.imwrite(path, np.round(weaker).astype(np.uint16))
    (capture / "artwork.yaml").write_text(yaml.safe_dump(manifest))
    return load_capture(capture)[0]


def products(folder, height):
    folder.mkdir()
    tifffile.imwrite(folder / "height.tif", height.astype(np.float32))
    normals = np.zeros((*height.shape, 3), np.float32)
    normals[..., 2] = 1
    tifffile.imwrite(folder / "normals.tif", normals, photometric="minisblack", planarconfig="contig")
    return folder


def test_a_lamp_that_became_weaker_is_named_and_only_that_one(tile, tmp_path):
    record = check_flat(tile, products(tmp_path / "p", np.zeros((30, 40))), None, LIMITS)
    lamp = list(tile.frames)[2]
    assert record["changes_percent"]["the flats"][lamp] == pytest.approx(-10, abs=0.3)
    assert [fault.split()[0] for fault in record["faults"]] == [lamp]
    assert lamp in record["sentence"]
    # Against a check with the lamps as they are now, nothing changed; the flats stay wrong.
    again = check_flat(tile, tmp_path / "p", record, LIMITS)
    assert max(map(abs, again["changes_percent"]["the last check"].values())) < 1e-9


def test_a_bent_flat_fails_and_a_plane_one_says_so_with_its_figures(tile, tmp_path):
    flats_only = tile.model_copy(update={"frames": tile.flats})
    bent = np.tile(np.linspace(-1, 1, 400) ** 2 * 1.3, (40, 1))
    record = check_flat(flats_only, products(tmp_path / "bent", bent), None, LIMITS)
    assert len(record["faults"]) == 1
    assert "the height ranges over 1.3 mm" in record["sentence"].replace("1.29", "1.3")
    assert "at most 1 mm" in record["sentence"]
    record = check_flat(flats_only, products(tmp_path / "flat", 0 * bent), None, LIMITS)
    assert record["faults"] == []
    assert "came out flat: height 0 mm rms" in record["sentence"]


def test_the_last_check_is_the_newest_of_this_flat(tile, tmp_path):
    assert last_check(tmp_path / "none", tile) is None
    for name, artwork, time in (
        ("a", tile.artwork, "2026-03-02T08:00:00+01:00"),
        ("b", tile.artwork, "2026-03-02T07:30:00+00:00"),  # half an hour later, by the clock of the world
        ("c", "another", "2027-01-01T00:00:00+00:00"),
    ):
        record = {"artwork": artwork, "tile": tile.name, "time": time, "levels": {name: 1.0}}
        (tmp_path / f"{name}.json").write_text(json.dumps(record))
    assert last_check(tmp_path, tile)["levels"] == {"b": 1.0}
    (tmp_path / "d.json").write_text("{")
    with pytest.raises(CaptureError, match=r"d\.json: is no record of a check of the flat"):
        last_check(tmp_path, tile)


def test_levels_are_shares_of_saturation_without_the_dark(tile):
    flat = next(iter(tile.flats.values()))
    dark = np.median(tifffile.imread(tile.dark)) / 65535
    expected = np.median(tifffile.imread(flat)) / 65535 - dark
    assert next(iter(levels(tile.flats, tile).values())) == pytest.approx(expected, rel=0.05)
