"""Inventory numbers as museums write them, and the folders that are called after them."""

import unicodedata
from pathlib import Path
from urllib.parse import unquote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.names.artworks import folder_of, require_own_folder

FRAMES = "frames: [1.tif, 2.tif, 3.tif]\n"


def written(folder: Path, number: str):
    (folder / "artwork.yaml").write_text(f"artwork:\n  id: {number}\n{FRAMES}", encoding="utf-8")
    return load_capture(folder)[0]


@pytest.mark.parametrize(
    ("number", "folder"),
    [
        ("1785", "1785"),
        ("0012", "0012"),
        ("2024-05-01", "2024-05-01"),
        ("no", "no"),
        ("1e3", "1e3"),
        ("12:30:45", "12%3A30%3A45"),
        ("1_000", "1_000"),
        (".5", "%2E5"),
        ("null", "null"),
        ("RP-T-1930:12", "RP-T-1930%3A12"),
        ("D'Arpino 3", "D%27Arpino 3"),
        ("MS. Bodl. 264/3", "MS. Bodl. 264%2F3"),
        ("inv-1785-012", "inv-1785-012"),
        ("Ü 3", "Ü 3"),
        ("100 % linen", "100 %25 linen"),
        ("Inv.", "Inv%2E"),
        ("Nul.3", "%4Eul.3"),
        ("a\\b", "a%5Cb"),
        ("№ 7", "%E2%84%96 7"),
        ("Gr. Fol. [3]", "Gr. Fol. %5B3%5D"),
    ],
)
def test_a_number_is_the_text_that_was_written_and_names_a_folder(tmp_path, number, folder):
    tile = written(tmp_path, number)
    assert tile.artwork == number
    assert tile.folder == folder
    assert unquote(tile.folder) == number
    assert written(tmp_path, f'"{number}"'.replace("\\", "\\\\")).artwork == number


def test_title_and_names_of_tiles_are_text_as_written_too(tmp_path):
    text = f"artwork: {{id: 0x1F, title: 1785}}\n{FRAMES}tiles: [{{name: 01}}, {{name: 2}}]\n"
    (tmp_path / "artwork.yaml").write_text(text)
    tiles = load_capture(tmp_path)
    assert [(tile.artwork, tile.title, tile.name) for tile in tiles] == [
        ("0x1F", "1785", "01"),
        ("0x1F", "1785", "2"),
    ]


def test_accents_are_composed(tmp_path):
    assert written(tmp_path, unicodedata.normalize("NFD", "É 1")).folder == "É 1"


@pytest.mark.parametrize(
    ("number", "words"),
    [
        ("", "should be text; got nothing"),
        ("''", "is empty"),
        ("' '", "is empty"),
        ("[1, 2]", "should be text"),
        ("{a: 1}", "should be text"),
        ('"a\\nb"', r"holds U\+000A"),
        ('"a\\e[31m"', r"holds U\+001B"),
        ("x" * 121, "of 121 bytes"),
        ("/" * 41, "of 123 bytes"),
        ("Inv. #12", r"put the text in quotes \('Inv\. #12'\)"),
        ("MS 12: 3", "put text with ': ' in it in quotes"),
    ],
)
def test_what_is_no_number_is_refused_with_file_and_remedy(tmp_path, number, words):
    with pytest.raises(CaptureError, match=words) as fault:
        written(tmp_path, number)
    assert "artwork.yaml:" in str(fault.value)


def test_a_comment_behind_a_number_is_a_comment(tmp_path):
    assert written(tmp_path, "1785 # the number").artwork == "1785"


@given(st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=20))
def test_the_number_can_be_read_from_its_folder_and_no_disk_changes_the_folder(number):
    number = unicodedata.normalize("NFC", number)
    folder = folder_of(number)
    assert unquote(folder) == number
    assert folder == unicodedata.normalize("NFC", folder)
    assert not set(folder) & set('<>:"/\\|?*')
    assert folder[0] not in ". "
    assert folder[-1] not in ". "
    assert folder.split(".")[0].strip().upper() not in {"CON", "PRN", "AUX", "NUL", "COM1", "LPT1"}


def test_a_folder_that_differs_by_capitals_only_is_refused(tmp_path):
    (tmp_path / "Inv-1").mkdir()
    require_own_folder("Inv-1", tmp_path)
    require_own_folder("inv-2", tmp_path)
    require_own_folder("inv-1", tmp_path / "nowhere")
    with pytest.raises(CaptureError, match="differ by capitals only"):
        require_own_folder("inv-1", tmp_path)
