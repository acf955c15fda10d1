"""What photographs say of themselves is told, with how it is taken."""

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from nlights_core.agreement.file_headers import header_warnings
from nlights_core.capture import Encoding, Tile

LAMPS = ("L1", "L2", "L3", "L4")
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def capture(folder, suffix="tif", flats=False, dark=False, profile=None, **encoding) -> Tile:
    def photograph(name):
        path = folder / f"{name}.{suffix}"
        Image.fromarray(np.zeros((40, 60, 3), np.uint8)).save(path, icc_profile=profile)
        return path

    return Tile(
        artwork="a",
        name="t",
        frames={lamp: photograph(lamp) for lamp in LAMPS},
        flats={lamp: photograph(f"flat {lamp}") for lamp in LAMPS} if flats else None,
        dark=photograph("dark") if dark else None,
        encoding=Encoding(**encoding),
    )


def pages_of(path, *values):
    with tifffile.TiffWriter(path) as file:
        for value in values:
            file.write(np.full((40, 60, 3), value, np.uint8), photometric="rgb")


def test_files_that_say_nothing_are_not_told(tmp_path):
    assert header_warnings(capture(tmp_path, flats=True, dark=True)) == []


@pytest.mark.parametrize(
    ("names", "lamps"),
    [(("L2", "L3"), ("L2", "L3")), (("flat L4",), ("L4",)), (("dark",), ())],
    ids=["frames", "a flat", "the dark frame"],
)
def test_a_file_of_several_pages_is_told_with_the_one_that_is_read(tmp_path, names, lamps):
    tile = capture(tmp_path, flats=True, dark=True)
    for name in names:
        pages_of(tmp_path / f"{name}.tif", 1, 2)
    (warning,) = header_warnings(tile)
    assert (warning.code, warning.lamps, warning.value) == ("pages", lamps, 2)
    more = " and 1 more" if len(names) > 1 else ""
    assert (
        f"{names[0]}.tif{more}: holds 2 full pages, of which page 1 (60 x 40 px) is read" in warning.sentence
    )
    assert "not read: page 2 (60 x 40 px)" in warning.sentence


@pytest.mark.parametrize("suffix", ["tif", "png", "jpg"])
def test_a_profile_whose_curve_is_undone_is_told_unless_the_manifest_says_so(tmp_path, suffix):
    (warning,) = header_warnings(capture(tmp_path, suffix, profile=SRGB))
    assert warning.code == "profile"
    assert "sRGB" in warning.sentence
    assert "{transfer: icc}" in warning.sentence
    for transfer in ("icc", "linear", "srgb"):
        assert header_warnings(capture(tmp_path, suffix, profile=SRGB, transfer=transfer)) == []


def test_a_jpeg_without_a_profile_is_told_unless_the_manifest_says_what_it_means(tmp_path):
    (warning,) = header_warnings(capture(tmp_path, "jpg"))
    assert (warning.code, warning.lamps) == ("jpeg", ())
    assert "L1.jpg: a JPEG without a profile is taken as linear light" in warning.sentence
    assert header_warnings(capture(tmp_path, "jpg", transfer="linear")) == []
