"""Manifests: three ways to name photographs, and every way to get them wrong."""

import shutil
from pathlib import Path

import pytest
import yaml

from nlights_core.errors import CaptureError, StandError
from nlights_core.manifest import load_capture

EIGHT = "".join(f"  Relio_{n}: light_{n}.tif\n" for n in range(1, 9))


def write(folder: Path, text: str) -> Path:
    path = folder / "artwork.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(folder: Path, text: str, **options) -> str:
    with pytest.raises(CaptureError) as fault:
        load_capture(write(folder, text), **options)
    return str(fault.value)


def test_a_mapping_a_list_and_a_pattern_say_the_same(tmp_path):
    files = ", ".join(f"light_{n}.tif" for n in range(1, 9))
    head = "artwork: {id: inv-1}\nstand: horizontal\n"
    mapping = load_capture(write(tmp_path, head + "frames:\n" + EIGHT))
    listed = load_capture(write(tmp_path, head + f"frames: [{files}]\n"))
    pattern = load_capture(write(tmp_path, head + 'frames: "light_{n}.tif"\n'))
    assert mapping[0].frames == listed[0].frames == pattern[0].frames
    assert mapping[0].frames["Relio_3"] == (tmp_path / "light_3.tif").resolve()


def test_a_pattern_names_tiles_and_zero_filled_numbers(tmp_path):
    text = (
        'artwork: {id: inv-1}\nstand: horizontal\nframes: "{tile}/{lamp}_{n:03d}.tif"\n'
        "tiles: [{name: a}, {name: b, origin_mm: [400, 0]}]\n"
    )
    a, b = load_capture(write(tmp_path, text))
    assert a.frames["Relio_2"] == (tmp_path / "a" / "Relio_2_002.tif").resolve()
    assert b.frames["Relio_2"] == (tmp_path / "b" / "Relio_2_002.tif").resolve()
    assert b.origin_mm == (400, 0)


def test_without_a_stand_a_pattern_means_the_files_that_exist_by_number(tmp_path):
    for n in (1, 2, 10, 3):
        (tmp_path / f"{n}_TL.png").touch()
    tile = load_capture(write(tmp_path, 'artwork: {id: leaves}\nframes: "{n}_TL.png"\n'))[0]
    assert [path.name for path in tile.frames.values()] == ["1_TL.png", "2_TL.png", "3_TL.png", "10_TL.png"]


def test_a_wider_root_lets_artworks_share_a_flat_set(tmp_path):
    folder = tmp_path / "inv-1"
    folder.mkdir()
    text = (
        'artwork: {id: inv-1}\nstand: horizontal\nframes: "light_{n}.tif"\nflats: "../flats/light_{n}.tif"\n'
    )
    assert "outside the capture root" in refused(folder, text)
    tile = load_capture(folder / "artwork.yaml", root=tmp_path)[0]
    assert tile.flats is not None
    assert tile.flats["Relio_1"] == (tmp_path / "flats" / "light_1.tif").resolve()


def test_a_stand_given_on_the_command_line_replaces_the_manifests(tmp_path):
    path = write(tmp_path, 'artwork: {id: inv-1}\nstand: horizontal\nframes: "light_{n}.tif"\n')
    stand = load_capture(path, stand="vertical-dark")[0].stand
    assert stand is not None
    assert stand.name == "vertical-dark"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frames: {Relio_9: x.tif}\n", ["no lamp 'Relio_9'", "Relio_1, Relio_2", "artwork.yaml:3"]),
        ("frames: {Relio_1: a.tif, Relio_2: b.tif}\n", ["at least 3 lamps", "found 2"]),
        ("frames: [a.tif, b.tif]\n", ["8 lamps", "got 2"]),
        ("frames: light.tif\n", ["needs {lamp} or {n}"]),
        ('frames: "light_{x}_{n}.tif"\n', ["{x} is not known"]),
        ("frames:\n" + EIGHT + "tiles: [{name: ../x}]\n", ["'../x' is not a plain name", "tiles.0.name"]),
        ("frames:\n" + EIGHT + "tiles: [{name: a/b}]\n", ["not a plain name"]),
        ("frames:\n" + EIGHT + "tiles: [{name: _flats}]\n", ["not a plain name"]),
        ("frames:\n" + EIGHT + "tiles: [{name: a}, {name: A}]\n", ["stands twice"]),
        ("frames:\n" + EIGHT + "tiles: []\n", ["tiles", "at least 1"]),
        ("frames:\n" + EIGHT + "flat: x\n", ["flat: unknown field", "flats"]),
        ("frames:\n" + EIGHT + "dark: /etc/passwd\n", ["dark", "outside the capture root", "--root"]),
        ("frames:\n" + EIGHT + "dark: ../dark.tif\n", ["outside the capture root"]),
        ("frames:\n" + EIGHT + 'flats: "{lamp}/../../../x.tif"\n', ["outside the capture root"]),
        ("frames:\n" + EIGHT + "flats: {Relio_1: a, Relio_2: b, Relio_3: c}\n", ["lacks Relio_4"]),
        ("frames:\n" + EIGHT + "white_reflectance: 1.5\n", ["white_reflectance", "at most 1", "1.5"]),
        ("frames:\n" + EIGHT + "tiles: [{name: a, origin_mm: [.nan, 0]}]\n", ["origin_mm"]),
        ("frames:\n" + EIGHT + "known_heights: {file: scan.ply}\n", ["known_heights", "sigma_mm is missing"]),
        ("frames:\n" + EIGHT + "known_heights: {file: ../probe.csv}\n", ["outside the capture root"]),
        ("frames:\n" + EIGHT + "known_heights: {file: a.csv, sigma_mm: 0}\n", ["sigma_mm", "more than 0"]),
        (
            "frames:\n" + EIGHT + "known_heights: {file: a.csv, tilt: 1}\n",
            ["known_heights.tilt", "unknown field"],
        ),
        ("{}\n", ["frames: is missing"]),
    ],
)
def test_a_fault_is_told_with_field_found_and_allowed(tmp_path, text, words):
    said = refused(tmp_path, "artwork: {id: inv-1}\nstand: horizontal\n" + text.replace("{}\n", ""))
    for word in words:
        assert word in said, said


def test_a_mask_may_be_left_to_the_photographs_by_all_tiles_or_by_one(tmp_path):
    text = "artwork: {id: inv-1}\nstand: horizontal\nframes:\n" + EIGHT
    (tile,) = load_capture(write(tmp_path, text + "mask: auto\n"))
    assert (tile.auto_mask, tile.mask) == (True, None)
    tiles = load_capture(
        write(tmp_path, text + "mask: auto\ntiles: [{name: a}, {name: b, mask: mine.png}]\n")
    )
    assert [(tile.auto_mask, tile.mask and tile.mask.name) for tile in tiles] == [
        (True, None),
        (False, "mine.png"),
    ]


def test_every_fault_is_told_at_once(tmp_path):
    said = refused(
        tmp_path,
        "artwork: {id: ''}\nstand: horizontal\nframes:\n" + EIGHT + "dark: ../x\nmask: ../y\n",
    )
    assert len(said.splitlines()) == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [1]\nb: *a\n", ["anchors and aliases"]),
        ("artwork: !!python/object/apply:os.system ['true']\n", ["not valid YAML"]),
        ("artwork: {id: x}\nartwork: {id: y}\n", ["'artwork' stands twice"]),
        ("- a\n- b\n", ["should be a mapping"]),
        ("a: [\n", ["not valid YAML"]),
        ("[" * 3000 + "]" * 3000, ["not valid YAML"]),
    ],
)
def test_hostile_or_broken_yaml_is_refused_in_one_sentence(tmp_path, text, words):
    said = refused(tmp_path, text)
    assert str(tmp_path / "artwork.yaml") in said
    assert len(said.splitlines()) == 1
    for word in words:
        assert word in said, said


def test_a_yaml_bomb_costs_nothing(tmp_path):
    bomb = "a: &a [x, x]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(12)
    )
    assert "anchors and aliases" in refused(tmp_path, bomb)


def test_a_missing_manifest_and_an_unknown_stand_are_told(tmp_path):
    with pytest.raises(CaptureError, match=r"nowhere\.yaml: cannot be read"):
        load_capture(tmp_path / "nowhere.yaml")
    said = refused(tmp_path, 'artwork: {id: a}\nstand: horizontl\nframes: "{n}.tif"\n')
    assert "horizontl" in said
    assert "vertical-dark" in said
    path = write(tmp_path, 'artwork: {id: a}\nframes: "{n}.tif"\n')
    with pytest.raises(StandError, match="shipped are"):
        load_capture(path, stand="nowhere")


def test_flats_may_be_several_sets_with_the_board_turned(capture):
    shutil.copytree(capture / "flat", capture / "turned")
    manifest = capture / "artwork.yaml"
    fields = yaml.safe_load(manifest.read_text())
    fields["flats"] = [
        {"frames": "flat/light_{n}.tif", "turn_deg": 10},
        {"frames": "turned/light_{n}.tif", "turn_deg": 190},
    ]
    manifest.write_text(yaml.safe_dump(fields))
    tile = load_capture(capture)[0]
    assert {path.parent.name for path in tile.flats.values()} == {"flat"}
    (further,) = tile.turned_flats
    assert further.turn_deg == 180
    assert list(further.flats) == list(tile.frames)
    assert {path.parent.name for path in further.flats.values()} == {"turned"}


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ([("flat/light_{n}.tif", 0), ("turned/light_{n}.tif", 360)], "two sets with the same turn_deg"),
        ([("flat/light_{n}.tif", 0), ("turned/light_{m}.tif", 90)], "flats.1.frames: the pattern"),
        ([("flat/light_{n}.tif", 0), ("turned/light_{n}.tif", "half")], "should be a number; got 'half'"),
    ],
)
def test_faulty_sets_of_flats_are_refused_with_their_place(capture, sets, said):
    shutil.copytree(capture / "flat", capture / "turned")
    manifest = capture / "artwork.yaml"
    fields = yaml.safe_load(manifest.read_text())
    fields["flats"] = [{"frames": frames, "turn_deg": turn} for frames, turn in sets]
    manifest.write_text(yaml.safe_dump(fields))
    with pytest.raises(CaptureError, match=said):
        load_capture(capture)


@pytest.mark.parametrize("number", [0, 2.5, "many"])
def test_flats_averaged_counts_exposures(capture, number):
    manifest = capture / "artwork.yaml"
    manifest.write_text(manifest.read_text() + f"flats_averaged: {number}\n")
    with pytest.raises(CaptureError, match="flats_averaged"):
        load_capture(capture)
