"""Photographs are read exactly, in bands, and damaged ones are refused by name."""

import io
import struct
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image
from pydantic import ValidationError

from nlights_core.capture import Encoding
from nlights_core.errors import TileError
from nlights_core.photographs.images import (
    LARGE_BYTES,
    Photograph,
    grey,
    is_saturated,
    probe,
    superpixels,
)

DATA = Path(__file__).parents[3].parent / "shared" / "data"
FULL = {np.uint8: 255, np.uint16: 65535, np.uint32: 2**32 - 1, np.float32: 1, np.float16: 1, np.float64: 1}


def real(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real capture {name} is not beside the repository")
    return path


def numbers(dtype, shape=(75, 90, 3), seed=0):
    random = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return random.random(shape).astype(dtype)
    full = FULL[dtype]
    values = random.integers(0, full, shape, dtype=dtype, endpoint=True)
    values[0, 0], values[-1, -1], values[3, 5] = 0, full, full - 1
    return values


def write_tiff(target, values, **layout):
    if layout.get("planarconfig") == "separate":
        values = np.moveaxis(values, -1, 0)
    tifffile.imwrite(target, values, photometric="rgb", **layout)


def fraction(values, full):
    """Float32 nearest to the quotient; saturation is decided by the number itself."""
    return (values.astype(np.float64) / full).astype(np.float32)


def in_bands(path, rows=7, **options):
    with Photograph(path, **options) as photograph:
        height = photograph.info.rows
        return np.concatenate(
            [photograph.band(r, min(r + rows, height)) for r in range(0, height, rows)], axis=0
        )


LAYOUTS = {
    "one strip": {},
    "strips": {"rowsperstrip": 16},
    "planar": {"planarconfig": "separate"},
    "planar strips": {"planarconfig": "separate", "rowsperstrip": 16},
    "tiles": {"tile": (32, 48)},
    "planar tiles": {"tile": (32, 48), "planarconfig": "separate"},
    "lzw strips": {"compression": "lzw", "rowsperstrip": 16},
    "lzw, one strip": {"compression": "lzw", "rowsperstrip": 75},
    "deflate, predictor": {"compression": "zlib", "predictor": True, "rowsperstrip": 1},
    "zstd tiles, predictor": {"compression": "zstd", "predictor": True, "tile": (32, 48)},
    "zstd planar strips": {"compression": "zstd", "planarconfig": "separate", "rowsperstrip": 16},
    "packbits": {"compression": "packbits", "rowsperstrip": 16},
    "big endian": {"byteorder": ">"},
    "big endian, deflate": {"byteorder": ">", "compression": "zlib", "rowsperstrip": 16},
    "BigTIFF": {"bigtiff": True},
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.float32])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_of_a_tiff_is_read_bit_exactly_by_bands(tmp_path, layout, dtype):
    options = dict(LAYOUTS[layout])
    if np.dtype(dtype).kind == "f" and options.get("predictor"):
        options["predictor"] = 3
    values = numbers(dtype)
    write_tiff(tmp_path / "a.tif", values, **options)
    info = probe(tmp_path / "a.tif")
    assert (info.rows, info.columns, info.channels) == values.shape
    assert info.dtype == np.dtype(dtype)
    assert info.saturation == FULL[dtype]
    band = in_bands(tmp_path / "a.tif")
    assert band.dtype == np.float32
    below = values < FULL[dtype]  # the rounding of a 32-bit number must not make it saturated
    expected = fraction(values, FULL[dtype])
    expected[below] = np.minimum(expected[below], np.nextafter(np.float32(1), 0))
    np.testing.assert_array_equal(band, expected)
    np.testing.assert_array_equal(band >= 1, values >= FULL[dtype])


@pytest.mark.parametrize("layout", ["strips", "tiles", "lzw strips"])
def test_rows_can_be_asked_for_in_any_order(tmp_path, layout):
    values = numbers(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", **LAYOUTS[layout])
    with Photograph(tmp_path / "a.tif") as photograph:
        for start, stop in [(60, 75), (0, 75), (15, 17), (3, 3), (74, 75), (0, 1)]:
            np.testing.assert_array_equal(
                photograph.band(start, stop), fraction(values[start:stop], 65535), strict=True
            )
        with pytest.raises(ValueError, match="not within the 75 rows"):
            photograph.band(70, 76)


@pytest.mark.parametrize("layout", ["lzw strips", "zstd tiles, predictor", "zstd planar strips"])
def test_consecutive_bands_decode_nothing_twice(tmp_path, layout):
    values, path = numbers(np.uint16), tmp_path / "a.tif"
    write_tiff(path, values, **LAYOUTS[layout])
    with Photograph(path) as photograph:
        photograph.band(0, 9)
        with tifffile.TiffFile(path) as file:
            header_end = file.pages.first.dataoffsets[0]
        whole = path.read_bytes()
        with path.open("r+b") as file:  # what was not decoded before is now lost
            file.write(whole[:header_end] + bytes(len(whole) - header_end))
        np.testing.assert_array_equal(photograph.band(9, 16), fraction(values[9:16], 65535))
        with pytest.raises(TileError, match="damaged"):
            photograph.band(9, 40)


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
@pytest.mark.parametrize("options", [{}, {"compression": "zstd"}], ids=["mapped", "compressed"])
def test_other_floats_become_float32(tmp_path, dtype, options):
    values = numbers(dtype, (20, 30))
    tifffile.imwrite(tmp_path / "a.tif", values, **options)
    assert probe(tmp_path / "a.tif").dtype == np.float32
    np.testing.assert_array_equal(in_bands(tmp_path / "a.tif")[..., 0], values.astype(np.float32))


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_alpha_is_dropped(tmp_path, planar):
    values = numbers(np.uint16, (20, 30, 4))
    write_tiff(tmp_path / "a.tif", values, planarconfig=planar, extrasamples=["unassalpha"])
    assert probe(tmp_path / "a.tif").channels == 3
    np.testing.assert_array_equal(in_bands(tmp_path / "a.tif"), fraction(values[..., :3], 65535))
    (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(values))
    assert probe(tmp_path / "a.png").channels == 3
    np.testing.assert_array_equal(in_bands(tmp_path / "a.png"), fraction(values[..., :3], 65535))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(40, 30), (40, 30, 3)], ids=["grey", "colour"])
def test_a_png_keeps_all_its_bits(tmp_path, dtype, shape):
    values = numbers(dtype, shape)
    (tmp_path / "a.png").write_bytes(imagecodecs.png_encode(values))
    assert probe(tmp_path / "a.png").dtype == np.dtype(dtype)
    expected = fraction(values, FULL[dtype]).reshape(40, 30, -1)
    np.testing.assert_array_equal(in_bands(tmp_path / "a.png"), expected)


@pytest.mark.parametrize("name", ["a.bmp", "a.tga", "a.png"])
@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA"])
def test_small_formats_are_read_in_all_their_modes(tmp_path, name, mode):
    if name == "a.tga" and mode == "1":
        pytest.skip("TGA has no 1-bit images")
    picture = Image.fromarray(numbers(np.uint8, (40, 30, 3)))
    picture = picture.quantize(16) if mode == "P" else picture.convert(mode)
    picture.save(tmp_path / name)
    channels = 1 if mode in ("1", "L") else 3
    assert probe(tmp_path / name).channels == channels
    expected = np.asarray(picture.convert("L" if channels == 1 else "RGB")).reshape(40, 30, channels)
    np.testing.assert_array_equal(in_bands(tmp_path / name), fraction(expected, 255))


def test_the_saturation_level_can_be_declared(tmp_path):
    values = np.array([[0, 3999, 4000, 4001, 65535]], np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", values)
    band = in_bands(tmp_path / "a.tif", encoding=Encoding(saturation=4000))[..., 0]
    np.testing.assert_array_equal(band >= 1, values >= 4000)
    np.testing.assert_array_equal(band, fraction(values, 4000))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_where_nothing_saturates_integers_stay_below_one(tmp_path, dtype):
    values = numbers(dtype)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb")
    encoding = Encoding(saturation="none")
    assert np.isinf(probe(tmp_path / "a.tif", encoding).saturation)
    band = in_bands(tmp_path / "a.tif", encoding=encoding)
    assert not is_saturated(band).any()
    np.testing.assert_allclose(band, values / FULL[dtype], rtol=2e-7)


def test_floats_above_one_are_saturated_unless_declared_otherwise(tmp_path):
    values = np.array([[0.5, 1.0, 37.25, -0.25]], np.float32)
    tifffile.imwrite(tmp_path / "a.tif", values)
    band = in_bands(tmp_path / "a.tif")
    np.testing.assert_array_equal(band[..., 0], values)
    np.testing.assert_array_equal(is_saturated(band), [[False, True, True, False]])
    declared = in_bands(tmp_path / "a.tif", encoding=Encoding(saturation=50))
    np.testing.assert_array_equal(is_saturated(declared), np.zeros((1, 4), bool))


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("compression", [None, "zstd"])
def test_a_mosaic_of_uniform_colour_becomes_that_colour(tmp_path, pattern, compression):
    colour = {"R": 100, "G": 200, "B": 50}
    cell = np.array([colour[c] for c in pattern], np.uint8).reshape(2, 2)
    mosaic = np.tile(cell, (20, 15))[:39, :29]  # an odd row and column are dropped
    tifffile.imwrite(tmp_path / "a.tif", mosaic, compression=compression, rowsperstrip=5)
    encoding = Encoding(mosaic=pattern)
    info = probe(tmp_path / "a.tif", encoding)
    assert (info.rows, info.columns, info.channels) == (19, 14, 3)
    band = in_bands(tmp_path / "a.tif", rows=4, encoding=encoding)
    expected = np.broadcast_to(fraction(np.array([100, 200, 50], np.uint8), 255), (19, 14, 3))
    np.testing.assert_array_equal(band, expected)


@pytest.mark.parametrize("sample", range(4))
def test_one_saturated_sample_of_a_cell_saturates_its_channel_alone(sample):
    mosaic = np.full((2, 2), 0.25, np.float32)
    mosaic.flat[sample] = 1
    pixel = superpixels(mosaic, "GRBG")[0, 0]
    np.testing.assert_array_equal(pixel >= 1, np.array(["R", "G", "B"]) == "GRBG"[sample])


def test_the_greens_of_a_cell_are_averaged():
    mosaic = np.array([[0.125, 0.25], [0.75, 0.5]], np.float32)
    np.testing.assert_array_equal(superpixels(mosaic, "RGGB"), [[[0.125, 0.5, 0.5]]])


def test_a_mosaic_must_be_a_grey_image(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", numbers(np.uint8), photometric="rgb")
    with pytest.raises(TileError, match=r"a\.tif: has 3 channels, but mosaic: RGGB is for grey files"):
        probe(tmp_path / "a.tif", Encoding(mosaic="RGGB"))


def test_grey_weighs_the_colours_and_keeps_a_single_channel():
    image = np.eye(3, dtype=np.float32)
    np.testing.assert_array_equal(grey(image), np.array([0.299, 0.587, 0.114], np.float32), strict=True)
    np.testing.assert_array_equal(grey(image[..., 1:2]), image[..., 1])


def write_large(path, rows=5000, columns=4000):
    """20 megapixels of 16-bit RGB (120 MB) in zstd strips of 64 rows."""
    strip = np.arange(64 * columns * 3, dtype=np.uint32).astype(np.uint16).reshape(64, columns, 3)
    whole = np.concatenate([strip] * (rows // 64 + 1))[:rows]
    tifffile.imwrite(path, whole, photometric="rgb", compression="zstd", rowsperstrip=64)
    return strip, whole.nbytes


def test_memory_of_banding_through_a_compressed_tiff_is_that_of_a_band(tmp_path):
    strip, decoded_bytes = write_large(tmp_path / "a.tif")
    last = fraction(strip[4999 % 64 : 4999 % 64 + 1], 65535)
    tracemalloc.start()
    try:
        with Photograph(tmp_path / "a.tif") as photograph:
            for start in range(0, 5000, 100):
                band = photograph.band(start, min(start + 100, 5000))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(band[-1:], last)
    assert peak < decoded_bytes / 5


@pytest.mark.parametrize("with_scratch", [True, False], ids=["scratch", "memory"])
def test_what_must_be_decoded_whole_rests_in_the_scratch_folder(tmp_path, with_scratch):
    values = np.broadcast_to(np.arange(5000, dtype=np.uint16)[:, None], (5000, 8000))
    assert values.nbytes > LARGE_BYTES
    tifffile.imwrite(tmp_path / "a.tif", values, compression="zstd", rowsperstrip=5000)
    scratch = tmp_path / "scratch"
    tracemalloc.start()
    try:
        with Photograph(tmp_path / "a.tif", scratch=scratch if with_scratch else None) as photograph:
            np.testing.assert_array_equal(photograph.band(10, 12), fraction(values[10:12, :, None], 65535))
            at_rest = tracemalloc.get_traced_memory()[0]
            np.testing.assert_array_equal(photograph.band(4999, 5000), fraction(values[-1:, :, None], 65535))
    finally:
        tracemalloc.stop()
    assert (at_rest < LARGE_BYTES / 8) == with_scratch
    assert scratch.exists() == with_scratch
    assert not with_scratch or not list(scratch.iterdir())


def test_photographs_on_scratch_are_decoded_one_at_a_time(tmp_path):
    values = np.broadcast_to(np.arange(5000, dtype=np.uint16)[:, None], (5000, 8000))
    tifffile.imwrite(tmp_path / "a.tif", values, compression="zstd", rowsperstrip=5000)
    photographs = [Photograph(tmp_path / "a.tif", scratch=tmp_path) for _ in range(4)]
    tracemalloc.start()
    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(lambda photograph: photograph.band(0, 1), photographs))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        for photograph in photographs:
            photograph.close()
    assert peak < 2.5 * values.nbytes  # a strip and its copy; four at a time would be eight


def test_distinct_photographs_are_read_from_distinct_threads(tmp_path):
    values = [numbers(np.uint16, (200, 90, 3), seed) for seed in range(8)]
    for i, value in enumerate(values):
        write_tiff(tmp_path / f"{i}.tif", value, **list(LAYOUTS.values())[i])
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(in_bands, [tmp_path / f"{i}.tif" for i in range(8)]))
    for band, value in zip(found, values, strict=True):
        np.testing.assert_array_equal(band, fraction(value, 65535))


def test_a_hundred_megapixel_jpeg_is_read_without_a_warning(tmp_path):
    Image.new("L", (10_200, 10_000), 128).save(tmp_path / "a.jpg", quality=50)
    with Photograph(tmp_path / "a.jpg") as photograph:
        np.testing.assert_array_equal(photograph.band(9_999, 10_000), np.float32(128 / 255))


def test_closing_forgets_and_reading_opens_anew(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", numbers(np.uint8), photometric="rgb", compression="lzw")
    photograph = Photograph(tmp_path / "a.tif")
    photograph.close()
    first = photograph.band(0, 5)
    photograph.close()
    tifffile.imwrite(tmp_path / "a.tif", numbers(np.uint8, seed=9), photometric="rgb", compression="lzw")
    assert not np.array_equal(photograph.band(0, 5), first)
    photograph.close()


# --- What is refused ---------------------------------------------------------------------------


def read_whole(path):
    with Photograph(path) as photograph:
        return photograph.band(0, photograph.info.rows)


def test_a_missing_file_an_empty_file_and_a_folder_are_named(tmp_path):
    (tmp_path / "empty.tif").touch()
    (tmp_path / "folder.tif").mkdir()
    for name, found in [("none.tif", "no such file"), ("empty.tif", "empty"), ("folder.tif", "a folder")]:
        with pytest.raises(TileError, match=f"{name}: {found}"):
            probe(tmp_path / name)


@pytest.mark.parametrize("name", ["a.tif", "a.tga", "a.dng", "a.xyz"])
def test_what_is_no_image_is_refused_whatever_its_name(tmp_path, name):
    (tmp_path / name).write_bytes(b"Dear conservator, this is a letter. " * 50)
    with pytest.raises(TileError, match=f"{name}: "):
        probe(tmp_path / name)


@pytest.mark.parametrize(
    "start", [b"II*\0", b"MM\0*", b"II+\0", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"BM"]
)
@pytest.mark.parametrize("rest", [b"", b"\0" * 300, bytes(range(1, 200))], ids=["nothing", "zeros", "junk"])
def test_a_good_start_with_a_bad_rest_is_refused(tmp_path, start, rest):
    (tmp_path / "a").write_bytes(start + rest)
    with pytest.raises(TileError, match=r"a: "):
        probe(tmp_path / "a")


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.99])
@pytest.mark.parametrize("layout", ["one strip", "strips", "tiles", "planar", "lzw strips", "packbits"])
def test_a_truncated_tiff_is_refused_by_its_header_alone(tmp_path, layout, kept):
    buffer = io.BytesIO()
    write_tiff(buffer, numbers(np.uint16), **LAYOUTS[layout])
    whole = buffer.getvalue()
    (tmp_path / "a.tif").write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(TileError, match=r"a\.tif: (it is truncated|damaged or incomplete)"):
        probe(tmp_path / "a.tif")


@pytest.mark.parametrize("compression", ["lzw", "zlib", "zstd", "packbits"])
def test_a_strip_cut_short_raises_and_gives_no_zeros(tmp_path, compression):
    tifffile.imwrite(
        tmp_path / "a.tif", numbers(np.uint16), photometric="rgb", compression=compression, rowsperstrip=16
    )
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        counts = list(file.pages.first.databytecounts)
        counts[2] //= 2
        file.pages.first.tags["StripByteCounts"].overwrite(counts)
    with Photograph(tmp_path / "a.tif") as photograph:
        photograph.band(0, 32)
        with pytest.raises(TileError, match=r"a\.tif: damaged or incomplete"):
            photograph.band(30, 40)


@pytest.mark.parametrize("tag", ["StripByteCounts", "StripOffsets"])
@pytest.mark.parametrize("layout", ["strips", "lzw strips"])
def test_a_strip_that_was_never_written_is_refused(tmp_path, tag, layout):
    write_tiff(tmp_path / "a.tif", numbers(np.uint16), **LAYOUTS[layout])
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        values = list(file.pages.first.tags[tag].value)
        values[3] = 0
        file.pages.first.tags[tag].overwrite(values)
    with pytest.raises(TileError, match=r"a\.tif: 1 of 5 strips were never written"):
        probe(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.bmp", "a.tga"])
@pytest.mark.parametrize("kept", [0.2, 0.7, 0.95])
def test_other_truncated_files_are_refused_when_they_are_read(tmp_path, name, kept):
    Image.fromarray(numbers(np.uint8, (200, 300, 3))).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(TileError, match=f"{name}: damaged or incomplete"):
        read_whole(tmp_path / name)


def test_a_jpeg_whose_end_is_zeros_is_refused_and_padding_is_not(tmp_path):
    Image.fromarray(numbers(np.uint8, (200, 300, 3))).save(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "padded.jpg").write_bytes(whole + bytes(100))
    np.testing.assert_array_equal(read_whole(tmp_path / "padded.jpg"), read_whole(tmp_path / "a.jpg"))
    half = len(whole) // 2
    (tmp_path / "a.jpg").write_bytes(whole[:half] + bytes(len(whole) - half))
    with pytest.raises(TileError, match=r"a\.jpg: its end is only zeros"):
        read_whole(tmp_path / "a.jpg")


@pytest.mark.parametrize("fault", [np.nan, np.inf])
def test_nan_and_infinity_are_refused_naming_their_rows(tmp_path, fault):
    values = numbers(np.float32, (40, 30))
    values[[22, 25], 7] = fault
    tifffile.imwrite(tmp_path / "a.tif", values)
    with Photograph(tmp_path / "a.tif") as photograph:
        photograph.band(0, 22)
        with pytest.raises(TileError, match=r"a\.tif: holds NaN or infinity in rows 22 to 25"):
            photograph.band(20, 30)


REFUSED = {
    "int16": (np.zeros((20, 32), np.int16), {}, "int16"),
    "complex64": (np.zeros((20, 32), np.complex64), {}, "complex64"),
    "uint64": (np.zeros((20, 32), np.uint64), {}, "uint64"),
    "one bit": (np.zeros((20, 32), bool), {}, "bool"),
    "five channels": (np.zeros((20, 32, 5), np.uint8), {"photometric": "minisblack"}, "5 channels"),
    "CMYK": (np.zeros((20, 32, 4), np.uint8), {"photometric": "separated"}, "SEPARATED"),
    "white is zero": (np.zeros((20, 32), np.uint8), {"photometric": "miniswhite"}, "MINISWHITE"),
    "palette": (
        np.zeros((20, 32), np.uint8),
        {"photometric": "palette", "colormap": np.zeros((3, 256), np.uint16)},
        "PALETTE",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_tiff_that_cannot_be_measured_is_refused_by_what_it_holds(tmp_path, kind):
    values, options, found = REFUSED[kind]
    options = {"planarconfig": "contig", **options} if values.ndim == 3 else options
    tifffile.imwrite(tmp_path / "a.tif", values, **options)
    with pytest.raises(TileError, match=rf"a\.tif: .*{found}.*export it as a grey or RGB TIFF"):
        probe(tmp_path / "a.tif")


def test_packed_numbers_are_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((20, 32), np.uint16))
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        file.pages.first.tags["BitsPerSample"].overwrite(12)
    with pytest.raises(TileError, match="packed to 12 bits"):
        probe(tmp_path / "a.tif")


def test_a_cmyk_jpeg_is_refused(tmp_path):
    Image.new("CMYK", (30, 20)).save(tmp_path / "a.jpg")
    with pytest.raises(TileError, match="coded as CMYK; export it as grey or RGB"):
        probe(tmp_path / "a.jpg")


def test_a_header_of_more_than_a_gigapixel_is_refused_before_anything_is_decoded(tmp_path):
    header = struct.pack(
        "<2sIHHI IiiHHIIiiII", b"BM", 54, 0, 0, 54, 40, 40_000, 40_000, 1, 24, 0, 0, 0, 0, 0, 0
    )
    (tmp_path / "a.bmp").write_bytes(header)
    with pytest.raises(TileError, match="40000 x 40000 pixels"):
        probe(tmp_path / "a.bmp")


def test_a_saturation_of_zero_is_refused():
    with pytest.raises(ValidationError, match="greater than 0"):
        Encoding(saturation=0)
