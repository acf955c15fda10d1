"""Provenance: from photographs, recipe and stand alone the same bytes come out, anywhere."""

import json
import shutil
from pathlib import Path

import pytest
import yaml

import nlights
from nlights_core.configurations import load_stand
from nlights_core.errors import RecipeError
from nlights_core.products.writing import WHAT
from nlights_core.recipe import load_recipe
from nlights_core.store.records import read_sealed
from nlights_flows.tiles import direct
from nlights_flows.tiles.run_options import RunOptions


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_what_provenance_says_makes_the_same_bytes_from_the_photographs_alone(painting, tmp_path):
    # A recipe and a stand of the house's own, under names of their own.
    stand = yaml.safe_load(load_stand("horizontal").file.read_text())
    (tmp_path / "ours.yaml").write_text(yaml.safe_dump({**stand, "name": "ours", "uncertainty_mm": 1.5}))
    recipe = load_recipe("default").record() | {"integrable": False}
    recipe["normals"]["shadow"] = 0.03
    (tmp_path / "careful.yaml").write_text(yaml.safe_dump(recipe))
    options = RunOptions(
        out=tmp_path / "out", stand=str(tmp_path / "ours.yaml"), recipe=str(tmp_path / "careful.yaml")
    )
    (first,) = direct.digitise(painting, options, shown=False)
    assert first.state == "done", first.message
    provenance = read_sealed(first.folder / "provenance.json")

    # Elsewhere: the photographs, and what provenance.json says, as it stands there.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path in (*painting.glob("*.tif"), painting / "flat"):
        (shutil.copytree if path.is_dir() else shutil.copy)(path, elsewhere / path.name)
    for name in ("recipe", "stand"):
        (elsewhere / f"{name}.yaml").write_text(json.dumps(provenance[name], indent=1))
    (elsewhere / "artwork.yaml").write_text(
        json.dumps(
            {
                "artwork": {"id": provenance["artwork"], "title": provenance["title"]},
                "frames": provenance["photographs"],
                "flats": "flat/light_{n}.tif",
                "dark": "dark.tif",
                "tiles": [{"name": provenance["tile"], "origin_mm": provenance["origin_mm"]}],
            }
        )
    )
    options = RunOptions(
        out=tmp_path / "again", stand=str(elsewhere / "stand.yaml"), recipe=str(elsewhere / "recipe.yaml")
    )
    (second,) = direct.digitise(elsewhere, options, shown=False)
    assert second.state == "done", second.message
    assert contents(second.folder) == contents(first.folder)
    # And from Python.
    assert load_recipe(provenance["recipe"]) == load_recipe(str(elsewhere / "recipe.yaml"))
    assert nlights.open(second.folder).provenance["recipe"]["name"] == "careful"


@pytest.mark.parametrize("name", ["psbox, passes=3", "é", "12"])
def test_a_recipe_keeps_the_name_that_it_gives_itself(tmp_path, name):
    path = tmp_path / "file.yaml"
    path.write_text(json.dumps({"name": name, **load_recipe("psbox").record()}))
    assert load_recipe(str(path)).name == name


@pytest.mark.parametrize("name", [12, "", "a\nb", "x" * 201, None, ["a"]])
def test_a_name_that_is_none_is_refused(tmp_path, name):
    path = tmp_path / "file.yaml"
    path.write_text(json.dumps({"name": name, **load_recipe("psbox").record()}))
    with pytest.raises(RecipeError, match=r"file\.yaml:1: name: should be text of 1 to 200 letters"):
        load_recipe(str(path))


def test_provenance_has_a_digest_of_every_product(painting, tmp_path):
    options = RunOptions(out=tmp_path / "out", copies=True)
    (outcome,) = direct.digitise(painting, options, shown=False)
    folder = outcome.folder
    said = read_sealed(folder / "provenance.json")["files"]
    assert {*said, "provenance.json"} == {path.name for path in folder.iterdir()}
    assert set(said) <= set(WHAT)
    store = options.artefacts
    for name, one in said.items():
        assert one == {"bytes": (folder / name).stat().st_size, "xxh3": store.digest(folder / name)}
    # --copy: none is the store's own file; all are read-only; the next run takes them for what they are.
    inodes = {path.stat().st_ino for path in store.root.rglob("*")}
    assert not inodes & {path.stat().st_ino for path in folder.iterdir()}
    assert all(path.stat().st_mode & 0o222 == 0 for path in folder.iterdir())
    before = {path.name: path.stat().st_ino for path in folder.iterdir()}
    (again,) = direct.digitise(painting, options, shown=False)
    assert again.state == "unchanged"
    assert {path.name: path.stat().st_ino for path in folder.iterdir()} == before
    # Without it they stay, being the same; asked for where there are links, copies take their place.
    direct.digitise(painting, RunOptions(out=options.out), shown=False)
    assert {path.name: path.stat().st_ino for path in folder.iterdir()} == before
    shutil.rmtree(folder)
    direct.digitise(painting, RunOptions(out=options.out), shown=False)
    linked = {path.stat().st_ino for path in folder.iterdir()}
    if linked & inodes:  # no reflinks here
        direct.digitise(painting, options, shown=False)
        assert not inodes & {path.stat().st_ino for path in folder.iterdir()}


@pytest.mark.parametrize("mask", [0o077, 0o027])
def test_who_may_not_read_the_store_may_not_read_the_products_either(tmp_path, painting, mask):
    import os

    before = os.umask(mask)
    try:
        (outcome,) = direct.digitise(painting, RunOptions(out=tmp_path / "out"), shown=False)
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o777 for path in outcome.folder.iterdir()} == {0o444 & ~mask}
