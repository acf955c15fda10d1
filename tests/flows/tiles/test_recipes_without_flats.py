"""Captures without a stand or without flats: the shipped recipes for them, and what is said where they do not fit."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from PIL import Image

from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

DATA = Path(__file__).parents[4] / "shared" / "data"
NLIGHTS = Path(sys.executable).parent / "nlights"


def without(capture: Path, *fields: str, **more: object) -> None:
    """Take fields out of the manifest, and put others in."""
    path = capture / "artwork.yaml"
    stated = {**yaml.safe_load(path.read_text()), **more}
    path.write_text(yaml.safe_dump({name: value for name, value in stated.items() if name not in fields}))


def products(capture: Path, recipe, out: Path, root: Path | None = None) -> Path:
    tile = load_capture(capture, root=root)[0]
    outcome = run_directly(tile, load_recipe(recipe), RunOptions(out=out), lambda *_: None)
    assert outcome.folder is not None, outcome.message
    return outcome.folder


def warned(folder: Path) -> list[str]:
    rows = json.loads((folder / "quality.json").read_text())
    return [row["warning"] for row in rows if row["warning"]]


def error(folder: Path, capture: Path) -> float:
    """Mean angle to the true normals, degrees."""
    found, true = (tifffile.imread(at / "normals.tif").astype(float) for at in (folder, capture / "truth"))
    return float(np.nanmean(np.degrees(np.arccos(np.clip((found * true).sum(axis=-1), -1, 1)))))


def test_a_stand_without_flats_is_measured_by_calibrating_the_lamps_on_the_artwork(capture, tmp_path):
    without(capture, "flats")
    folder = products(capture, "no-flats", tmp_path / "calibrated")
    calibrated = error(folder, capture)
    assert calibrated < 0.6
    assert warned(folder) == []
    recipe = load_recipe("no-flats").record()
    recipe["light_model"]["refine"] = False
    folder = products(capture, recipe, tmp_path / "as given")
    assert error(folder, capture) > 2 * calibrated
    assert any("Try refine: true" in sentence for sentence in warned(folder))


def test_a_list_of_directions_is_enough_and_distant_lamps_over_a_field_are_told_from_near_ones(
    capture, tmp_path
):
    tile = load_capture(capture)[0]
    positions = tile.stand.lamp_positions(tile.lamps)
    rows = [
        f"{path.name} {x} {y} {z}" for path, (x, y, z) in zip(tile.frames.values(), positions, strict=True)
    ]
    (capture / "lamps.lp").write_text(f"{len(rows)}\n" + "\n".join(rows))
    without(capture, "stand", "flats", lights={"directions": "lamps.lp"})
    folder = products(capture, "given-directions", tmp_path / "out")
    assert any("times the photographs' noise" in sentence for sentence in warned(folder))


@pytest.mark.parametrize(
    ("fields", "recipe"), [(("flats",), "no-flats"), (("stand", "flats"), "given-directions")]
)
def test_check_plan_and_digitise_name_the_recipe_that_fits_in_the_same_words(
    capture, tmp_path, fields, recipe
):
    (capture / "lamps.lp").write_text("8\n" + "0 0 1\n" * 8)
    without(capture, *fields, **({"lights": {"directions": "lamps.lp"}} if "stand" in fields else {}))
    for command in (("check",), ("plan",), ("digitise", "--out", tmp_path / "out")):
        done = subprocess.run(
            [NLIGHTS, command[0], capture, *command[1:]], capture_output=True, text=True, check=False
        )
        assert done.returncode == 2
        assert f"--recipe {recipe}" in done.stderr
        assert (
            "flats: is missing, and detrend.images: flat-field of the recipe 'default' needs it"
            in done.stderr
        )
    assert not (tmp_path / "out").exists()


def psbox(folder: Path) -> Path:
    """PSBox's own demo, as a capture."""
    if not (DATA / "psbox").exists():
        pytest.skip("psbox is not beside the project")
    source = Path(os.path.relpath(DATA / "psbox", folder))
    spheres = []
    for probe in ("LightProbe-1", "LightProbe-2"):
        x, y, radius = np.loadtxt(DATA / "psbox" / probe / "circle_data.txt")
        frames = [f"{source}/{probe}/Image_{n:02d}.JPG" for n in range(1, 13)]
        with Image.open(DATA / "psbox" / probe / "Image_01.JPG") as photograph:
            rows = photograph.height
        # PSBox counts columns and rows from 1, rows upwards from the bottom.
        spheres.append({"frames": frames, "circle_px": [float(x - 1), float(rows - y), float(radius)]})
    manifest = {
        "artwork": {"id": "psbox"},
        "frames": [f"{source}/Objects/Image_{n:02d}.png" for n in range(1, 13)],
        "chrome_spheres": spheres,
    }
    (folder / "artwork.yaml").write_text(yaml.safe_dump(manifest))
    return folder


def test_the_demo_of_psbox_says_that_its_lamps_do_not_fit_and_what_to_try(tmp_path):
    capture = psbox(tmp_path)
    recipe = load_recipe("chrome-sphere").record()
    recipe["light_model"]["refine"] = False
    said = warned(products(capture, recipe, tmp_path / "as found", Path(tmp_path.anchor)))
    assert any(re.search(r"by 10\.[4-6] times the photographs' noise.* Try refine: true", s) for s in said)
    said = warned(products(capture, "chrome-sphere", tmp_path / "refined", Path(tmp_path.anchor)))
    assert not any("times the photographs' noise" in sentence for sentence in said)
    (lamp,) = (sentence for sentence in said if "do not predict" in sentence)
    assert "photographed under 3:" in lamp
