"""Codecs inside a TIFF: what is read, what is refused, and that neither takes memory of which no header speaks."""

import subprocess
import sys
import zlib

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from nlights_core.errors import TileError
from nlights_core.photographs.decoders import open_decoder
from nlights_core.photographs.tiff_codecs import jpeg_size

ROWS, COLUMNS = 48, 64
SIDE = 8_000
"""Of the images that are hidden in small files: 64 MB of 8 bits each."""


def hidden(path, coded: bytes, compression: int, **more) -> None:
    """A TIFF of 64 x 48 px whose only strip is coded otherwise."""
    options = {"photometric": "minisblack", "rowsperstrip": ROWS, "compression": compression} | more
    tifffile.imwrite(path, iter([coded]), shape=(ROWS, COLUMNS), dtype=np.uint8, **options)


@pytest.fixture(scope="module")
def bombs(tmp_path_factory):
    """Files of a few kB to 5 MB whose codecs say much more than their headers."""
    place = tmp_path_factory.mktemp("bombs")
    large = np.zeros((SIDE, SIDE), np.uint8)
    for name, code, encode in (
        ("JPEGXL", 50002, imagecodecs.jpegxl_encode),
        ("JPEG2000", 34712, imagecodecs.jpeg2k_encode),
        ("PNG", 34933, imagecodecs.png_encode),
        ("LERC", 34887, imagecodecs.lerc_encode),
        ("JPEG", 7, imagecodecs.jpeg_encode),
    ):
        hidden(place / f"{name}.tif", bytes(encode(large)), code)
    hidden(place / "deflate.tif", zlib.compress(bytes(SIDE * SIDE)), 8)
    hidden(place / "zstd.tif", bytes(imagecodecs.zstd_encode(bytes(SIDE * SIDE))), 50000)
    hidden(place / "lzw.tif", bytes(imagecodecs.lzw_encode(bytes(SIDE * SIDE // 8))), 5)
    hidden(place / "LZMA.tif", bytes(imagecodecs.lzma_encode(bytes(ROWS * COLUMNS))), 34925)
    tifffile.imwrite(place / "tiles.tif", np.zeros((64, 64), np.uint8), tile=(64, 64), compression="zlib")
    content = bytearray((place / "tiles.tif").read_bytes())
    with tifffile.TiffFile(place / "tiles.tif") as file:
        tags = [file.pages.first.tags[name] for name in ("TileWidth", "TileLength")]
    for tag in tags:  # a file of 64 px with one tile of 2 gigapixels
        content[tag.valueoffset : tag.valueoffset + 2] = (46_336).to_bytes(2, "little")
    (place / "tiles.tif").write_bytes(content)
    return place


READER = """
import resource, sys
from pathlib import Path
from nlights_core.errors import TileError
from nlights_core.photographs.decoders import open_decoder

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

before = peak()
for path in sorted(Path(sys.argv[1]).glob("*.tif")):
    said = "read"
    try:
        decoder = open_decoder(path)
        decoder.decode(0, decoder.rows)
    except TileError as fault:
        said = str(fault)
    except Exception as fault:
        said = f"{type(fault).__name__}: {fault}"
    print(f"{path.stem}|{peak() - before:.0f}|{said}")
"""


def test_no_codec_takes_memory_of_which_the_header_does_not_speak(bombs):
    child = [sys.executable, "-c", READER, bombs]
    done = subprocess.run(child, capture_output=True, text=True, timeout=300, check=True)
    told = {line.split("|")[0]: line.split("|")[1:] for line in done.stdout.splitlines()}
    assert set(told) == {path.stem for path in bombs.glob("*.tif")}
    for name, (taken, said) in told.items():
        assert float(taken) < 30, (name, taken, said)  # MB; each image is of 64 MB
    for name in ("JPEGXL", "JPEG2000", "PNG", "LERC", "LZMA"):
        assert f"is compressed by {name}, which is not read; export it" in told[name][1]
    assert f"the JPEG in it says {SIDE} x {SIDE}" in told["JPEG"][1]
    assert "tiles of 46336 x 46336 px for an image of 64 x 64 px" in told["tiles"][1]


@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "packbits", "zstd", "jpeg"])
@pytest.mark.parametrize("tile", [None, (16, 32)])
def test_what_is_allowed_is_read(tmp_path, compression, tile):
    ramp = np.add.outer(np.arange(ROWS), np.arange(COLUMNS)).astype(np.uint8)
    options = {"tile": tile} if tile else {"rowsperstrip": 20}
    tifffile.imwrite(tmp_path / "a.tif", ramp, compression=compression, **options)
    decoder = open_decoder(tmp_path / "a.tif")
    numbers = decoder.decode(0, ROWS)[..., 0].astype(int)
    decoder.close()
    assert np.abs(numbers - ramp).max() <= (6 if compression == "jpeg" else 0)


def test_a_mask_of_bits_may_be_coded_as_fax_and_by_nothing_unknown(tmp_path):
    Image.fromarray(np.eye(64, dtype=bool)).save(tmp_path / "fax.tif", compression="group4")
    open_decoder(tmp_path / "fax.tif", mask=True).close()
    Image.fromarray(np.eye(64, dtype=np.uint8)).convert("P").save(tmp_path / "lzma.tif", compression="lzma")
    with pytest.raises(TileError, match="LZMA, which is not read"):
        open_decoder(tmp_path / "lzma.tif", mask=True)


@pytest.mark.parametrize("size", [(ROWS, COLUMNS), (8, 4000), (3000, 8)])
@pytest.mark.parametrize("kind", ["baseline", "progressive", "lossless"])
def test_the_size_of_a_jpeg_is_what_it_says(tmp_path, size, kind):
    image = np.random.default_rng(1).integers(0, 255, size, np.uint8)
    if kind == "lossless":
        coded = bytes(imagecodecs.ljpeg_encode(image))
    else:
        Image.fromarray(image).save(
            tmp_path / "a.jpg", progressive=kind == "progressive", comment=b"\xff\xc0" * 40
        )
        coded = (tmp_path / "a.jpg").read_bytes()
    assert jpeg_size(coded) == (size[1], size[0])


def test_a_file_of_very_many_pages_is_looked_at_for_its_first(tmp_path):
    page = np.zeros((4, 4), np.uint8)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for _ in range(300):
            file.write(page, contiguous=False)
    decoder = open_decoder(tmp_path / "a.tif")
    decoder.close()
    assert len(decoder.pages) == 100
