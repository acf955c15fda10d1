"""Which file is meant: names as other systems, other programs and other people write them."""

import unicodedata
from pathlib import Path

import pytest

from nlights_core.errors import CaptureError, TileError
from nlights_core.manifest import load_capture
from nlights_core.photographs.decoders import open_decoder
from nlights_core.store import Store

STANDLESS = "artwork: {id: inv-1}\n"
ON_STAND = "artwork: {id: inv-1}\nstand: horizontal\n"


def load(folder: Path, text: str, *files: str):
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    (folder / "artwork.yaml").write_text(text, encoding="utf-8")
    return load_capture(folder)[0]


def lights(numbers, pattern="light_{}.tif"):
    return [pattern.format(n) for n in numbers]


def said(tile):
    return {warning.code: warning.sentence for warning in tile.warnings}


@pytest.mark.parametrize("on_disk", ["NFC", "NFD"])
@pytest.mark.parametrize("stand", [STANDLESS, ON_STAND], ids=["standless", "on a stand"])
def test_accents_are_the_same_however_folders_files_and_manifest_write_them(tmp_path, on_disk, stand):
    other = "NFD" if on_disk == "NFC" else "NFC"
    files = [unicodedata.normalize(on_disk, f"Prüfung/é_{n}.tif") for n in range(1, 9)]
    mask = unicodedata.normalize(on_disk, "Prüfung/Größe.png")
    text = unicodedata.normalize(
        other, stand + 'frames: "Prüfung/é_{n}.tif"\nmask: Prüfung/Größe.png\ndark: Prüfung/é_1.tif\n'
    ).replace(unicodedata.normalize(other, "dark: Prüfung/é_1.tif\n"), "")
    tile = load(tmp_path, text, *files, mask)
    assert [path.relative_to(tmp_path).as_posix() for path in tile.frames.values()] == files
    assert tile.mask == tmp_path / mask
    assert all(path.is_file() for path in (*tile.frames.values(), tile.mask))
    assert not tile.warnings


def test_a_list_a_mapping_spheres_and_lights_are_found_in_the_other_way_of_writing_too(tmp_path):
    decomposed = unicodedata.normalize("NFD", "ü")
    files = [f"{decomposed}{n}.tif" for n in range(1, 4)]
    text = (
        STANDLESS + "frames: [ü1.tif, ü2.tif, ü3.tif]\nflats: {1: ü1.tif, 2: ü2.tif, 3: ü3.tif}\n"
        "chrome_spheres: [{frames: [ü1.tif, ü2.tif, ü3.tif], outline: ü1.tif}]\nlights: {directions: ü.txt}\n"
    )
    tile = load(tmp_path, text, *files, f"{decomposed}.txt")
    assert [path.name for path in tile.frames.values()] == files
    assert tile.flats == tile.frames == tile.spheres[0].frames
    assert tile.spheres[0].outline == tile.frames["1"]
    assert tile.lights.directions.is_file()


def test_two_names_that_differ_by_accents_only_are_both_found_as_they_are_written(tmp_path):
    files = [unicodedata.normalize(form, f"é{n}.tif") for n in range(3) for form in ("NFC", "NFD")]
    text = STANDLESS + "frames: [" + ", ".join(f'"{name}"' for name in files) + "]\n"
    for name in files:
        (tmp_path / name).write_text(name)
    if len(list(tmp_path.iterdir())) < len(files):
        pytest.skip("this disk takes both for one")
    tile = load(tmp_path, text, *files)
    assert [path.name for path in tile.frames.values()] == files


@pytest.mark.parametrize("folder", ["raw [16 bit]", "a*b", "{x", "what? (1)", "[!a-z]"])
def test_brackets_stars_and_the_like_are_letters_of_a_name(tmp_path, folder):
    if folder == "{x":
        tile = load(
            tmp_path,
            STANDLESS + f'frames: "{folder}/{{n}}.tif"\n',
            *lights((1, 2, 3), folder.replace("{", "{{") + "/{}.tif"),
        )
    else:
        decoys = lights((4, 5), "raw 1/{}.tif")
        tile = load(
            tmp_path,
            STANDLESS + f'frames: "{folder}/{{n}}.tif"\n',
            *lights((1, 2, 3), folder + "/{}.tif"),
            *decoys,
        )
    assert list(tile.frames) == ["1", "2", "3"]


@pytest.mark.parametrize(
    "junk",
    [
        "._light_1.tif",
        ".light_9.tif",
        "__MACOSX/light_1.tif",
        "@eaDir/light_1.tif",
        ".AppleDouble/light_1.tif",
    ],
)
def test_what_systems_leave_behind_is_never_a_photograph(tmp_path, junk):
    tile = load(tmp_path, STANDLESS + 'frames: "{lamp}.tif"\n', *lights((1, 2, 3)), junk)
    assert list(tile.frames) == ["light_1", "light_2", "light_3"]
    deeper = tmp_path / "deeper"
    tile = load(deeper, STANDLESS + 'frames: "{lamp}/light_1.tif"\n', *lights("abc", "{}/light_1.tif"), junk)
    assert list(tile.frames) == ["a", "b", "c"]
    with pytest.raises(CaptureError, match="never a photograph"):
        load(tmp_path, STANDLESS + f"frames: [{junk}, light_2.tif, light_3.tif]\n".replace("@", "./@"))


def test_the_dark_frame_and_the_mask_are_no_lamps(tmp_path):
    files = [*lights((1, 2, 3)), "dark.tif", "mask.tif"]
    tile = load(tmp_path, STANDLESS + 'frames: "{lamp}.tif"\ndark: dark.tif\nmask: mask.tif\n', *files)
    assert list(tile.frames) == ["light_1", "light_2", "light_3"]


@pytest.mark.parametrize("stand", [STANDLESS, ON_STAND], ids=["standless", "on a stand"])
@pytest.mark.parametrize(
    ("pattern", "odd"),
    [("light_{n}.tif", "light_2.TIF"), ("light_{n}.tif", "Light_2.tif"), ("light_{n}.tif", "light_2.tiff"),
     ("light_{n}.JPG", "light_2.jpeg")],
)  # fmt: skip
def test_a_near_name_is_taken_where_it_is_the_only_one_and_it_is_told(tmp_path, stand, pattern, odd):
    files = [pattern.replace("{n}", str(n)) for n in range(1, 9) if n != 2]
    tile = load(tmp_path, stand + f'frames: "{pattern}"\n', *files, odd)
    assert len(tile.frames) == 8
    assert list(tile.frames.values())[1].name == odd
    assert odd in said(tile)["near-name"]


def test_a_folder_of_other_capitals_is_found_and_told(tmp_path):
    tile = load(tmp_path, STANDLESS + 'frames: "raw/light_{n}.tif"\n', *lights((1, 2, 3), "RAW/light_{}.tif"))
    assert len(tile.frames) == 3
    assert "light_1.tif" in said(tile)["near-name"]


def test_the_very_name_goes_before_a_near_one(tmp_path):
    tile = load(tmp_path, STANDLESS + 'frames: "{n}.tif"\n', *lights((1, 2, 3), "{}.tif"), "2.TIF", "2.tiff")
    assert [path.name for path in tile.frames.values()] == ["1.tif", "2.tif", "3.tif"]


def test_of_two_near_names_none_is_taken(tmp_path):
    files = [*lights((1, 3, 4, 5, 6, 7, 8)), "light_2.TIF", "light_2.tiff"]
    with pytest.raises(CaptureError, match=r"light_2\.TIF and light_2\.tiff both fit"):
        load(tmp_path, STANDLESS + 'frames: "light_{n}.tif"\n', *files)
    tile = load(tmp_path, ON_STAND + 'frames: "light_{n}.tif"\n')
    missing = tile.frames["Relio_2"]
    for read in (open_decoder, Store(tmp_path / "store").digest):
        with pytest.raises(TileError, match=r"did you mean light_2\.TIF or light_2\.tiff\?"):
            read(missing)


@pytest.mark.parametrize("there", ["light_02.tif", "light_2.jpg", "light_2"])
def test_a_missing_photograph_is_told_with_what_may_be_meant(tmp_path, there):
    tile = load(tmp_path, ON_STAND + 'frames: "light_{n}.tif"\n', there)
    with pytest.raises(TileError, match=f"did you mean {there}"):
        open_decoder(tile.frames["Relio_2"])


@pytest.mark.parametrize(
    ("files", "pattern", "lacking"),
    [
        (
            lights((1, 2, 4)),
            "light_{n}.tif",
            "light_{n}.tif' are not numbered throughout: there is none of 3",
        ),
        (lights((1, 2, 4)), "{lamp}.tif", "there is none of light_3"),
        (lights((1, 2, 5), "{:03d}.tif"), "{n:03d}.tif", "there is none of 003, 004"),
    ],
)
def test_a_gap_in_the_numbers_is_told(tmp_path, files, pattern, lacking):
    tile = load(tmp_path, STANDLESS + f'frames: "{pattern}"\n', *files)
    assert lacking in said(tile)["numbering"]


def test_equal_distances_are_no_gap(tmp_path):
    assert not load(tmp_path, STANDLESS + 'frames: "{n}.tif"\n', *lights((0, 15, 30), "{}.tif")).warnings


def test_lamps_that_end_in_a_number_are_in_the_order_of_their_numbers(tmp_path):
    tile = load(tmp_path, STANDLESS + 'frames: "{lamp}.tif"\n', *lights(range(1, 12)))
    assert list(tile.frames) == [f"light_{n}" for n in range(1, 12)]


def test_a_number_that_two_files_have_is_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"01\.tif and 1\.tif both fit"):
        load(tmp_path, STANDLESS + 'frames: "{n}.tif"\n', "1.tif", "01.tif", "2.tif", "3.tif")
    tile = load(tmp_path, STANDLESS + 'frames: "{n:02d}.tif"\n', "02.tif", "03.tif")
    assert list(tile.frames) == ["01", "02", "03"]


def test_a_placeholder_that_stands_twice_is_one_value(tmp_path):
    files = ["1/1.tif", "1/2.tif", "2/2.tif", "3/3.tif"]
    tile = load(tmp_path, STANDLESS + 'frames: "{n}/{n}.tif"\n', *files)
    assert [path.relative_to(tmp_path).as_posix() for path in tile.frames.values()] == [
        "1/1.tif",
        "2/2.tif",
        "3/3.tif",
    ]


@pytest.mark.parametrize(
    "frames",
    [
        "{1: a.tif, 2: b.tif, 3: a.tif}",
        "[a.tif, b.tif, ./a.tif]",
        "[a.tif, b.tif, link.tif]",
        "[a.tif, b.tif, A.tif]",
    ],
    ids=["mapping", "list", "link", "near name"],
)
def test_one_photograph_under_two_lamps_is_refused(tmp_path, frames):
    (tmp_path / "a.tif").write_text("a")
    (tmp_path / "link.tif").symlink_to("a.tif")
    with pytest.raises(CaptureError, match=r"a\.tif stands under 1 and 3"):
        load(tmp_path, STANDLESS + f"frames: {frames}\n", "a.tif", "b.tif")


def test_a_name_of_the_other_way_of_writing_does_not_lead_out_of_the_root(tmp_path):
    capture = tmp_path / "capture"
    capture.mkdir()
    (tmp_path / "dark.tif").write_text("outside")
    (capture / unicodedata.normalize("NFD", "é.tif")).symlink_to(tmp_path / "dark.tif")
    with pytest.raises(CaptureError, match="outside the capture root"):
        load(
            capture, STANDLESS + "frames: [1.tif, 2.tif, 3.tif]\ndark: é.tif\n", *lights((1, 2, 3), "{}.tif")
        )


def test_lamps_may_be_called_by_what_yaml_takes_for_something_else(tmp_path):
    tile = load(
        tmp_path, STANDLESS + "frames: {no: a.tif, 012: b.tif, 3: c.tif}\n", "a.tif", "b.tif", "c.tif"
    )
    assert tile.lamps == ("no", "012", "3")
