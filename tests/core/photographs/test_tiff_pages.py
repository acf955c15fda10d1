"""Which page of a TIFF is the photograph."""

import numpy as np
import pytest
import tifffile

from nlights_core.photographs.images import Photograph, probe

PICTURE = np.random.default_rng(0).integers(0, 65536, (40, 60, 3)).astype(np.uint16)
SMALL = np.zeros((10, 15, 3), np.uint16)
OTHER = PICTURE[::-1].copy()
MASK = np.zeros((40, 60), bool)


def write(path, *pages, **options):
    with tifffile.TiffWriter(path) as file:
        for values, kind in pages:
            photometric = "rgb" if values.ndim == 3 else "mask"
            file.write(values, photometric=photometric, subfiletype=kind, metadata=None, **options)


def assert_read(path):
    info = probe(path)
    assert (info.rows, info.columns) == (40, 60)
    with Photograph(path) as photograph:
        np.testing.assert_array_equal(
            photograph.band(3, 40), (PICTURE[3:] / np.float64(65535)).astype(np.float32)
        )
    return info.pages


FILES = {
    "a thumbnail first": [(SMALL, 1), (PICTURE, 0)],
    "a thumbnail last": [(PICTURE, 0), (SMALL, 1)],
    "a reduced page as large": [(OTHER, 1), (PICTURE, 0)],
    "a transparency mask first": [(MASK, 4), (PICTURE, 0)],
    "a mask of a thumbnail": [(SMALL, 1), (MASK, 5), (PICTURE, 2)],
    "only reduced": [(SMALL, 1), (PICTURE, 1)],
}


@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib", "rowsperstrip": 8}], ids=["stored", "deflate"]
)
@pytest.mark.parametrize("name", FILES)
def test_reduced_pages_and_masks_are_skipped_without_a_word(tmp_path, name, options):
    write(tmp_path / "a.tif", *FILES[name], **options)
    assert assert_read(tmp_path / "a.tif") == ()


def test_of_several_full_pages_the_first_of_the_largest_is_read_and_told(tmp_path):
    write(tmp_path / "a.tif", (SMALL, 0), (PICTURE, 0), (OTHER, 0))
    pages = assert_read(tmp_path / "a.tif")
    assert pages == ("page 2 (60 x 40 px)", "page 3 (60 x 40 px)", "page 1 (15 x 10 px)")


def test_a_pyramid_within_the_page_does_not_confuse(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(PICTURE, photometric="rgb", subifds=2, tile=(16, 16))
        for step in (2, 4):
            file.write(PICTURE[::step, ::step], photometric="rgb", subfiletype=1, tile=(16, 16))
    assert assert_read(tmp_path / "a.tif") == ()


def test_a_photograph_within_its_thumbnail_is_found(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(SMALL, photometric="rgb", subfiletype=1, subifds=1)
        file.write(PICTURE, photometric="rgb", subfiletype=0)
    assert assert_read(tmp_path / "a.tif") == ()
