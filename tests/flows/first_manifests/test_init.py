"""First manifests: what init makes of folders as people have them."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from nlights_core.configurations import load_stand, shipped, shipped_names
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_flows.first_manifests.writing import Wanted, write_manifest
from nlights_flows.tiles.checking import check_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

DATA = Path(__file__).parents[4] / "shared" / "data"
NLIGHTS = Path(sys.executable).parent / "nlights"
EIGHT = range(1, 9)


def shoot(path: Path, level: int = 20000, shape=(6, 9)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((*shape, 3), level, np.uint16)
    if path.suffix.lower() in (".tif", ".tiff"):
        tifffile.imwrite(path, image, photometric="rgb")
    else:
        Image.fromarray((image >> 8).astype(np.uint8)).save(path)


def light_list(names) -> str:
    angles = 2 * np.pi * np.arange(len(names)) / len(names)
    rows = [
        f"{name} {np.cos(a):.4f} {np.sin(a):.4f} 1".strip() for name, a in zip(names, angles, strict=True)
    ]
    return "\n".join([str(len(rows)), *rows]) + "\n"


def started(folder: Path, **wanted):
    """The manifest that init writes, and the tiles that the other commands read of it."""
    written = write_manifest(folder, Wanted(**wanted))
    assert not list(folder.glob(".artwork*"))
    return written, load_capture(folder)


def test_a_simulated_capture_is_found_in_full(tmp_path):
    folder = tmp_path / "MS. 12 (7)"
    simulate(folder, load_stand("horizontal"), scene="painting", width=64, seed=1)
    (folder / "artwork.yaml").unlink()
    shutil.rmtree(folder / "truth")
    written, (tile,) = started(folder, stand="horizontal")
    assert written.missing == ""
    assert "--recipe" not in written.commands[1]
    assert tile.artwork == "MS. 12 (7)"
    assert [path.name for path in tile.frames.values()] == [f"light_{n}.tif" for n in EIGHT]
    assert [path.name for path in tile.flats.values()] == [f"light_{n}.tif" for n in EIGHT]
    assert tile.dark.name == "dark.tif"
    assert not check_tile(tile, load_recipe("default"), lambda share: None).problems


def test_without_flats_a_recipe_without_flats_is_named_and_without_lamps_it_is_said(tmp_path):
    for n in EIGHT:
        shoot(tmp_path / f"light_{n}.tif")
    written = write_manifest(tmp_path, Wanted())
    assert "where the lamps are" in written.missing
    assert "horizontal" in written.missing
    text = (tmp_path / "artwork.yaml").read_text(encoding="utf-8")
    assert "# Missing:" in text
    (tmp_path / "artwork.yaml").unlink()
    shutil.copy(shipped("stands") / "horizontal.yaml", tmp_path / "ours.yaml")
    written, (tile,) = started(tmp_path)
    assert tile.stand.name == load_stand("horizontal").name
    assert written.commands[0].endswith("--recipe no-flats")


def test_an_existing_manifest_stays_as_it_is(tmp_path):
    shoot(tmp_path / "light_1.tif")
    (tmp_path / "artwork.yaml").write_text("mine")
    with pytest.raises(CaptureError, match="never writes over one"):
        write_manifest(tmp_path, Wanted())
    assert (tmp_path / "artwork.yaml").read_text() == "mine"


def test_the_tree_of_rtibuilder_is_read_and_the_lights_go_to_the_photographs_that_it_names(tmp_path):
    for n in range(10, 18):
        shoot(tmp_path / "original-captures" / f"DSC_{n:04d}.tif")
        shoot(tmp_path / "jpeg-exports" / f"DSC_{n:04d}.jpg")
    names = [f"C:\\rti\\jpeg-exports\\DSC_{n:04d}.jpg" for n in (12, 11, 14, 13, 16, 15)]
    (tmp_path / "assembly-files").mkdir()
    (tmp_path / "assembly-files" / "object.lp").write_text(light_list(names))
    written, (tile,) = started(tmp_path)
    assert written.missing == ""
    assert "given-directions" in written.commands[0]
    assert [path.name for path in tile.frames.values()] == [f"DSC_{n:04d}.tif" for n in range(11, 17)]
    assert any("6 of 8 photographs" in sentence for sentence in written.unsure)
    assert any("exports" in sentence for sentence in written.unsure)
    assert not load_recipe_of("given-directions", tmp_path).lacking(tile)


def load_recipe_of(model: str, folder: Path):
    path = folder / "recipe-for-the-test.yaml"
    path.write_text(f"light_model: {model}\nnormals: least-squares\nintegrator: simchony\npasses: 1\n")
    return load_recipe(str(path))


def test_a_dome_of_relight_gives_the_lights(tmp_path):
    for n in range(1, 5):
        shoot(tmp_path / f"{n:02d}.png")
    lights = [{"x": x, "y": y, "z": 1.0} for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    (tmp_path / "ours.dome").write_text(
        json.dumps({"label": "d", "directions": lights, "positions3d": []}, indent=1)
    )
    written, (tile,) = started(tmp_path)
    assert written.missing == ""
    field = load_recipe_of("given-directions", tmp_path).light_model.locate(tile, None)
    np.testing.assert_allclose(field.directions[1] * np.sqrt(2), [0, 1, 1])


def test_a_dome_without_directions_is_told(tmp_path):
    for n in range(1, 5):
        shoot(tmp_path / f"{n}.png")
    (tmp_path / "ours.dome").write_text('{"label": "d"}')
    written = write_manifest(tmp_path, Wanted())
    assert any("no dome file of Relight" in sentence for sentence in written.unsure)
    assert "where the lamps are" in written.missing


def test_a_selene_set_has_four_lights_at_45_degrees_and_its_scale(tmp_path):
    for n in range(1, 5):
        shoot(tmp_path / f"{n}.tif")
    (tmp_path / "Selene_Output").mkdir()
    (tmp_path / "Selene_Output" / "depthmap_m1.tfw").write_text("0.00005\n0.0\n0.0\n-0.00005\n0.0\n0.0\n")
    written, (tile,) = started(tmp_path)
    assert written.missing == ""
    assert tile.pixel_size_mm == pytest.approx(0.05)
    field = load_recipe_of("given-directions", tmp_path).light_model.locate(tile, None)
    up, right = np.array([0, 1, 1]) / np.sqrt(2), np.array([1, 0, 1]) / np.sqrt(2)
    np.testing.assert_allclose(field.directions, [up, right, up * [1, -1, 1], right * [-1, 1, 1]], atol=1e-6)


def test_folders_that_look_alike_are_tiles_and_share_what_is_beside_them(tmp_path):
    for tile in ("r0c0", "r0c1"):
        for n in EIGHT:
            shoot(tmp_path / tile / f"{tile}_{n}.TIF")
        shoot(tmp_path / tile / f"{tile}_mask.png")
    for n in EIGHT:
        shoot(tmp_path / "Flats" / f"flat_{n}.TIF")
        shoot(tmp_path / "__MACOSX" / f"flat_{n}.TIF")
    written, tiles = started(tmp_path, stand="horizontal")
    assert [tile.name for tile in tiles] == ["r0c0", "r0c1"]
    assert tiles[1].frames["Relio_3"] == tmp_path / "r0c1" / "r0c1_3.TIF"
    assert tiles[1].mask == tmp_path / "r0c1" / "r0c1_mask.png"
    assert tiles[0].flats == tiles[1].flats
    assert any("tiles of one artwork" in sentence for sentence in written.unsure)


def test_sets_of_which_nobody_can_know_which_is_meant_are_named(tmp_path):
    for n in EIGHT:
        shoot(tmp_path / "before" / f"a{n}.tif")
        shoot(tmp_path / "after" / f"b{n + 1}.tif")
    with pytest.raises(
        CaptureError, match=r"several sets of photographs.*after/b\{n\}\.tif \(8\), before/a\{n\}"
    ):
        write_manifest(tmp_path, Wanted())
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.parametrize(
    ("names", "stand_keys"),
    [
        ([f"IMG_{n:04d}.tif" for n in range(117, 125)], "IMG_0117.tif"),
        ([f"light_{n}.tif" for n in range(8)], "light_0.tif"),
        ([f"2024-05-01 shot {n}.tif" for n in EIGHT], "2024-05-01 shot 1.tif"),
    ],
)
def test_photographs_that_are_numbered_otherwise_go_to_the_lamps_in_their_order(tmp_path, names, stand_keys):
    for name in names:
        shoot(tmp_path / name)
    _, (tile,) = started(tmp_path, stand="horizontal")
    assert tile.frames["Relio_1"].name == stand_keys
    assert len(set(tile.frames.values())) == 8


def test_names_without_numbers_are_lamps_of_these_names(tmp_path):
    for name in ("left", "right", "top"):
        shoot(tmp_path / f"{name}.tif")
    _, (tile,) = started(tmp_path)
    assert tile.lamps == ("left", "right", "top")


def test_what_does_not_fit_is_the_one_thing_that_is_missing(tmp_path):
    for n in range(1, 7):
        shoot(tmp_path / f"{n}.tif")
    assert "has 8, and there are 6" in write_manifest(tmp_path, Wanted(stand="horizontal")).missing
    (tmp_path / "artwork.yaml").unlink()
    (tmp_path / "lights.txt").write_text(light_list([""] * 6))
    shoot(tmp_path / "4.tif", shape=(7, 9))
    written = write_manifest(tmp_path, Wanted())
    assert "4.tif" in written.missing
    assert "size" in written.missing


def test_exposures_that_differ_are_told(tmp_path):
    for n in range(1, 4):
        shoot(tmp_path / f"{n}.jpg")
        with Image.open(tmp_path / f"{n}.jpg") as image:
            exif = image.getexif()
            exif[272] = "Camera"
            exif.get_ifd(0x8769)[33434] = 0.5 if n == 2 else 0.25
            image.save(tmp_path / f"{n}.jpg", exif=exif)
    written, (tile,) = started(tmp_path)
    assert any("EXIF" in sentence and "2.jpg: 0.5 s" in sentence for sentence in written.unsure)
    assert tile.encoding.transfer == "srgb"


def test_many_folders_of_a_list_and_the_rows_that_failed(tmp_path):
    for folder in ("a", "b c", "d"):
        for n in EIGHT:
            shoot(tmp_path / folder / f"light_{n}.tif")
    (tmp_path / "d" / "artwork.yaml").write_text("mine")
    rows = [
        "\ufefffolder;id;title;stand;recipe",
        "a;0012;Ein Bild;horizontal;psbox",
        "b c;MS. 264/3;;horizontal;",
        "d;14;;horizontal;",
        "e;15;;;",
        "b c;ms. 264/3;;horizontal;",
    ]
    (tmp_path / "objects.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    done = subprocess.run(
        [NLIGHTS, "init", "--from", tmp_path / "objects.csv"], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "5 folders: 2 can be digitised, 0 lack something, 3 failed" in done.stdout
    for line, words in ((4, "never writes over one"), (5, "no such folder"), (6, "stands in line 3 already")):
        assert f"objects.csv:{line}: " in done.stderr
        assert words in done.stderr
    (tile,) = load_capture(tmp_path / "a")
    assert (tile.artwork, tile.title) == ("0012", "Ein Bild")
    assert "--recipe psbox" in done.stdout
    assert load_capture(tmp_path / "b c")[0].folder == "MS. 264%2F3"


@pytest.mark.parametrize("head", ["id,title\n", "folder,colour\n", ""])
def test_a_list_with_other_columns_is_refused(tmp_path, head):
    (tmp_path / "objects.csv").write_text(head)
    done = subprocess.run(
        [NLIGHTS, "init", "--from", tmp_path / "objects.csv"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "columns are folder, id, title, stand, recipe" in done.stderr


@pytest.mark.parametrize(
    ("place", "without", "recipe", "tiles"),
    [
        ("psbox", "light_directions.txt", "chrome-sphere", 1),
        ("psbox", "", "given-directions", 1),
        ("uw", "lights.txt", "chrome-sphere", 2),
        ("harvard/cat", "", "given-directions", 1),
        ("diligent/ball", "", "given-directions", 1),
    ],
)
def test_real_captures_are_digitised_by_the_recipe_that_is_named(tmp_path, place, without, recipe, tiles):
    if not (DATA / place).is_dir():
        pytest.skip(f"{place} is not beside the project")
    folder = Path(shutil.copytree(DATA / place, tmp_path / "copy"))
    for path in folder.rglob(without) if without else ():
        path.unlink()
    written, found = started(folder)
    assert written.missing == ""
    assert written.commands[0].endswith(f"--recipe {recipe}")
    assert len(found) == tiles
    if recipe not in shipped_names("recipes"):
        pytest.skip(f"the recipe {recipe} is not shipped")
    chosen = load_recipe(recipe)
    assert not check_tile(found[0], chosen, lambda share: None).problems
    outcome = run_directly(found[0], chosen, RunOptions(out=tmp_path / "out"), lambda *_: None)
    assert outcome.state == "done", outcome.message
    assert (outcome.folder / "report.html").is_file()


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("leaves", "where the lamps are"),
        ("coins/banknote", "where the lamps are"),
        ("uw/chrome", "chrome sphere"),
        ("raw", "no photographs of an artwork"),
        ("diligent", "several sets of photographs"),
        ("tables", "holds no photographs"),
    ],
)
def test_of_other_real_folders_the_one_thing_that_is_missing_is_said(tmp_path, place, words):
    if not (DATA / place).is_dir():
        pytest.skip(f"{place} is not beside the project")
    folder = Path(shutil.copytree(DATA / place, tmp_path / "copy"))
    try:
        said = write_manifest(folder, Wanted()).missing
    except CaptureError as fault:
        said = str(fault)
        assert not (folder / "artwork.yaml").exists()
    assert words in said
