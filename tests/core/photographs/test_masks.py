"""Masks as people make them: any image that is white where the artwork is."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from nlights_core.errors import TileError
from nlights_core.photographs.masks import Mask, mask_size

ROWS, COLUMNS = 75, 93
Y, X = np.mgrid[:ROWS, :COLUMNS]
DISC = (X - 40) ** 2 + (Y - 33) ** 2 < 30**2
WHITE = np.where(DISC, 255, 0).astype(np.uint8)
NOISE = np.random.default_rng(0).integers(1, 255, (ROWS, COLUMNS, 3)).astype(np.uint8)
PALETTE = np.zeros((3, 256), np.uint16)
PALETTE[:, 7] = 65535


def saved(mode, **options):
    def save(path):
        picture = {
            "L": WHITE,
            "1": DISC,
            "RGB": np.repeat(WHITE[..., None], 3, axis=2),
            "LA": np.dstack([NOISE[..., 0], WHITE]),
            "RGBA": np.dstack([NOISE, WHITE]),
            "opaque": np.dstack([*[WHITE] * 3, np.full_like(WHITE, 255)]),
        }[mode]
        Image.fromarray(picture).save(path, **options)

    return save


def palette(path):
    image = Image.fromarray(np.where(DISC, 3, 9).astype(np.uint8), "L").convert("P")
    colours = [0] * 768
    colours[9:12] = 255, 255, 255
    image.putpalette(colours)
    image.save(path)


def tiff(values, **options):
    return lambda path: tifffile.imwrite(path, values, **options)


MADE = {
    "a.jpg": saved("L", quality=75),
    "colour.jpg": saved("RGB", quality=60),
    "grey.png": saved("L"),
    "bits.png": saved("1"),
    "palette.png": palette,
    "la.png": saved("LA"),
    "rgba.png": saved("RGBA"),
    "opaque.png": saved("opaque"),
    "bits.bmp": saved("1"),
    "rgba.tga": saved("RGBA"),
    "fax.tif": saved("1", compression="group4"),
    "bits, packed.tif": saved("1", compression="packbits"),
    "truth values.tif": tiff(DISC),
    "truth values, black is zero.tif": tiff(DISC, photometric="minisblack"),
    "white is zero.tif": tiff(255 - WHITE, photometric="miniswhite"),
    "white is zero, bits.tif": tiff(~DISC, photometric="miniswhite", software="a scanner"),
    "palette.tif": tiff(np.where(DISC, 7, 3).astype(np.uint8), photometric="palette", colormap=PALETTE),
    "rgba.tif": tiff(np.dstack([NOISE, WHITE]), photometric="rgb", extrasamples=["unassalpha"]),
    "selection.tif": tiff(
        np.dstack([NOISE[..., 0], WHITE]), photometric="minisblack", planarconfig="contig", extrasamples=[0]
    ),
    "deep.tif": tiff(WHITE.astype(np.uint16) * 257, compression="zlib", rowsperstrip=8),
    "float.tif": tiff(DISC.astype(np.float32)),
    "float, 255.tif": tiff(WHITE.astype(np.float32)),
    "zeros and ones.tif": tiff(DISC.astype(np.uint8)),
    "zeros and ones.png": lambda path: Image.fromarray(DISC.astype(np.uint8)).save(path),
    "after a thumbnail.tif": lambda path: thumbnail(path),
}


def thumbnail(path):
    with tifffile.TiffWriter(path) as file:
        file.write(WHITE[::4, ::4], subfiletype=1)
        file.write(WHITE)


@pytest.mark.parametrize("name", MADE)
def test_what_is_white_or_opaque_is_inside(tmp_path, name):
    MADE[name](tmp_path / name)
    mask = Mask(tmp_path / name)
    assert mask_size(tmp_path / name) == (mask.rows, mask.columns) == (ROWS, COLUMNS)
    whole = mask.band(0, ROWS)
    assert whole.dtype == bool
    # A JPEG shifts an edge here and there; what rings beside it is far below half.
    assert np.count_nonzero(whole != DISC) <= (0.002 * DISC.size if name.endswith("jpg") else 0)
    assert mask.pixels == np.count_nonzero(whole)
    np.testing.assert_array_equal(
        np.concatenate([mask.band(r, min(r + 7, ROWS)) for r in range(0, ROWS, 7)]), whole
    )


def test_half_of_full_scale_is_outside_and_one_more_is_inside(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.array([[0, 127, 128, 255]], np.uint8))
    np.testing.assert_array_equal(Mask(tmp_path / "a.tif").band(0, 1), [[False, False, True, True]])


@pytest.mark.parametrize("largest", [0, 100])
def test_a_mask_with_nothing_inside_says_its_largest_number(tmp_path, largest):
    tifffile.imwrite(tmp_path / "a.tif", np.full((20, 30), largest, np.uint8))
    mask = Mask(tmp_path / "a.tif")
    with pytest.raises(TileError, match=rf"a\.tif: mask: nothing is inside: its largest number is {largest}"):
        mask.require_some()


def test_a_mask_cut_short_is_refused(tmp_path):
    saved("L", quality=75)(tmp_path / "a.jpg")
    whole = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(TileError, match=r"a\.jpg: damaged or incomplete"):
        Mask(tmp_path / "a.jpg")
