"""Camera raw files that hold no picture, or one that is not read."""

import numpy as np
import pytest
import tifffile

from nlights_core.errors import TileError
from nlights_core.photographs.images import Photograph, probe

MOSAIC = np.random.default_rng(0).integers(256, 16383, (400, 600)).astype(np.uint16)


def write_dng(path, mosaic=MOSAIC, **more):
    """A DNG of bare numbers behind an RGGB filter."""
    tags = [
        (50706, 1, 4, (1, 4, 0, 0), True),
        (50708, 2, 0, "Test Camera", True),
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, (0, 1, 1, 2), True),
        (50714, 3, 1, 256, True),
        (50717, 3, 1, 16383, True),
        (50721, 10, 9, tuple(v for x in (1, 0, 0, 0, 1, 0, 0, 0, 1) for v in (x, 1)), True),
        (50728, 5, 3, (1, 1, 1, 1, 1, 1), True),
        (50778, 3, 1, 21, True),
        (271, 2, 0, "Test", True),
        (272, 2, 0, "Camera", True),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None, **more)


@pytest.mark.parametrize("name", ["a.dng", "a.nef", "a.rw2", "a.cr3"])
def test_a_header_alone_is_refused_with_the_bytes_that_it_needs(tmp_path, name):
    write_dng(tmp_path / "whole.dng")
    whole = (tmp_path / "whole.dng").read_bytes()
    (tmp_path / name).write_bytes(whole)
    with Photograph(tmp_path / name) as photograph:  # LibRaw knows it by its content
        assert photograph.band(0, 400).mean() == pytest.approx(0.5, abs=0.1)
    (tmp_path / name).write_bytes(whole[:600])
    with pytest.raises(
        TileError, match=rf"{name}: its header says 0\.2 million pixels, but the file has 600 bytes"
    ):
        probe(tmp_path / name)


@pytest.mark.parametrize("compression", ["zlib", "lzw", "zstd", "jpegxl"])
def test_a_dng_whose_compression_is_not_read_says_so(tmp_path, compression):
    write_dng(tmp_path / "a.dng", compression=compression)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        said = file.pages.first.compression.name
    with (
        pytest.raises(
            TileError, match=rf"a\.dng: its picture is compressed by {said}, .* not read .*convert"
        ),
        Photograph(tmp_path / "a.dng") as photograph,
    ):
        photograph.band(0, 10)


def test_a_damaged_dng_without_compression_is_still_damaged(tmp_path):
    write_dng(tmp_path / "a.dng")
    whole = (tmp_path / "a.dng").read_bytes()
    (tmp_path / "a.dng").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(TileError, match=r"a\.dng: (it is truncated|damaged)"):
        probe(tmp_path / "a.dng")
