"""A check says what digitising would refuse: in the same words, and one problem does not hide another."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml

from nlights_core.manifest import load_capture
from nlights_core.memory import allowed
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.checking import Finding, check_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Outcome, run_directly

NLIGHTS = Path(sys.executable).parent / "nlights"

BY_LIST = {"light_model": "given-directions", "normals": "least-squares", "integrator": "simchony"}
BY_SPHERE = {**BY_LIST, "light_model": "chrome-sphere"}
COMPUTED = {**BY_LIST, "detrend": {"images": "inverse-square"}}


def checked(capture: Path, recipe) -> Finding:
    return check_tile(load_capture(capture)[0], load_recipe(recipe), lambda share: None)


def digitised(capture: Path, recipe, out: Path) -> Outcome:
    return run_directly(load_capture(capture)[0], load_recipe(recipe), RunOptions(out=out), lambda *_: None)


def black(path: Path) -> None:
    tifffile.imwrite(path, np.zeros((120, 160, 3), np.uint16), photometric="rgb")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:60000])


def stating(capture: Path, **fields) -> None:
    """Change fields of the manifest; None takes one away."""
    path = capture / "artwork.yaml"
    stated = {**yaml.safe_load(path.read_text()), **fields}
    path.write_text(yaml.safe_dump({name: value for name, value in stated.items() if value is not None}))


def listed(capture: Path, text: str) -> None:
    (capture / "lamps.lp").write_text(text)
    stating(capture, lights={"directions": "lamps.lp"})


def rows(count: int, name: str = "light_{}.tif") -> str:
    azimuths = np.arange(count) * 2 * np.pi / count
    return "".join(f"{name.format(i + 1)} {np.cos(a)} {np.sin(a)} 0.9\n" for i, a in enumerate(azimuths))


def doubled_photograph(capture: Path):
    shutil.copy(capture / "light_2.tif", capture / "light_3.tif")
    return "default"


def doubled_flat(capture: Path):
    shutil.copy(capture / "flat" / "light_5.tif", capture / "flat" / "light_6.tif")
    return "default"


def wrong_count(capture: Path):
    listed(capture, "9\n" + rows(8))
    return BY_LIST


def a_list_that_names_some(capture: Path):
    listed(capture, "8\n" + rows(8).replace("light_8.tif", "scan_8.tif"))
    return BY_LIST


def a_lamp_behind_the_artwork(capture: Path):
    listed(capture, "8\n" + rows(8).replace("0.9", "-0.9", 1))
    return BY_LIST


def no_sphere_to_be_found(capture: Path):
    stating(capture, chrome_spheres=[{"frames": "light_{n}.tif"}])
    return BY_SPHERE


def a_fall_off_of_distant_lamps(capture: Path):
    listed(capture, "8\n" + rows(8))
    return COMPUTED


def a_black_flat(capture: Path):
    black(capture / "flat" / "light_4.tif")
    return "default"


def a_burnt_dark(capture: Path):
    tifffile.imwrite(capture / "dark.tif", np.full((120, 160, 3), 65535, np.uint16), photometric="rgb")
    return "default"


def a_turned_capture(capture: Path):
    stand = yaml.safe_load((Path(__file__).parents[3] / "configs" / "stands" / "horizontal.yaml").read_text())
    stand["field_mm"] = stand["field_mm"][::-1]
    (capture / "stand.yaml").write_text(yaml.safe_dump(stand))
    stating(capture, stand="stand.yaml")
    return "default"


def no_stand(capture: Path):
    stating(capture, stand=None, frames="light_{n}.tif", flats="flat/light_{n}.tif")
    return "default"


SPOILS = [
    doubled_photograph,
    doubled_flat,
    wrong_count,
    a_list_that_names_some,
    a_lamp_behind_the_artwork,
    no_sphere_to_be_found,
    a_fall_off_of_distant_lamps,
    a_black_flat,
    a_burnt_dark,
    a_turned_capture,
    no_stand,
]


@pytest.mark.parametrize("spoil", SPOILS, ids=lambda spoil: spoil.__name__)
def test_what_digitising_refuses_is_said_by_a_check_in_the_same_words(capture, tmp_path, spoil):
    recipe = spoil(capture)
    outcome = digitised(capture, recipe, tmp_path / "out")
    assert outcome.state == "failed"
    assert outcome.message in (problems := checked(capture, recipe).problems) or outcome.message == "; ".join(
        problems
    )


@pytest.mark.parametrize("spoil", [a_black_flat, doubled_flat], ids=lambda spoil: spoil.__name__)
def test_what_the_recipe_does_not_read_is_no_problem_of_a_check_either(capture, tmp_path, spoil):
    spoil(capture)
    assert digitised(capture, "psbox", tmp_path / "out").state == "done"
    assert checked(capture, "psbox").problems == []


def test_a_good_capture_has_no_problems_and_no_warnings(painting):
    found = checked(painting, "default")
    assert found.problems == found.warnings == []
    assert found.size == "160 x 120 px, 3 x uint16"


def test_one_problem_does_not_hide_the_others(capture):
    listed(capture, "9\n" + rows(8))
    shutil.copy(capture / "light_2.tif", capture / "light_3.tif")
    black(capture / "light_5.tif")
    black(capture / "light_7.tif")
    said = "\n".join(checked(capture, BY_LIST).problems)
    assert "the first line says 9 lights, but 8 lines follow" in said
    assert "frames.Relio_3: is the very photograph of Relio_2" in said
    assert "frames.Relio_5: all black" in said
    assert "frames.Relio_7: all black" in said


def test_every_missing_or_truncated_photograph_is_told(capture):
    for number in (2, 6):
        (capture / f"light_{number}.tif").unlink()
    said = checked(capture, "default").problems
    assert sum("no such file" in sentence for sentence in said) == 2
    for number in (2, 6):
        shutil.copy(capture / "light_1.tif", capture / f"light_{number}.tif")
        truncated(capture / f"light_{number}.tif")
    said = "\n".join(checked(capture, "default").problems)
    assert "light_2.tif" in said
    assert "light_6.tif" in said


def test_a_tile_that_needs_more_memory_than_there_is_is_a_problem(painting):
    with allowed(1 << 20):
        (said,) = checked(painting, "default").problems
    assert "integrator: simchony: needs" in said


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [NLIGHTS, "check", *map(str, words)], capture_output=True, text=True, check=False, timeout=120
    )


def test_json_has_one_shape_and_nothing_else_on_the_standard_output(two_tiles):
    black(two_tiles / "a" / "light_3.tif")
    done = run(two_tiles, "--json")
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert list(found) == ["tiles"]
    assert [tile["tile"] for tile in found["tiles"]] == ["a", "b"]
    assert all(list(tile) == ["tile", "problems", "warnings", "proposal"] for tile in found["tiles"])
    (problem,) = found["tiles"][0]["problems"]
    assert "frames.Relio_3: all black" in problem
    assert found["tiles"][1] == {"tile": "b", "problems": [], "warnings": [], "proposal": ""}


@pytest.mark.parametrize(
    ("field", "value", "recipe", "words"),
    [
        ("stand", "diagonal", "default", ["no stand of this name"]),
        ("pases", 3, "default", ["pases: unknown field"]),
        ("frames", ["light_1.tif"], "default", ["a list needs one photograph for each"]),
        ("priority", 1, "defalt", ["no recipe of this name"]),
    ],
)
def test_json_of_a_manifest_or_recipe_at_fault_keeps_the_shape(capture, field, value, recipe, words):
    stating(capture, **{field: value})
    done = run(capture, "--json", "--recipe", recipe)
    assert done.returncode == 2
    (tile,) = json.loads(done.stdout)["tiles"]
    assert tile["tile"] == ""
    assert tile["warnings"] == []
    for word in words:
        assert any(word in sentence for sentence in tile["problems"])
        assert word in done.stderr


def test_a_jpeg_taken_as_linear_is_a_warning_with_its_code(capture):
    from PIL import Image

    for path in (*capture.glob("*.tif"), *capture.glob("flat/*.tif")):
        Image.fromarray((tifffile.imread(path) >> 8).astype(np.uint8)).save(path.with_suffix(".jpg"))
    stating(capture, frames="light_{n}.jpg", flats="flat/light_{n}.jpg", dark="dark.jpg")
    (tile,) = json.loads(run(capture, "--json").stdout)["tiles"]
    (warning,) = (one for one in tile["warnings"] if one["code"] == "jpeg")
    assert set(warning) == {"code", "lamps", "value", "unit", "sentence"}
    assert "light_1.jpg: a JPEG without a profile is taken as linear light" in warning["sentence"]
    assert "r0c0: warning: jpeg: light_1.jpg" in run(capture).stderr
    stating(capture, encoding={"transfer": "srgb"})
    assert "jpeg" not in run(capture, "--json").stdout
