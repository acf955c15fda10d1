"""Digitising from Python: tiles with maps and numbers, also those that fail."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

import nlights
from nlights_core.files.tiffs import write_tiff
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.simulation.evaluation import evaluate

MAPS = ("height", "normals", "albedo", "reflection", "confidence")


def test_a_tile_has_maps_on_the_grid_of_its_photographs(tile, painting):
    assert (tile.state, tile.message, tile.failed) == ("done", "", False)
    assert tile.seconds > 0
    (source,) = nlights.load_capture(painting)
    assert tile.grid == grid_of(source, survey(source))
    for name in MAPS:
        found = getattr(tile, name)
        assert found.grid == tile.grid
        assert found.shape[:2] == tile.grid.shape
        assert found.dtype == np.float32
    assert tile.normals.shape == tile.albedo.shape == (*tile.grid.shape, 3)
    assert [getattr(tile, name).unit for name in MAPS] == ["mm", "", "", "", "°"]
    assert tile.trend is None


def test_maps_are_mapped_from_their_files_and_read_only(tile):
    for name in MAPS:
        found = getattr(tile, name)
        assert isinstance(found.base, np.memmap)
        assert Path(found.base.filename).name == f"{name}.tif"
        assert getattr(tile, name) is found
    with pytest.raises(ValueError, match="read-only"):
        tile.height += 1


def test_the_maps_are_true(tile, painting):
    errors = evaluate(tile.folder, painting / "truth")
    assert errors["angle_mean_deg"] < 1
    assert np.nanmedian(tile.confidence) < 1
    assert tile.grid.x()[0] == pytest.approx(-248.4375)


def test_numbers_are_found_by_name_and_near_ones_are_named(tile):
    number = tile.quality["Uncertainty of the normals, mean"]
    assert (number.unit, number.group, number.warning) == ("°", "Agreement", "")
    assert 0 < number.value < 1
    assert "off by no more" in number.meaning
    with pytest.raises(KeyError, match=r"no number is called .*near are .*Uncertainty of the normals, mean"):
        tile.quality["Uncertainty of normals"]
    with pytest.raises(KeyError, match=r"there are .*Known share"):
        tile.quality["qqq"]


def test_every_numbers_name_is_used_once(tile):
    rows = json.loads((tile.folder / "quality.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in rows] == list(tile.quality)


def test_the_mesh_is_in_the_frame_and_the_unit_of_the_height(tile):
    assert isinstance(tile.mesh, trimesh.Trimesh)
    low, high = tile.mesh.bounds
    assert low[0] == pytest.approx(tile.grid.x()[0], abs=1)
    assert high[1] == pytest.approx(tile.grid.y()[0], abs=1)
    assert high[2] == pytest.approx(float(tile.height.max()), abs=0.2)


def test_finished_products_are_opened(tile, products):
    again = nlights.open(tile.folder)
    assert (again.artwork, again.tile, again.state) == (tile.artwork, tile.tile, "unchanged")
    assert (again.height == tile.height).all()
    assert again.report.is_file()
    with pytest.raises(nlights.CaptureError, match=f"open one of .*{tile.tile}"):
        nlights.open(products)
    with pytest.raises(nlights.CaptureError, match="give the folder of a tile"):
        nlights.open(str(products / "none"))


@pytest.mark.parametrize(
    "grid", [nlights.PixelGrid(4, 6, 0.0375), nlights.PixelGrid(4, 6, 1.0, unit="px")], ids=["mm", "px"]
)
def test_without_a_stand_the_files_say_the_scale(tmp_path, grid):
    write_tiff(tmp_path / "height.tif", np.zeros(grid.shape, np.float32), grid, description="")
    record = {"artwork": "a", "tile": "b", "stand": None}
    (tmp_path / "provenance.json").write_text(json.dumps(record))
    found = nlights.open(tmp_path).height
    assert found.grid.pixel_size == pytest.approx(grid.pixel_size, rel=1e-6)
    assert (found.grid.shape, found.grid.camera, found.unit) == (grid.shape, None, grid.unit)


def test_compressed_maps_are_the_same(tile, painting, products, quick, tmp_path):
    (packed,) = nlights.digitise(
        painting,
        recipe=quick,
        out=tmp_path,
        store=products / ".store",
        compression="zstd",
        progress=False,
    )
    assert np.array_equal(packed.normals, tile.normals)
    assert packed.height.grid == tile.grid


def test_a_trend_is_a_map_where_the_recipe_removes_one(painting, products, quick, tmp_path):
    recipe = quick | {"detrend": {"images": "flat-field", "height": "parabolic-fit"}}
    (found,) = nlights.digitise(
        painting, recipe=recipe, out=tmp_path, store=products / ".store", progress=False
    )
    assert found.trend.unit == "mm"
    assert found.trend.grid == found.grid


def test_one_tile_fails_and_the_other_is_there(two_tiles, quick, tmp_path):
    (two_tiles / "b" / "light_1.tif").unlink()
    good, bad = nlights.digitise(two_tiles, recipe=quick, out=tmp_path / "out", progress=False)
    assert (good.tile, good.state, bad.tile, bad.state) == ("a", "done", "b", "failed")
    assert np.isfinite(good.height).all()
    assert bad.failed
    assert bad.folder is None
    assert "light_1.tif" in bad.message
    for name in (*MAPS, "trend", "grid", "quality", "provenance", "mesh", "report"):
        with pytest.raises(nlights.TileError, match=r"inv-1/b: failed: .*light_1.tif"):
            getattr(bad, name)
    (only,) = nlights.digitise(two_tiles, recipe=quick, out=tmp_path / "out", tiles="a", progress=False)
    assert (only.tile, only.state) == ("a", "unchanged")


def test_when_every_tile_fails_each_is_named(two_tiles, quick, tmp_path):
    (two_tiles / "a" / "light_2.tif").unlink()
    (two_tiles / "b" / "light_1.tif").unlink()
    with pytest.raises(nlights.TileError) as fault:
        nlights.digitise(two_tiles, recipe=quick, out=tmp_path / "out", progress=False)
    first, second = str(fault.value).splitlines()
    assert first.startswith("inv-1/a: ")
    assert "light_2.tif" in first
    assert second.startswith("inv-1/b: ")


@pytest.mark.parametrize(
    ("options", "kind", "words"),
    [
        ({"recipe": "defualt"}, nlights.RecipeError, "defualt: no recipe of this name"),
        ({"recipe": {"normals": "robust"}}, nlights.RecipeError, "recipe: light_model: is missing"),
        ({"tiles": ["x"]}, nlights.CaptureError, "^tiles: .* has no tile 'x'; it has r0c0"),
        ({"memory": "lots"}, nlights.CaptureError, "^memory: 'lots' is no amount"),
        ({"compression": "zip"}, nlights.CaptureError, "^compression: 'zip'; choose one of none, zstd"),
        ({"runner": "there"}, nlights.CaptureError, "^runner: there is no runner 'there'"),
        ({"timeout": -1}, nlights.CaptureError, "^timeout: should be a number of seconds"),
        ({"stand": "diagonal"}, nlights.StandError, "diagonal: no stand of this name"),
    ],
)
def test_what_is_to_be_mended_is_told_by_the_arguments_name(painting, tmp_path, options, kind, words):
    with pytest.raises(kind, match=words):
        nlights.digitise(painting, out=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_progress_is_told_to_the_standard_error_or_not_at_all(painting, products, quick, tile, capsys):
    nlights.digitise(str(painting), recipe=quick, out=products, progress=False)
    assert capsys.readouterr() == ("", "")
    nlights.digitise(str(painting), recipe=quick, out=products)
    said = capsys.readouterr()
    assert said.out == ""
    assert "r0c0: normals: " in said.err
