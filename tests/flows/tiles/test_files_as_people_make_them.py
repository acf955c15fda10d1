"""Masks, thumbnails, ranges and pipes in a whole capture, as `check` and `digitise` meet them."""

import json
import os

import numpy as np
import pytest
import tifffile
from PIL import Image

from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.checking import check_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly


def checked(capture):
    return check_tile(load_capture(capture)[0], load_recipe("default"), lambda _: None)


def photographs(capture):
    return [*capture.glob("*.tif"), *capture.glob("flat/*.tif")]


@pytest.fixture
def disc(capture):
    """A round mask over a part of the capture, and the capture's manifest to be completed with its name."""
    rows, columns = tifffile.imread(capture / "dark.tif").shape[:2]
    y, x = np.mgrid[:rows, :columns]
    return (x - columns / 2) ** 2 + (y - rows / 2) ** 2 < (rows / 3) ** 2


@pytest.mark.parametrize("name", ["mask.jpg", "bits.tif", "cut out.png"])
def test_what_is_inside_is_known_and_counted(capture, disc, tmp_path, name):
    white = np.where(disc, 255, 0).astype(np.uint8)
    if name == "mask.jpg":
        Image.fromarray(white).save(capture / name, quality=75)
    elif name == "bits.tif":
        Image.fromarray(disc).save(capture / name, compression="group4")
    else:
        Image.fromarray(np.dstack([np.full_like(white, 90), white])).save(capture / name)
    with (capture / "artwork.yaml").open("a") as manifest:
        manifest.write(f"mask: {name}\n")
    tile = load_capture(capture)[0]
    outcome = run_directly(tile, load_recipe("default"), RunOptions(out=tmp_path / "out"), lambda *_: None)
    assert outcome.state == "done", outcome.message
    known = np.isfinite(tifffile.imread(outcome.folder / "normals.tif")[..., 2])
    assert np.mean(known != disc) < 0.005
    numbers = {row["name"]: row["value"] for row in json.loads((outcome.folder / "quality.json").read_text())}
    assert numbers["Known share"] > 99
    assert numbers["Lights used, mean"] > 6


def test_thumbnails_are_passed_over_and_second_pages_told(capture):
    for path in photographs(capture):
        values = tifffile.imread(path)
        with tifffile.TiffWriter(path) as file:
            file.write(values[::4, ::4], photometric="rgb", subfiletype=1)
            file.write(values, photometric="rgb")
            if path.name == "light_2.tif" and path.parent == capture:
                file.write(values[::-1], photometric="rgb")
    finding = checked(capture)
    assert finding.problems == []
    assert finding.size.startswith("160 x ")
    (warning,) = [one for one in finding.warnings if one.code == "pages"]
    assert warning.lamps == (load_capture(capture)[0].lamps[1],)
    assert "page 2" in warning.sentence


def test_twelve_bits_are_told_by_check(capture):
    for path in photographs(capture):
        values = tifffile.imread(path)
        brighter = 3 if path.parent == capture else 1
        tifffile.imwrite(path, np.minimum(values // 16 * brighter, 4095).astype(np.uint16), photometric="rgb")
    finding = checked(capture)
    assert finding.problems == []
    told = [one for one in finding.warnings if one.code == "range"]
    assert told
    assert all("4095" in one.sentence for one in told)


def test_a_sound_capture_is_not_warned_of(capture):
    finding = checked(capture)
    assert (finding.problems, finding.warnings) == ([], [])


@pytest.mark.skipif(os.name == "nt", reason="has no named pipes")
@pytest.mark.parametrize("name", ["light_3.tif", "flat/light_1.tif", "dark.tif", "artwork.yaml"])
def test_a_pipe_is_refused_at_once(capture, tmp_path, name):
    tile = load_capture(capture)[0]
    (capture / name).unlink()
    os.mkfifo(capture / name)
    if name == "artwork.yaml":
        with pytest.raises(Exception, match=r"artwork\.yaml: a named pipe, where a file is expected"):
            load_capture(capture)
        return
    finding = check_tile(tile, load_recipe("default"), lambda _: None)
    outcome = run_directly(tile, load_recipe("default"), RunOptions(out=tmp_path / "out"), lambda *_: None)
    assert outcome.state == "failed"
    for said in (*finding.problems, outcome.message):
        assert "a named pipe, where a" in said
    assert finding.problems
