"""Photographs in little: means over blocks of pixels."""

import numpy as np
import pytest
import tifffile

from nlights_core.photographs.images import Photograph, reduce_photograph


@pytest.mark.parametrize("band_rows", [1, 10, 1000])
def test_block_means_do_not_depend_on_the_bands(tmp_path, band_rows):
    # A ramp's block mean is the ramp at the block's centre.
    rows, columns = np.mgrid[:50, :43]
    tifffile.imwrite(tmp_path / "a.tif", (100 * rows + 7 * columns).astype(np.uint16))
    with Photograph(tmp_path / "a.tif") as photograph:
        means = reduce_photograph(photograph, 4, band_rows)
    centre_row, centre_column = np.mgrid[:12, :10] * 4 + 1.5
    expected = (100 * centre_row + 7 * centre_column) / 65535
    assert means.dtype == np.float32
    np.testing.assert_allclose(means[..., 0], expected, rtol=1e-6)


def test_a_block_with_a_saturated_pixel_is_not_known_unless_kept(tmp_path):
    values = np.zeros((8, 8, 3), np.uint8)
    values[5, 2, 1] = 255
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb")
    with Photograph(tmp_path / "a.tif") as photograph:
        means = reduce_photograph(photograph, 4)
        kept = reduce_photograph(photograph, 4, keep_saturated=True)
    unknown = np.zeros((2, 2, 3), bool)
    unknown[1, 0] = True
    np.testing.assert_array_equal(np.isnan(means), unknown)
    expected = np.zeros((2, 2, 3), np.float32)
    expected[1, 0, 1] = 1 / 16
    np.testing.assert_array_equal(kept, expected)
