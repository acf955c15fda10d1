"""Photographs of a tile must be alike; who differs from the most is named."""

import numpy as np
import pytest
import tifffile

from nlights_core.capture import Encoding, Tile
from nlights_core.errors import TileError
from nlights_core.photographs.headers import survey
from nlights_core.photographs.icc_profiles import linear_profile
from nlights_core.photographs.images import probe

LAMPS = ("L1", "L2", "L3", "L4")


def icc(name="sRGB"):
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()


def capture(
    folder, odd=(), shape=(40, 60, 3), dtype=np.uint16, flats=True, dark=True, usual=None, **options
) -> Tile:
    """A tile of which some photographs, by name, are of another shape, type or with other options."""
    (folder / "flat").mkdir()
    frames = {lamp: folder / f"{lamp}.tif" for lamp in LAMPS}
    flat = {lamp: folder / "flat" / f"{lamp}.tif" for lamp in LAMPS} if flats else {}
    named = {**frames, **{f"flat {lamp}": path for lamp, path in flat.items()}}
    if dark:
        named["dark"] = folder / "dark.tif"
    for name, path in named.items():
        if name in odd:
            colour = "rgb" if len(shape) == 3 else "minisblack"
            tifffile.imwrite(path, np.zeros(shape, dtype), photometric=colour, **options)
        else:
            tifffile.imwrite(path, np.zeros((40, 60, 3), np.uint16), photometric="rgb", **(usual or {}))
    return Tile(
        artwork="a", name="t", frames=frames, flats=flat or None, dark=named.get("dark"), encoding=Encoding()
    )


@pytest.mark.parametrize(
    ("odd", "field"),
    [("L1", r"L1\.tif: frames\.L1"), ("L4", r"L4\.tif: frames\.L4"), ("flat L2", r"L2\.tif: flats\.L2"),
     ("dark", r"dark\.tif: dark")],
)  # fmt: skip
def test_the_one_that_differs_is_named_wherever_it_stands(tmp_path, odd, field):
    tile = capture(tmp_path, (odd,), (39, 59, 3))
    with pytest.raises(
        TileError, match=rf"{field}: size 59 x 39 px, but 8 photographs, as frames\.L.*60 x 40 px"
    ):
        survey(tile)


def test_another_depth_and_other_channels_are_named(tmp_path):
    tile = capture(tmp_path, ("L1",), dtype=np.uint8)
    with pytest.raises(TileError, match=r"L1\.tif: frames\.L1: depth 3 x uint8, but 8 photographs"):
        survey(tile)
    tifffile.imwrite(tile.frames["L1"], np.zeros((40, 60), np.uint16))
    with pytest.raises(TileError, match=r"L1\.tif: frames\.L1: depth 1 x uint16, but 8 .* have 3 x uint16"):
        survey(tile)


def test_several_that_differ_are_listed(tmp_path):
    tile = capture(tmp_path, ("L1", "L3", "dark"), (39, 59, 3))
    with pytest.raises(TileError, match=r"L1\.tif: frames\.L1: size .* \(so have frames\.L3, dark\), but 6 "):
        survey(tile)


def test_a_tie_blames_nobody(tmp_path):
    tile = capture(tmp_path, tuple(f"flat {lamp}" for lamp in LAMPS), (39, 59, 3), dark=False)
    with pytest.raises(TileError) as told:
        survey(tile)
    said = str(told.value)
    assert "4 have 60 x 40 px (frames.L1, frames.L2, frames.L3 and 1 more; L1.tif)" in said
    assert "4 have 59 x 39 px (flats.L1" in said


def test_alike_photographs_are_surveyed(tmp_path):
    tile = capture(tmp_path)
    assert survey(tile) == probe(tile.frames["L1"], tile.encoding)


@pytest.mark.parametrize(
    ("odd", "words"),
    [(("L2",), r"L2\.tif: frames\.L2: tone curve the profile 'sRGB built-in', but 8 .* have none \(linear light\)"),
     (tuple(f"flat {lamp}" for lamp in LAMPS), r"flats\.L1: tone curve the profile .*but 5 photographs"),
     (("dark",), r"dark\.tif: dark: tone curve the profile 'sRGB built-in'")],
)  # fmt: skip
def test_a_profile_that_only_some_have_is_refused(tmp_path, odd, words):
    tile = capture(tmp_path, odd, iccprofile=icc())
    with pytest.raises(TileError, match=words + r".*state encoding\.transfer for all"):
        survey(tile)
    for transfer in ("linear", "srgb"):
        survey(tile.model_copy(update={"encoding": Encoding(transfer=transfer)}))


def test_profiles_that_mean_the_same_are_alike(tmp_path):
    # A profile of linear light means what none means.
    tile = capture(tmp_path, ("L2",), iccprofile=linear_profile(icc(), 3))
    assert survey(tile).curve is None
