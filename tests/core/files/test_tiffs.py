"""The files are read back with the libraries that others would use."""

import io
import resource
import tracemalloc

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from nlights_core.files import reduction, tiffs
from nlights_core.files.reduction import block_means
from nlights_core.files.tiffs import read_tiff, write_tiff
from nlights_core.frames import PixelGrid
from nlights_core.products.viewing import (
    UNKNOWN_NORMAL,
    srgb,
    srgb_codes,
    srgb_profile,
    write_albedo_view,
    write_normals_view,
)

GRID = PixelGrid(37, 53, 0.25)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize("dtype", [np.float32, np.uint16, np.uint8])
@pytest.mark.parametrize("depth", [(), (3,)])
def test_a_tiff_reads_back_exactly(tmp_path, rng, dtype, depth):
    array = (rng.random((37, 53, *depth)) * 200).astype(dtype)
    write_tiff(tmp_path / "a.tif", array, GRID, description="height, mm")
    back = tifffile.imread(tmp_path / "a.tif")
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, array)


def test_a_single_channel_is_written_without_its_axis(tmp_path, rng):
    array = rng.random((37, 53, 1), dtype=np.float32)
    write_tiff(tmp_path / "a.tif", array, GRID, description="albedo")
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), array[..., 0])


def test_unknown_stays_nan_in_the_file(tmp_path):
    array = np.full((37, 53), np.nan, np.float32)
    array[3, 4] = 2
    write_tiff(tmp_path / "a.tif", array, GRID, description="height, mm")
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), array)


def test_the_tags_state_resolution_description_and_software_but_no_date(tmp_path):
    write_tiff(tmp_path / "a.tif", np.zeros((37, 53), np.float32), GRID, description="height in mm, 3 µm")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        tags = file.pages[0].tags
        numerator, denominator = tags["XResolution"].value
        assert numerator / denominator == pytest.approx(40)  # 0.25 mm a pixel: 40 to the centimetre
        assert tags["YResolution"].value == tags["XResolution"].value
        assert tags["ResolutionUnit"].value == 3
        assert tags["ImageDescription"].value == "height in mm, 3 µm"
        assert tags["Software"].value.startswith("nLights 0.")
        assert tags["Compression"].value == 1
        assert "DateTime" not in tags
        assert not file.is_bigtiff


def test_no_resolution_is_claimed_where_the_scale_is_not_known(tmp_path):
    grid = PixelGrid(37, 53, 1, unit="px")
    write_tiff(tmp_path / "a.tif", np.zeros((37, 53), np.float32), grid, description="height, px")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].tags["ResolutionUnit"].value == 1


def test_more_than_four_gigabytes_become_bigtiff(tmp_path):
    # Only the header is written: the rows would follow it.
    shape, path = (21_000, 18_000, 3), tmp_path / "a.tif"
    grid = PixelGrid(*shape[:2], 0.1)
    tiffs.BandTiff(path, shape, np.float32, grid=grid, description="normals").__exit__(None, None, None)
    with tifffile.TiffFile(path) as file:
        assert file.is_bigtiff
        assert file.pages[0].shape == shape


def test_the_same_map_gives_the_same_bytes(tmp_path, rng):
    albedo = rng.random((37, 53, 3), dtype=np.float32)
    for name in ("a", "b"):
        write_tiff(tmp_path / f"{name}.tif", albedo, GRID, description="albedo")
        write_albedo_view(tmp_path / f"{name}v.tif", albedo, GRID)
        write_normals_view(tmp_path / f"{name}n.png", albedo)
    for end in (".tif", "v.tif", "n.png"):
        assert (tmp_path / f"a{end}").read_bytes() == (tmp_path / f"b{end}").read_bytes()


def test_a_float64_array_and_a_foreign_shape_are_refused(tmp_path):
    with pytest.raises(ValueError, match="float64"):
        write_tiff(tmp_path / "a.tif", np.zeros((37, 53)), GRID, description="")
    with pytest.raises(ValueError, match="37 x 53"):
        write_tiff(tmp_path / "a.tif", np.zeros((37, 52), np.float32), GRID, description="")
    assert not (tmp_path / "a.tif").exists()


@pytest.mark.parametrize("dtype", [np.float32, np.uint16, np.uint8])
@pytest.mark.parametrize("depth", [(), (3,)])
def test_a_compressed_tiff_loses_nothing(tmp_path, rng, monkeypatch, dtype, depth):
    monkeypatch.setitem(tiffs.STRIP_BYTES, "zstd", 1000)
    monkeypatch.setattr(reduction, "BAND_BYTES", 1700)
    array = (rng.random((37, 53, *depth)) * 200).astype(dtype)
    if dtype == np.float32:
        array[3, 4] = np.nan
    for name in "ab":
        write_tiff(tmp_path / f"{name}.tif", array, GRID, description="height, mm", compression="zstd")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].compression == tifffile.COMPRESSION.ZSTD
        assert file.pages[0].tags["ImageDescription"].value == "height, mm"
        assert len(file.pages[0].dataoffsets) > 1
    for read in (tifffile.imread, read_tiff):
        np.testing.assert_array_equal(read(tmp_path / "a.tif"), array)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_a_smooth_map_shrinks_when_it_is_compressed(tmp_path):
    grid = PixelGrid(300, 400, 0.1)
    bowl = (np.add.outer(grid.y() ** 2, grid.x() ** 2) / 100).astype(np.float32)
    write_tiff(tmp_path / "a.tif", bowl, grid, description="", compression="zstd")
    assert (tmp_path / "a.tif").stat().st_size < 0.7 * bowl.nbytes


def test_a_full_disk_raises_an_os_error(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OSError):
            write_tiff(
                tmp_path / "a.tif", np.ones((400, 400), np.float32), PixelGrid(400, 400, 1), description=""
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_normals_are_encoded_in_the_opengl_convention(tmp_path):
    normals = np.full((1, 5, 3), np.nan, np.float32)
    normals[0, :4] = [[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0]]
    write_normals_view(tmp_path / "n.png", normals)
    with Image.open(tmp_path / "n.png") as image:
        assert image.mode == "RGB"
        assert image.info == {}
        seen = np.asarray(image)[0].tolist()
    assert seen[:3] == [[128, 128, 255], [255, 128, 128], [128, 255, 128]]  # +y, up, is green
    assert seen[3] == [128, 0, 128]
    assert seen[4] == list(UNKNOWN_NORMAL)


def test_the_view_of_normals_decodes_to_within_half_a_step(tmp_path, rng):
    normals = rng.normal(size=(20, 30, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    write_normals_view(tmp_path / "n.png", normals)
    with Image.open(tmp_path / "n.png") as image:
        decoded = np.asarray(image) / 127.5 - 1
    assert np.abs(decoded - normals).max() <= 0.5 / 127.5 + 1e-6


def test_the_view_of_normals_is_the_same_however_the_bands_fall(tmp_path, rng, monkeypatch):
    normals = rng.normal(size=(20, 30, 3)).astype(np.float32)
    seen = []
    for size in (1, 2000, 1 << 20):
        monkeypatch.setattr(reduction, "BAND_BYTES", size)
        write_normals_view(tmp_path / "n.png", normals)
        with Image.open(tmp_path / "n.png") as image:
            seen.append(np.asarray(image.convert("RGB")))
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_are_the_srgb_curve_rounded(dtype):
    linear = np.concatenate([np.geomspace(1e-6, 1, 100_000), [0, 0.0031308]]).astype(np.float32)
    light = linear.astype(np.float64)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    most = np.iinfo(dtype).max
    assert np.abs(srgb_codes(linear, dtype) - most * curve).max() < 0.52
    outside = np.array([-np.inf, -1, -0.0, np.nan, 1, 1.5, np.inf], np.float32)
    assert srgb_codes(outside, dtype).tolist() == [0, 0, 0, 0, most, most, most]


def test_the_view_of_the_albedo_is_srgb_with_a_profile(tmp_path):
    linear = np.array([0, 0.0031308, 0.18, 0.5, 1, 7, -1, np.nan], np.float32)
    albedo = np.repeat(linear[None, :, None], 3, axis=2)
    write_albedo_view(tmp_path / "v.tif", albedo, PixelGrid(1, 8, 0.1))
    with tifffile.TiffFile(tmp_path / "v.tif") as file:
        seen = file.asarray()
        profile = file.pages[0].tags["InterColorProfile"].value
    # Values of IEC 61966-2-1: 18 % grey is 0.4614, 50 % is 0.7354.
    expected = np.array([0, 0.04045, 0.46136, 0.73536, 1, 1, 0, 0])
    assert seen.dtype == np.uint16
    np.testing.assert_allclose(seen[0, :, 0] / 65535, expected, atol=2e-5)
    assert profile == srgb_profile()


def test_a_grey_albedo_is_viewed_in_three_equal_channels(tmp_path):
    albedo = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4, 1)
    write_albedo_view(tmp_path / "v.tif", albedo, PixelGrid(3, 4, 0.1))
    seen = tifffile.imread(tmp_path / "v.tif")
    assert seen.shape == (3, 4, 3)
    np.testing.assert_array_equal(seen[..., 0], seen[..., 2])


def test_the_profile_is_srgb_and_carries_a_fixed_date():
    profile = ImageCms.ImageCmsProfile(io.BytesIO(srgb_profile()))
    assert "sRGB" in ImageCms.getProfileDescription(profile)
    assert profile.profile.creation_date.year == 2000
    assert srgb_profile() == srgb_profile()


def test_the_curve_inverts_the_srgb_definition():
    encoded = np.linspace(0, 1, 101)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(srgb(linear), encoded, atol=1e-6)


def test_block_means_average_what_is_known_and_cut_the_remainder():
    array = np.arange(35, dtype=np.float32).reshape(5, 7)
    array[0, 0] = np.nan
    array[2:4, 4:6] = np.nan
    array[2, 4] = 5
    means = block_means(array, 2)
    assert means.shape == (2, 3)
    assert means[0, 0] == pytest.approx((1 + 7 + 8) / 3)
    assert means[1, 1] == pytest.approx((16 + 17 + 23 + 24) / 4)
    assert np.isnan(means[1, 2])  # one of four known is less than half


def test_block_means_are_the_same_however_the_bands_fall(rng, monkeypatch):
    array = rng.random((30, 20, 3), dtype=np.float32)
    whole = block_means(array, 4)
    monkeypatch.setattr(reduction, "BAND_BYTES", 1)
    np.testing.assert_array_equal(block_means(array, 4), whole)


def test_memory_follows_the_band_not_the_image(tmp_path, monkeypatch):
    monkeypatch.setattr(reduction, "BAND_BYTES", 1 << 20)
    shape = (2000, 1500, 3)
    array = np.memmap(tmp_path / "array", np.float32, "w+", shape=shape)  # 36 MB
    grid = PixelGrid(*shape[:2], 0.1)
    tracemalloc.start()
    write_tiff(tmp_path / "a.tif", array, grid, description="")
    write_albedo_view(tmp_path / "v.tif", array, grid)
    block_means(array, 10)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 12 << 20
