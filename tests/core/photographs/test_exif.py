"""What cameras note about exposures."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from nlights_core.photographs.exif import ExposureNote, read_exposure

RAW = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "raw" / "canon_eos_6d.dng"
DETAILS = {0x829A: IFDRational(1, 50), 0x829D: IFDRational(28, 10), 0x8827: 100}
PICTURE = Image.fromarray(np.zeros((8, 8, 3), np.uint8))


def save(path):
    if path.suffix == ".tif":
        tags = ImageFileDirectory_v2()
        tags[0x8769] = DETAILS
        PICTURE.save(path, tiffinfo=tags)
    else:
        exif = Image.Exif()
        exif.get_ifd(0x8769).update(DETAILS)
        PICTURE.save(path, exif=exif.tobytes())


@pytest.mark.parametrize("name", ["a.tif", "a.jpg", "a.png"])
def test_exposures_of_common_files(tmp_path, name):
    save(tmp_path / name)
    assert read_exposure(tmp_path / name) == ExposureNote(0.02, 2.8, 100)
    assert str(read_exposure(tmp_path / name)) == "1/50 s, f/2.8, ISO 100"


@pytest.mark.skipif(not RAW.exists(), reason="the real captures are not beside the repository")
def test_exposure_of_a_raw_file():
    assert str(read_exposure(RAW)) == "1/60 s, f/5.6, ISO 1000"


def test_files_that_note_nothing(tmp_path):
    tifffile.imwrite(tmp_path / "plain.tif", np.zeros((8, 8, 3), np.uint16), photometric="rgb")
    PICTURE.save(tmp_path / "plain.bmp")
    (tmp_path / "empty.tif").write_bytes(b"")
    for name in ("plain.tif", "plain.bmp", "empty.tif"):
        assert read_exposure(tmp_path / name) == ExposureNote()
    assert str(ExposureNote()) == "nothing noted"


@pytest.mark.parametrize("name", ["a.tif", "a.jpg", "a.png"])
def test_a_damaged_note_is_no_note(tmp_path, name):
    save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    for length in range(0, len(whole), 7):
        (tmp_path / name).write_bytes(whole[:length])
        assert isinstance(read_exposure(tmp_path / name), ExposureNote)


def test_zero_and_endless_numbers_are_not_noted(tmp_path):
    tags = [(33434, 5, 1, (0, 0), True), (33437, 5, 1, (0, 1), True), (34855, 3, 1, 200, True)]
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((8, 8), np.uint8), photometric="minisblack", extratags=tags)
    assert read_exposure(tmp_path / "a.tif") == ExposureNote(iso=200)


def test_factors_count_what_both_note():
    usual = ExposureNote(0.02, 8, 100)
    assert ExposureNote(0.04, 8, 100).brighter_than(usual) == pytest.approx(2)
    assert ExposureNote(0.02, 4, 100).brighter_than(usual) == pytest.approx(4)
    assert ExposureNote(0.02, 8, 400).brighter_than(usual) == pytest.approx(4)
    assert ExposureNote(0.02).brighter_than(usual) == pytest.approx(1)
    assert ExposureNote().brighter_than(usual) == pytest.approx(1)
