"""Photographs with the tone curve of their profile give what linear ones give."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import ImageCms

from nlights_core.manifest import load_capture
from nlights_core.photographs.icc_profiles import linear_profile
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.checking import check_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def encoded_srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def encoded_lightness(light):
    return np.where(light <= 216 / 24389, light * 243.89 / 27, 1.16 * np.cbrt(light) - 0.16)


def profile(curve):
    """The sRGB profile with another curve."""
    start = struct.calcsize(">I")
    plain = bytearray(linear_profile(SRGB, 3))
    # The three curves of a linear profile are one tag at the end, of 12 bytes.
    place = plain.rindex(b"curv")
    assert len(plain) - place == 12
    whole = bytes(plain[:place]) + curve + bytes(-len(curve) % 4)
    whole = struct.pack(">I", len(whole)) + whole[start:]
    return whole.replace(struct.pack(">II", place, 12), struct.pack(">II", place, len(curve)))


def table(decode):
    values = np.round(65535 * decode(np.linspace(0, 1, 4096))).astype(int)
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *values)


def lightness(v):
    return np.where(v <= 0.08, 100 * v * 27 / 24389, ((100 * v + 16) / 116) ** 3)


GAMMA = b"curv" + bytes(4) + struct.pack(">IH", 1, 563)
WAYS = {
    "sRGB": (encoded_srgb, SRGB, ""),
    "gamma 2.2": (lambda light: light ** (256 / 563), profile(GAMMA), "encoding: {transfer: icc}\n"),
    "L*": (encoded_lightness, profile(table(lightness)), ""),
    "L*, stated": (encoded_lightness, None, 'encoding: {transfer: "L*"}\n'),
    "gamma 1.8, stated before a profile": (
        lambda light: light ** (1 / 1.8),
        SRGB,
        "encoding: {transfer: gamma 1.8}\n",
    ),
}


def digitised(capture: Path, out: Path) -> Path:
    tile = load_capture(capture)[0]
    outcome = run_directly(tile, load_recipe("default"), RunOptions(out=out), lambda *_: None)
    assert outcome.state == "done", outcome.message
    return outcome.folder


@pytest.fixture(scope="module")
def linear(painting, tmp_path_factory) -> Path:
    return digitised(painting, tmp_path_factory.mktemp("linear"))


@pytest.mark.parametrize("way", WAYS)
def test_normals_are_those_of_the_linear_capture(painting, linear, tmp_path, way):
    encode, icc, said = WAYS[way]
    capture = Path(shutil.copytree(painting, tmp_path / "capture"))
    for path in (*capture.glob("*.tif"), *capture.glob("flat/*.tif")):
        numbers = np.round(65535 * encode(tifffile.imread(path) / 65535)).astype(np.uint16)
        tifffile.imwrite(path, numbers, photometric="rgb", iccprofile=icc)
    with (capture / "artwork.yaml").open("a") as manifest:
        manifest.write(said)
    made = digitised(capture, tmp_path / "out")
    normals, truth = (tifffile.imread(folder / "normals.tif").astype(float) for folder in (made, linear))
    angles = np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(normals - truth, axis=2) / 2, 0, 1)))
    assert np.nanmean(angles) < 0.02
    albedo, known = (tifffile.imread(folder / "albedo.tif") for folder in (made, linear))
    np.testing.assert_allclose(np.nanmean(albedo), np.nanmean(known), rtol=1e-3)
    with tifffile.TiffFile(made / "albedo.tif") as file:
        assert file.pages.first.iccprofile == (icc and linear_profile(icc, 3))
    finding = check_tile(load_capture(capture)[0], load_recipe("default"), lambda _: None)
    assert finding.problems == []
    assert [warning.code for warning in finding.warnings] == ([] if said else ["profile"])


def test_flats_without_the_profile_of_the_frames_are_refused(capture):
    for path in capture.glob("light_*.tif"):
        tifffile.imwrite(path, tifffile.imread(path), photometric="rgb", iccprofile=SRGB)
    finding = check_tile(load_capture(capture)[0], load_recipe("default"), lambda _: None)
    (problem,) = finding.problems
    assert "tone curve" in problem
    assert "state encoding.transfer for all of them" in problem
