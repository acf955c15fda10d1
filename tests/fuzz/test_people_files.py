"""Files that people write, spoilt at random: whatever is in them, only a sentence comes out.

`make fuzz` tries more, and others each time; what fails is kept in `.hypothesis` and tried again first.  What was
found and mended stands here as an example.
"""

import json
import os
import random
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, Phase, example, given, note, settings
from hypothesis import strategies as st

from nlights_core.configurations import load_stand, shipped
from nlights_core.errors import NlightsError
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.nights.limits import load_limits
from nlights_plugins.given_directions import read_directions, read_intensities

EXAMPLES = int(os.environ.get("NLIGHTS_FUZZ", "10000"))
"""Of each parser; those of an ordinary run are always the same."""

ALWAYS_THE_SAME = "NLIGHTS_FUZZ" not in os.environ

MANIFESTS = (
    """artwork: {id: inv-1785-012, title: "St. Peter's"}
priority: 3
frames: "{tile}/light_{n}.tif"
flats: [{frames: "flat/light_{n}.tif", turn_deg: 0}, {frames: "turned/light_{n}.tif", turn_deg: 180}]
dark: dark.tif
mask: auto
flats_averaged: 16
encoding: {transfer: gamma 2.2, mosaic: RGGB, saturation: 65535}
sensor: {electrons_at_saturation: 50000, read_noise_electrons: 3}
pixel_size_mm: 0.05
white_reflectance: 0.9
tiles:
  - {name: r0c0, origin_mm: [0, 0]}
  - {name: r0c1, origin_mm: [450, 0], frames: [a.tif, b.tif, c.tif]}
""",
    """artwork:
  id: 0012
stand: stand.yaml
frames:
  a: light_1.tif
  b: light_2.tif
  c: light_3.tif
chrome_spheres:
  - frames: "sphere/{lamp}.tif"
    circle_px: [10, 20, 30.5]
  - {frames: "other/{n:02d}.tif", points_px: [[1, 2], [3, 4], [5, 6]], mask: m.png, outline: o.png}
lights: {directions: lights.lp, intensities: i.txt}
known_heights: {file: h.csv, sigma_mm: 0.1, registration_mm: 1, tilted: true}
""",
    "artwork: {id: a}\nframes: 'light_{n}.tif'\n",
)
STAND = """name: own
source: measured
axes: {x: X, y: Z, z: -Y}
field_mm: [500, 375]
camera: [0.06, -1542.48, 0.26]
lamps:
  a: [-646.79, -171.98, 3.06]
  b: [-3.66, -166.24, 643.86]
  c: [641.34, -163.33, 0.38]
lamp:
  half_angle_deg: 12.5
  emitter_size_mm: 20
uncertainty_mm: 0.77
optics: {camera: X, focal_length_mm: 120, sensor_mm: [43.8, 32.9], sensor_px: [11656, 8742]}
"""
LIMITS = """limits:
  - {name: "Uncertainty of the normals, mean", unit: "°", warn: 0.35, fail: 0.5, source: the paper}
  - name: Uncertainty of the level
    unit: mm
    warn: 0.5
    at_least: true
    source: >-
      the paper promises
      a mesh within 1 mm
"""
LIGHTS = (
    "3\nlight_1.tif 0.1 0.2 0.9\nlight 2.tif -0.1 0.2 0.9\nlight_3.tif 0 0 1\n",
    "0.1 0.2 0.9\n-0.1 0.2 0.9\n0 0 1\n",
    "0.1 0.2 0.3 0.4\n0 0 0 0\n1 1 1 1\n",
    '{"directions": [{"x": 0.1, "y": 0.2, "z": 0.9}, {"x": 0, "y": 0, "z": 1}], "positions": []}',
    "1.0\n2.0\n3.0\n",
    "1.0 1 1\n2.0 2 2\n3.0 3 3\n",
)

# fmt: off
ODD_TEXTS = (
    "", "~", "null", "no", "yes", "0", "-1", "1e999", "-1e308", "1e-320", ".inf", "-.inf", ".nan", "9" * 400,
    "9" * 5000, "0x_", "0b_", "0o7", "1:60:60.5", "1:" * 400 + "1.5", "2024-13-45", "2024-05-01", "12024-01-01",
    "0012", "1_000", "<<", "=", "!!int ''", "!!float x", "!!bool x", "!!timestamp x", "!!binary é", "!!set {a}",
    "!!python/object:os.system {}", "!own x", "! x", "&a x", "*a", "[", "]", "{", "}", "[]", "{}", "[[]]", "[{}]",
    "{a: b}", "{? [a] : b}", "? a", "- a", "|", ">", "'", '"', '"\\0"', '"\\ud800"', '"\\x1b[31m"', '"\\u202e"', "%",
    "@", "`", "#", ": ", "a: b: c", "{lamp}", "{n}", "{n:9}", "{n:99}", "{tile}", "{", "{}", "{{n}}", "**", "*",
    "../x", "/etc/passwd", "~root/x", "x" * 300, "x/" * 2100, "x" * 5000, "é", "e\u0301", "\ufeff", "\u2028", "²",
    "auto", "none", "icc", "true", "stand.yaml", "circle.tif", "artwork.yaml", ".", "..", "a\tb", "\t", "---", "...",
    "flats", "artwork", "use", "id", "robust", "horizontal", "1 2 3", "0 0 0", "nan nan nan", "1e308 1e308 1e308",
    "1e-320 1e-320 1e-320", "3 3", "-0.0", "0 0 -1", "[" * 40, "{a: " * 40,
)
# fmt: on
ODD_VALUES = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        10**400,
        -(10**30),
        1e308,
        -1e308,
        5e-324,
        float("inf"),
        float("nan"),
        0.5,
    ),
    *(
        "",
        "a",
        "{n}",
        "{lamp}.tif",
        "..",
        "/",
        "x" * 5000,
        "x/" * 2100,
        "\x00",
        "\ud800",
        "é",
        "auto",
        "none",
    ),
    *(
        [],
        {},
        [[]],
        [{}],
        {"a": {}},
        [1, 2],
        [1, 2, 3],
        ["a", "b", "c"],
        {"use": 3},
        {"use": "robust", "x": []},
    ),
    *({"1": 2}, [None] * 9, {"name": "a"}, {"frames": "a"}, [{"frames": "{n}"}, "a"], {"lamps": None}),
)


def spoil_text(chance: random.Random, text: str) -> str:
    """Change lines, values and letters of a text."""
    lines = text.split("\n")
    for _ in range(chance.choice((1, 1, 2, 3, 6))):
        place = chance.randrange(len(lines))
        line, odd = lines[place], chance.choice(ODD_TEXTS)
        match chance.randrange(9):
            case 0:
                lines[place] = line.partition(":")[0] + ": " + odd
            case 1:
                lines[place] = odd
            case 2:
                lines.insert(place, chance.choice(lines))
            case 3:
                del lines[place : place + chance.randrange(3)]
                lines = lines or [""]
            case 4:
                lines[place] = " " * chance.randrange(5) + line.lstrip()
            case 5 | 6:
                at, end = chance.randrange(len(line) + 1), chance.randrange(len(line) + 1)
                lines[place] = line[:at] + odd + line[end:]
            case 7:
                words = line.split(" ")
                words[chance.randrange(len(words))] = odd
                lines[place] = " ".join(words)
            case 8:
                lines[place] = line + " " + odd
    return "\n".join(lines)


def spoil_data(chance: random.Random, data: object) -> object:
    """Change values, keys and shapes of what a document says."""
    if not isinstance(data, (dict, list)) or not data or chance.random() < 0.2:
        return chance.choice(ODD_VALUES)
    inside = list(data.items()) if isinstance(data, dict) else list(enumerate(data))
    place = chance.randrange(len(inside))
    key, value = inside[place]
    match chance.randrange(8):
        case 0:
            del inside[place]
        case 1:
            inside[place] = (chance.choice(ODD_TEXTS), value)
        case 2:
            inside[place] = (key, [value])
        case 3:
            inside[place] = (key, {"name": value})
        case 4:
            inside.append((chance.choice(ODD_TEXTS), chance.choice(ODD_VALUES)))
        case _:
            inside[place] = (key, spoil_data(chance, value))
    return dict(inside) if isinstance(data, dict) else [value for _, value in inside]


def spoilt(*texts: str) -> st.SearchStrategy[bytes]:
    """Documents like these, with one fault or a few: in their text, in what they say, or in their bytes."""
    parsed = [yaml.safe_load(text) for text in texts]

    def make(chance: random.Random) -> bytes:
        which = chance.randrange(len(texts))
        kind = chance.randrange(10)
        if kind < 5 or (kind < 9 and isinstance(parsed[which], str)):
            return spoil_text(chance, texts[which]).encode("utf-8", "surrogatepass")
        if kind < 9:
            data = parsed[which]
            for _ in range(chance.choice((1, 1, 2, 4))):
                data = spoil_data(chance, data)
            return json.dumps(data).encode()
        content = bytearray(texts[which].encode())
        for _ in range(chance.randrange(1, 9)):
            content[chance.randrange(len(content))] = chance.randrange(256)
        return bytes(content)

    made = st.integers(0, 2**64 - 1).map(lambda seed: make(random.Random(seed)))
    return st.one_of(
        made, made, made, made, made, made, made, st.binary(max_size=60), st.text(max_size=60).map(str.encode)
    )


def fuzzed(*texts: str, found: tuple[bytes, ...]):
    """Decorate a test of one parser; its argument is `content`, and `found` is what once was not explained."""

    def decorate(test):
        for content in found:
            test = example(content=content)(test)
        whole = settings(
            max_examples=EXAMPLES,
            deadline=None,
            derandomize=ALWAYS_THE_SAME,
            print_blob=not ALWAYS_THE_SAME,
            phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
        )
        return whole(given(content=spoilt(*texts))(test))

    return decorate


def only_a_sentence(parse, path: Path, content: bytes) -> None:
    """Parse a file; whatever is raised is an error of ours, which can be printed."""
    note(repr(content))
    path.write_bytes(content)
    said = "nothing"
    try:
        parse(path)
    except NlightsError as fault:
        said = str(fault)
    assert said.strip()
    assert len(said.splitlines()) < 200
    said.encode("utf-8")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder in which manifests find some of what they name."""
    folder = tmp_path_factory.mktemp("fuzz")
    for name in (
        "light_1.tif",
        "light_2.TIF",
        "light_03.tif",
        "dark.tif",
        "flat/light_1.tif",
        "sphere/a.tif",
    ):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    (folder / "stand.yaml").write_text(STAND)
    for name in ("circle.tif", "circle.yaml"):
        (folder / name).symlink_to(name)
    os.mkfifo(folder / "pipe.tif")
    return folder


OVERFLOW = b"1:" * 400 + b"1.5"
"""A number to the base of 60, as YAML has it; it is too large for Python to multiply."""

WRONG_TAGS = tuple(
    b"priority: " + value
    for value in (
        b"!!timestamp x",
        b"!!bool x",
        b"!!int ''",
        b"!!set {[]: a}",
        b"!!omap 3",
        b"!!pairs [a]",
        OVERFLOW,
    )
)


@fuzzed(
    *MANIFESTS,
    found=(
        *WRONG_TAGS,
        b'artwork: {id: a, title: "\\ud800"}\nframes: "light_{n}.tif"',
        b'artwork: {id: a}\nframes: "light_{n}.tif"\ndark: "\\0"',
        b"artwork: {id: a}\nframes: 'light_{n}.tif'\nstand: circle.yaml",
        b"artwork: {id: a}\nframes: " + b"x" * 300 + b"{n}.tif",
        b"artwork: {id: a}\nframes: " + b"{n}/" * 900 + b"{n}.tif",
        b"artwork: {id: a}\nframes: 'light_{n}.tif'\ntiles: [{name: \"\\ud800\"}]",
    ),
)
def test_manifests(place, content):
    only_a_sentence(load_capture, place / "artwork.yaml", content)


@fuzzed(STAND, found=WRONG_TAGS)
def test_stands(place, content):
    def use(path: Path) -> None:
        stand = load_stand(str(path))
        stand.lamp_positions()
        assert stand.lamp.exponent > 0

    only_a_sentence(use, place / "spoilt.yaml", content)


RECIPES = tuple(
    (shipped("recipes") / f"{name}.yaml").read_text(encoding="utf-8") for name in ("default", "chrome-sphere")
)


@fuzzed(*RECIPES, found=WRONG_TAGS)
def test_recipes(place, content):
    only_a_sentence(load_recipe, place / "recipe.yaml", content)


@fuzzed(LIMITS, found=WRONG_TAGS)
def test_limits(place, content):
    only_a_sentence(load_limits, place / "limits.yaml", content)


@fuzzed(
    *LIGHTS,
    found=(
        "²".encode(),
        b"\x1f0",
        b"9" * 5000,
        b"1e308 1e308 1e308\n0 0 1e-320\n",
        b'{"directions": ' + b"[" * 100_000,
        b'{"directions": [{"x": [1, 2], "y": [1, 2], "z": [1, 2]}]}',
        b'{"directions": [{"x": 1' + b"0" * 400 + b', "y": 0, "z": 1}]}',
        b'{"directions": [{}, {"x": null, "y": 0, "z": 1}]}',
        b'{"directions": []}',
    ),
)
def test_lists_of_lights(place, content):
    only_a_sentence(read_directions, place / "lights.lp", content)
    only_a_sentence(lambda path: read_intensities(path, 3), place / "lights.txt", content)
