"""Comparing from Python."""

import json
from pathlib import Path

import pytest

import nlights


@pytest.fixture(scope="module")
def found(painting, products, quick, tile, tmp_path_factory) -> nlights.ComparisonResult:
    rough = quick | {"name": "rough <b>", "integrator": {"use": "simchony", "stencil": "trapezoid"}}
    out = tmp_path_factory.mktemp("comparison")
    return nlights.compare(
        painting, recipes=[quick, rough], out=out, store=products / ".store", progress=False
    )


def test_recipes_are_compared_with_intervals(found):
    assert found.page.is_file()
    written = json.loads(found.page.with_name("compare.json").read_text(encoding="utf-8"))
    assert json.loads(json.dumps(found.record)) == written
    assert found.failures == []
    assert found.sentence.startswith("Against the truth")
    error = found.metrics["angle_error"]
    assert error["unit"] == "°"
    assert [row["name"] for row in error["variants"]] == ["quick", "rough <b>"]
    for row in error["variants"]:
        low, high = row["interval"]
        assert low < row["value"] < high


def test_a_notebook_shows_the_answer_and_error_bars(found):
    html = found._repr_html_()
    assert found.sentence.split(" <")[0] in html
    assert html.count("<table") == html.count("</table>") >= 3
    assert "rough &lt;b&gt;" in html
    assert "rough <b>" not in html
    assert "background:#8a2f1d" in html
    assert "src=" not in html
    assert len(html) < 100_000


def test_the_recipe_that_a_grid_varies_may_be_a_mapping(painting, products, quick, tile, tmp_path, capsys):
    found = nlights.compare(
        [painting],
        grid=["integrator.stencil=6-point,trapezoid"],
        recipe=quick | {"integrator": {"use": "simchony"}},
        out=tmp_path,
        store=products / ".store",
    )
    assert [variant["name"] for variant in found.record["variants"]] == [
        "stencil 6-point",
        "stencil trapezoid",
    ]
    assert all(variant["recipe"]["normals"]["use"] == "least-squares" for variant in found.record["variants"])
    assert "stencil trapezoid: simulated-painting/r0c0: height: " in capsys.readouterr().err


def test_what_is_to_be_mended_is_told_by_the_arguments_name(painting, quick, tmp_path):
    with pytest.raises(nlights.RecipeError, match=r"^recipes, grid: 1 variant given"):
        nlights.compare(painting, recipes=["default"], out=tmp_path / "out")
    with pytest.raises(nlights.RecipeError, match=r"^recipes, grid: the variant 'quick' stands twice"):
        nlights.compare(painting, recipes=[quick, quick], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_when_nothing_can_be_compared_the_failures_are_told(capture, quick, tmp_path):
    (capture / "light_3.tif").unlink()
    rough = quick | {"name": "rough", "integrable": True}
    with pytest.raises(nlights.TileError, match=r"quick: .*light_3.tif[\s\S]*rough: .*light_3.tif"):
        nlights.compare(Path(capture), recipes=[quick, rough], out=tmp_path / "out", progress=False)
