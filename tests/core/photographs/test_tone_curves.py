"""What a number means: tone curves are undone as the capture or the embedded profile says."""

import io
import struct
from contextlib import suppress

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from pydantic import ValidationError

from nlights_core.capture import Encoding
from nlights_core.errors import TileError
from nlights_core.photographs.icc_profiles import ProfileError, linear_profile, parse_profile
from nlights_core.photographs.images import Photograph, probe
from nlights_core.photographs.tone_curves import (
    LIGHTNESS,
    SRGB,
    Formula,
    linear_light,
    profile_curve,
    stated_curve,
)

RAMP = np.linspace(0, 1, 1001)
FULL = {np.uint8: 255, np.uint16: 65535, np.uint32: 2**32 - 1, np.float32: 1}


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))


def curv(*values: int) -> bytes:
    """A table, one gamma times 256, or none."""
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *values)


def para(kind: int, *numbers: float) -> bytes:
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + fixed(*numbers)


def profile(
    *curves: bytes, name="made up", space=b"RGB ", kind=b"mntr", version=2, colours=None, **more
) -> bytes:
    """A profile of one curve for all channels, or of three; further tags by their names."""
    description = (
        b"desc" + bytes(4) + struct.pack(">I", len(name) + 1) + name.encode() + bytes(1 + 8 + 3 + 67)
    )
    if version >= 4:
        text = name.encode("utf-16-be")
        description = b"mluc" + bytes(4) + struct.pack(">II4sII", 1, 12, b"enUS", len(text), 28) + text
    tags = {b"desc": description, b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249)}
    if space == b"RGB ":
        for tag, colour in zip(
            (b"rXYZ", b"gXYZ", b"bXYZ"),
            colours or ((0.436, 0.222, 0.014), (0.385, 0.717, 0.097), (0.143, 0.061, 0.714)),
            strict=True,
        ):
            tags[tag] = b"XYZ " + bytes(4) + fixed(*colour)
        tags |= dict(zip((b"rTRC", b"gTRC", b"bTRC"), curves * (3 if len(curves) == 1 else 1), strict=False))
    elif curves:
        tags[b"kTRC"] = curves[0]
    tags |= {tag.encode(): data for tag, data in more.items()}
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for tag, data in tags.items():
        table += tag + struct.pack(">II", start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(
        ">I4sI4s4s4s12x4s", start + len(body), b"test", version << 24, kind, space, b"XYZ ", b"acsp"
    )
    head += bytes(28) + fixed(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def srgb(v):
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0) + 0.055) / 1.055) ** 2.4)


def lightness(v):
    """CIE 15: Y of L* = 100 v."""
    return np.where(v <= 0.08, 100 * v * 27 / 24389, ((100 * v + 16) / 116) ** 3)


def lut(law, count):
    return curv(*np.round(65535 * law(np.linspace(0, 1, count))).astype(int))


G = 563 / 256
LAWS = {
    "gamma, v2": (profile(curv(563)), lambda v: v**G, 1e-6),
    "gamma, v4": (profile(para(0, 1.8), version=4), lambda v: v**1.8, 1e-4),
    "type 1": (profile(para(1, 2.0, 0.9, 0.1)), lambda v: np.maximum(0.9 * v + 0.1, 0) ** 2, 1e-4),
    "type 1, black below": (
        profile(para(1, 2.0, 1.25, -0.25)),
        lambda v: np.maximum(1.25 * v - 0.25, 0) ** 2,
        1e-4,
    ),
    "type 2": (
        profile(para(2, 2.0, 1.25, -0.25, 0.04)),
        lambda v: np.maximum(1.25 * v - 0.25, 0) ** 2 + 0.04,
        1e-4,
    ),
    "sRGB, type 3": (profile(para(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)), srgb, 1e-4),
    "sRGB, table of 1024": (profile(lut(srgb, 1024)), srgb, 2e-5),
    "type 4": (
        profile(para(4, 2.0, 0.9, 0.0, 0.2, 0.1015625, 0.02, 0.0)),
        lambda v: np.where(v >= 0.1015625, (0.9 * v) ** 2 + 0.02, 0.2 * v),
        1e-4,
    ),
    "L*, table of 4096": (profile(lut(lightness, 4096), version=4), lightness, 2e-5),
    "L*, type 3": (profile(para(3, 3, 1 / 1.16, 0.16 / 1.16, 27 / 243.89, 0.08)), lightness, 1e-4),
    "grey, gamma": (profile(curv(461), space=b"GRAY"), lambda v: v ** (461 / 256), 1e-6),
}


@pytest.mark.parametrize("law", LAWS)
def test_curves_of_profiles_are_what_the_standard_says(law):
    icc, truth, exact = LAWS[law]
    curve = profile_curve(icc, 1 if law.startswith("grey") else 3)
    assert len(curve.channels) == 1
    np.testing.assert_allclose(curve.channels[0].light(RAMP), truth(RAMP), atol=exact)


def test_littlecms_agrees_with_the_curve_of_its_own_profile():
    icc = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    curve = profile_curve(icc, 3)
    np.testing.assert_allclose(curve.channels[0].light(RAMP), srgb(RAMP), atol=1e-4)
    assert "sRGB" in curve.name
    table = profile_curve(LAWS["sRGB, table of 1024"][0], 3)
    assert curve.same_as(table)  # written differently
    wide = ((0.61, 0.311, 0.019), (0.205, 0.626, 0.061), (0.149, 0.063, 0.745))
    assert not curve.same_as(profile_curve(profile(lut(srgb, 1024), colours=wide), 3))
    assert not curve.same_as(profile_curve(profile(curv(563)), 3))


@pytest.mark.parametrize(
    "straight", [curv(), curv(256), curv(0, 65535), para(0, 1.0), para(3, 1.0, 1, 0, 1, 0.1)]
)
def test_a_straight_curve_is_none(straight):
    assert profile_curve(profile(straight), 3) is None


def test_the_published_values_of_stated_curves():
    codes = np.array([0.0, 10 / 255, 0.04045, 128 / 255, 188 / 255, 1.0])
    published = [0.0, 0.0030352698, 0.0031308, 0.2158605, 0.5028865, 1.0]
    np.testing.assert_allclose(SRGB.light(codes), published, rtol=1e-4)
    np.testing.assert_allclose(
        LIGHTNESS.light(np.array([0, 0.08, 0.5, 1])), [0, 0.00885645, 0.18418651, 1], rtol=1e-5
    )
    assert stated_curve("linear") is None
    assert stated_curve("gamma 1") is None


@pytest.mark.parametrize("dtype", FULL)
@pytest.mark.parametrize("transfer", ["srgb", "L*", "gamma 2.2", "gamma 1.8"])
def test_light_is_one_exactly_from_the_saturation_level_on(dtype, transfer):
    full = FULL[dtype]
    level = float(round(0.75 * full)) if full > 1 else 0.75
    values = np.unique(np.linspace(0, full, 2001).astype(dtype))
    curve = stated_curve(transfer).channels[0]
    light = linear_light(values, level, curve)
    np.testing.assert_array_equal(light >= 1, values >= level)
    # The curve spans the type's range, whatever the level below white is.
    expected = curve.light(values / np.float64(full)) / curve.light(np.array([level / full]))
    np.testing.assert_allclose(light, expected, rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("level", [1023, 4095, 16383])
def test_a_level_of_fewer_bits_is_the_white_of_the_curve(level):
    values = np.arange(level + 1, dtype=np.uint16)
    np.testing.assert_allclose(linear_light(values, float(level), SRGB), srgb(values / level), atol=2e-6)


def test_a_gamma_undoes_noise_below_black_without_a_bias():
    noise = np.array([-0.1, -0.02, 0.02, 0.1], np.float32)
    light = linear_light(noise, 1.0, Formula(2.0))
    np.testing.assert_allclose(light, -light[::-1], rtol=1e-6)


def written(path, values, icc):
    if path.suffix == ".tif":
        tifffile.imwrite(
            path, values, photometric="rgb" if values.ndim == 3 else "minisblack", iccprofile=icc
        )
    elif values.dtype == np.uint16:
        path.write_bytes(imagecodecs.png_encode(values))
        image = Image.new("L", (1, 1))
        buffer = io.BytesIO()
        image.save(buffer, "PNG", icc_profile=icc)
        chunk = buffer.getvalue()
        start = chunk.index(b"iCCP") - 4
        size = int.from_bytes(chunk[start : start + 4], "big") + 12
        whole = path.read_bytes()
        path.write_bytes(whole[:33] + chunk[start : start + size] + whole[33:])
    else:
        Image.fromarray(values).save(
            path, icc_profile=icc, **({"quality": 100} if path.suffix == ".jpg" else {})
        )
    return path


@pytest.mark.parametrize("name", ["a.tif", "a.png", "a.jpg"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_absent_transfer_means_the_embedded_profile(tmp_path, name, dtype):
    if name == "a.jpg" and dtype == np.uint16:
        pytest.skip("a JPEG has 8 bits")
    full = FULL[dtype]
    values = np.repeat(np.linspace(0, full, 40).astype(dtype)[:, None, None], 30, axis=1).repeat(3, axis=2)
    path = written(tmp_path / name, values, profile(curv(563)))
    with Photograph(path) as photograph:
        assert not photograph.plain
        np.testing.assert_allclose(
            photograph.band(0, 40), (values / full) ** G, atol=0.012 if name == "a.jpg" else 1e-6
        )
    with Photograph(path, Encoding(transfer="icc")) as photograph:
        assert photograph.info.curve.name == "the profile 'made up'"
    with Photograph(path, Encoding(transfer="linear")) as photograph:
        assert photograph.info.curve is None
    with Photograph(path, Encoding(transfer="gamma 1.8")) as photograph:
        assert photograph.info.curve.name == "gamma 1.8"


def test_channels_with_curves_of_their_own_are_undone_each_by_its_own(tmp_path):
    values = np.linspace(0, 65535, 50).astype(np.uint16)[:, None, None] * np.ones((1, 20, 3), np.uint16)
    path = written(tmp_path / "a.tif", values, profile(curv(512), curv(), lut(lambda v: v**3, 4096)))
    with Photograph(path) as photograph:
        light = photograph.band(0, 50)
    v = values[..., 0] / 65535
    for channel, power in enumerate((2, 1, 3)):
        np.testing.assert_allclose(light[..., channel], v**power, atol=2e-5)


def test_linear_files_with_a_linear_profile_stay_on_the_fast_path(tmp_path):
    path = written(tmp_path / "a.tif", np.zeros((20, 30, 3), np.uint16), profile(curv()))
    with Photograph(path) as photograph:
        assert photograph.plain


A2B = {"A2B0": b"mft2" + bytes(60)}
REFUSED = {
    "tables of colours": (profile(name="Scanner LUT", **A2B), "'Scanner LUT' is made of tables of colours"),
    "no curves": (profile(name="Bare"), "'Bare' has no tone curves"),
    "CMYK": (profile(name="FOGRA39", space=b"CMYK", kind=b"prtr", **A2B), "'FOGRA39' is for CMYK"),
    "Lab": (profile(name="L", space=b"Lab ", kind=b"spac", **A2B), "'L' is for Lab"),
    "device link": (profile(curv(512), name="Link", kind=b"link"), "'Link' links two devices"),
    "grey": (profile(curv(512), name="Dot Gain 20%", space=b"GRAY"), "'Dot Gain 20%' is for grey"),
    "unknown curve": (profile(b"sf32" + bytes(20)), "a tone curve of no known type"),
    "unknown type": (profile(para(9, 1.0)), "a tone curve of no known type"),
    "falling": (profile(curv(65535, 100, 0)), "does not rise"),
    "all black": (profile(curv(0, 0, 0)), "does not rise"),
    "no slope": (profile(para(1, 2.0, 0.0, 0.1)), "does not rise"),
    "endless": (profile(para(0, -1.0)), "does not rise"),
    "curve cut short": (profile(curv(*range(99))[:40]), "damaged or cut short"),
    "cut short": (profile(curv(512))[:400], "damaged or cut short"),
    "no profile": (b"a letter" * 30, "damaged or cut short"),
    "empty": (b"x", "damaged or cut short"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_profile_that_states_no_curve_is_refused_by_name(tmp_path, kind):
    icc, words = REFUSED[kind]
    path = written(tmp_path / "a.tif", np.zeros((20, 30, 3), np.uint16), icc)
    with pytest.raises(TileError, match=r"a\.tif: its embedded profile .*state encoding\.transfer") as told:
        probe(path)
    assert words in str(told.value)
    for transfer in ("linear", "srgb"):  # what the manifest says goes before the profile
        probe(path, Encoding(transfer=transfer))


def test_a_damaged_profile_never_crashes():
    whole = profile(lut(srgb, 64), version=4)
    random, read = np.random.default_rng(1), 0
    for _ in range(3000):
        spoilt = bytearray(whole)
        for _ in range(random.integers(1, 6)):
            spoilt[random.integers(len(spoilt))] = random.integers(256)
        spoilt = bytes(spoilt[: random.integers(1, len(spoilt) + 1)])
        with suppress(ProfileError):
            profile_curve(spoilt, 3)
            read += 1
        linear_profile(spoilt, 3)
    assert 0 < read < 3000


def test_icc_without_a_profile_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((20, 30), np.uint16))
    with pytest.raises(TileError, match=r"a\.tif: has no embedded profile, but encoding\.transfer is icc"):
        probe(tmp_path / "a.tif", Encoding(transfer="icc"))


@pytest.mark.parametrize(
    "transfer", ["sRGB", "gamma", "gamma 0", "gamma 22", "gamma 2,2", "L", "gamma -1", ""]
)
def test_a_misspelt_transfer_is_refused(transfer):
    with pytest.raises(ValidationError, match="should be icc, linear, srgb, L"):
        Encoding(transfer=transfer)


def test_gamma_is_written_in_one_way():
    assert Encoding(transfer="gamma 2.20").transfer == Encoding(transfer="gamma2.2").transfer == "gamma 2.2"


@pytest.mark.parametrize("version", [2, 4])
@pytest.mark.parametrize("space", [b"RGB ", b"GRAY"])
def test_products_carry_the_profile_of_linear_light(version, space):
    icc = profile(lut(srgb, 64), name="Camera", version=version, space=space, vcgt=fixed(1, 2))
    channels = 1 if space == b"GRAY" else 3
    linear = linear_profile(icc, channels)
    found, before = parse_profile(linear), parse_profile(icc)
    assert found.colours == before.colours
    assert found.name == "Camera, linear"
    assert profile_curve(linear, channels) is None
    assert int.from_bytes(linear[:4], "big") == len(linear)
    assert linear_profile(linear, channels) == linear
    # LittleCMS reads it, and makes of half the light the code of half the light.
    opened = ImageCms.ImageCmsProfile(io.BytesIO(linear))
    mode = "RGB" if space == b"RGB " else "L"
    transform = ImageCms.buildTransform(opened, ImageCms.createProfile("sRGB"), mode, "RGB")
    shown = ImageCms.applyTransform(
        Image.new(mode, (1, 1), (128,) * len(mode) if mode == "RGB" else 128), transform
    )
    assert np.abs(np.array(shown).ravel().astype(int) - 188).max() <= 2


@pytest.mark.parametrize("format_", ["JPEG", "PNG", "TIFF"])
def test_the_colour_profile_is_handed_on_for_linear_light(tmp_path, format_):
    icc = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    path = tmp_path / f"a.{format_.lower()}"
    Image.new("RGB", (30, 20)).save(path, format_, icc_profile=icc)
    assert probe(path).icc == linear_profile(icc, 3)
    assert profile_curve(probe(path).icc, 3) is None
