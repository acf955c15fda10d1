"""Where a sensor's end seems to be another than the capture says."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.number_ranges import range_warnings
from nlights_core.capture import Encoding, Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.photographs.development import darkroom

LAMPS = ("L1", "L2", "L3")


def light(seed, strength=1.0):
    """A picture with a bright spot, and photon noise; fractions of the sensor's end, unclipped."""
    y, x = np.mgrid[:100, :140] / 100
    picture = strength * (0.15 + 0.75 * np.exp(-6 * ((x - 0.3 * seed) ** 2 + (y - 0.5) ** 2)))
    return np.random.default_rng(seed).normal(picture, 0.004 * np.sqrt(picture))[..., None] * (1, 0.9, 0.8)


def capture(folder, numbers, dark=None, **encoding) -> Tile:
    """A tile whose photographs are made of light by lamp number."""
    paths = {}
    for seed, lamp in enumerate(LAMPS, 1):
        paths[lamp] = folder / f"{lamp}.tif"
        tifffile.imwrite(paths[lamp], numbers(seed), photometric="rgb")
    if dark is not None:
        tifffile.imwrite(folder / "dark.tif", dark, photometric="rgb")
    return Tile(
        artwork="a",
        name="t",
        frames=paths,
        dark=folder / "dark.tif" if dark is not None else None,
        encoding=Encoding(**encoding),
    )


def warned(tile):
    with darkroom(tile, Path(tile.frames["L1"]).parent) as room:
        return range_warnings(room)


def clipped(top, dtype, seed, strength=1.5, most=None):
    return np.clip(np.round(light(seed, strength) * top), 0, most or top).astype(dtype)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_numbers_of_fewer_bits_are_told_with_the_number_that_many_share(tmp_path, bits):
    top = 2**bits - 1
    (warning,) = warned(capture(tmp_path, lambda seed: clipped(top, np.uint16, seed)))
    assert (warning.code, warning.value, warning.lamps) == ("range", top, LAMPS)
    for words in (
        "L1.tif" if "L1.tif" in warning.sentence else ".tif",
        str(top),
        f"{bits} bits in files of 16",
    ):
        assert words in warning.sentence
    assert f"state encoding: {{saturation: {top}}}" in warning.sentence


@pytest.mark.parametrize(
    ("dtype", "top"), [(np.uint16, 61_234), (np.uint8, 243), (np.uint32, 3_000_000_000), (np.float32, 0.87)]
)
def test_clipping_below_white_is_told(tmp_path, dtype, top):
    def numbers(seed):
        return np.minimum(light(seed, 1.5) * top, top).astype(dtype)

    (warning,) = warned(capture(tmp_path, numbers))
    assert warning.code == "clipped"
    assert warning.value == pytest.approx(top, rel=1e-6)
    assert "the very same largest number" in warning.sentence


def test_only_the_lamps_that_clip_are_named(tmp_path):
    (warning,) = warned(
        capture(tmp_path, lambda seed: clipped(4095, np.uint16, seed, 1.5 if seed == 2 else 0.5))
    )
    assert warning.lamps == ("L2",)
    assert "L2.tif: frames.L2: " in warning.sentence


SOUND = {
    "bright, not clipped": (lambda seed: clipped(65535, np.uint16, seed, 0.95), {}),
    "dim 8 bits": (lambda seed: clipped(255, np.uint8, seed, 0.3), {}),
    "clipped at the type's end": (lambda seed: clipped(65535, np.uint16, seed), {}),
    "clipped at the stated level": (lambda seed: clipped(4095, np.uint16, seed), {"saturation": 4095}),
    "nothing saturates": (lambda seed: clipped(4095, np.uint16, seed), {"saturation": "none"}),
    "one even tone": (lambda seed: np.full((100, 140, 3), 20_000 + seed, np.uint16), {}),
    "smooth, without noise": (
        lambda seed: (
            np.round(np.exp(-((np.mgrid[:100, :140].sum(axis=0) / 99 - 1) ** 2)) * 50_000)[..., None]
            .repeat(3, axis=2)
            .astype(np.uint16)
        ),
        {},
    ),
    "float, with glints": (
        lambda seed: np.where(light(seed) > 0.899, 1.2, light(seed)).astype(np.float32),
        {},
    ),
    "float, noise about 0": (lambda seed: (light(seed, 0.5) - 0.07).clip(-0.003).astype(np.float32), {}),
}


@pytest.mark.parametrize("kind", SOUND)
def test_sound_photographs_are_not_doubted(tmp_path, kind):
    numbers, encoding = SOUND[kind]
    assert warned(capture(tmp_path, numbers, **encoding)) == []


def test_floats_above_the_level_are_told_with_the_largest(tmp_path):
    (warning,) = warned(capture(tmp_path, lambda seed: (light(seed) * 3).astype(np.float32)))
    assert warning.code == "range"
    assert warning.value > 2
    assert "from which on they count as saturated" in warning.sentence
    assert "encoding.saturation" in warning.sentence


def test_negative_floats_are_told(tmp_path):
    (warning,) = warned(capture(tmp_path, lambda seed: (light(seed) - 0.4).astype(np.float32)))
    assert warning.code == "range"
    assert warning.value < -0.2
    assert "light is not negative" in warning.sentence


def read_through(tile):
    neutral = LightField(LAMPS, directions=np.tile([0.0, 0.0, 1.0], (3, 1)))
    with darkroom(tile, Path(tile.frames["L1"]).parent) as room:
        room.raw(0, 100, neutral)
        room.check()


@pytest.mark.parametrize("top", [255, 4095, 65535])
@pytest.mark.parametrize("dark", [True, False])
def test_floats_of_another_range_are_refused_by_their_range_and_not_by_the_lens_cap(tmp_path, top, dark):
    black = (
        np.random.default_rng(0).normal(top / 250, 0.1, (100, 140, 3)).astype(np.float32) if dark else None
    )
    tile = capture(tmp_path, lambda seed: (light(seed, 0.9) * top).astype(np.float32), black)
    with pytest.raises(TileError, match=r"above 1, what a file of float32 .*encoding\.saturation") as told:
        read_through(tile)
    assert "lens" not in str(told.value)
    read_through(tile.model_copy(update={"encoding": Encoding(saturation=top)}))


def test_a_stated_level_that_is_too_low_is_named(tmp_path):
    tile = capture(tmp_path, lambda seed: clipped(65535, np.uint16, seed, 0.9), saturation=255)
    with pytest.raises(TileError, match=r"above 255, the level that encoding\.saturation states"):
        read_through(tile)


def test_a_bright_dark_frame_in_range_is_still_the_lens(tmp_path):
    tile = capture(
        tmp_path, lambda seed: clipped(65535, np.uint16, seed, 0.9), np.full((100, 140, 3), 65535, np.uint16)
    )
    with pytest.raises(TileError, match="photograph it again with the lens covered"):
        read_through(tile)


def test_a_mosaic_is_looked_at_as_its_file_has_it(tmp_path):
    paths = {}
    for seed, lamp in enumerate(LAMPS, 1):
        paths[lamp] = tmp_path / f"{lamp}.tif"
        tifffile.imwrite(paths[lamp], clipped(4095, np.uint16, seed)[:99, :139, 0])
    tile = Tile(artwork="a", name="t", frames=paths, encoding=Encoding(mosaic="RGGB"))
    (warning,) = warned(tile)
    assert warning.value == 4095
