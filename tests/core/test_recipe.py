"""Recipes and the registry: what is installed, what is shipped, and what is refused at the door."""

import json
import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import pytest

from nlights_core.algorithms import Algorithm, HeightDetrend, Integrator
from nlights_core.capture import GivenLights, Sphere, Tile
from nlights_core.configurations import load_stand, shipped_names
from nlights_core.errors import PluginError, RecipeError
from nlights_core.fields import HeightMap, NormalField
from nlights_core.recipe import FOR_CAPTURES, choose, fitting, load_recipe, recipe_schema
from nlights_core.registry import Offer, Registry, installed

SCHEMA = Path(__file__).parents[2] / "configs" / "recipe.schema.json"


def bundled() -> Registry:
    return Registry(offer for offer in installed().offers() if offer.distribution == "nlights")


@pytest.mark.parametrize("name", shipped_names("recipes"))
def test_every_shipped_recipe_loads_pickles_and_survives_its_own_record(name, tmp_path):
    import yaml

    recipe = load_recipe(name)
    assert pickle.loads(pickle.dumps(recipe)) == recipe
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump(recipe.record()))
    assert load_recipe(str(path)) == recipe


FRAMES = {lamp: Path(f"{lamp}.tif") for lamp in ("a", "b", "c")}
STAND = load_stand("horizontal")
SPHERES = (Sphere(frames=FRAMES),)
LISTED = GivenLights(directions=Path("lamps.lp"))


@pytest.mark.parametrize(
    ("has", "fits"),
    [
        ({"stand": STAND, "flats": FRAMES}, ["default", "no-flats"]),
        ({"stand": STAND}, ["no-flats"]),
        ({"spheres": SPHERES}, ["chrome-sphere"]),
        ({"lights": LISTED, "spheres": SPHERES}, ["given-directions", "chrome-sphere"]),
        ({"flats": FRAMES}, []),
    ],
)
def test_a_recipe_that_does_not_fit_names_those_that_do(has, fits):
    tile = Tile(artwork="a", name="t", frames=FRAMES, **has)
    assert fitting(tile) == fits
    for name in fits:
        assert load_recipe(name).lacking(tile) == []
    lacking = load_recipe("paper").lacking(tile)
    if {"stand", "flats"} <= set(has):
        assert lacking == []
    else:
        assert [name for name in FOR_CAPTURES if f"--recipe {name}" in lacking[-1]] == fits
        assert fits or "add a stand, chrome_spheres or lights" in lacking[-1]


def test_a_capture_with_spheres_alone_is_told_its_recipe_word_for_word():
    tile = Tile(artwork="a", name="t", frames=FRAMES, spheres=SPHERES)
    assert (
        "the manifest lists chrome_spheres: --recipe chrome-sphere"
        in load_recipe("default").lacking(tile)[-1]
    )


def test_the_schema_beside_the_recipes_is_true():
    expected = json.dumps(recipe_schema(bundled()), indent=1) + "\n"
    assert SCHEMA.read_text(encoding="utf-8") == expected, (
        "run: python -m tests.core.test_recipe, to write configs/recipe.schema.json anew"
    )


def test_every_fault_is_told_at_once_with_its_line(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(
        "light_model: {use: measured-poi}\nnormals: {use: least-squares, shadow: -1}\n"
        "integrator: {use: simchonny}\npasses: 9\n"
    )
    with pytest.raises(RecipeError) as fault:
        load_recipe(str(path))
    said = str(fault.value)
    assert "bad.yaml:2: normals.shadow: should be at least 0; got -1" in said
    assert "bad.yaml:3: integrator.use: no integrator is called 'simchonny'; did you mean 'simchony'?" in said
    assert "available: frankot-chellappa  (nlights 0.1.0)" in said


def test_what_a_file_would_hold_is_a_recipe_too():
    recipe = load_recipe("default")
    assert load_recipe({**recipe.record(), "name": "default"}) == recipe
    assert load_recipe(recipe) is recipe
    assert load_recipe(Path(SCHEMA.parent / "recipes" / "paper.yaml")) == load_recipe("paper")
    small = {**recipe.record(), "light_model": {"use": "measured-poi", "prior": 1e-5}}
    assert (load_recipe(small).name, load_recipe(small).light_model.prior) == ("recipe", 1e-5)
    with pytest.raises(RecipeError) as fault:
        load_recipe({"name": "mine", "normals": {"use": "robust", "shade": 1}, "integrator": 3, "pass": 1})
    said = str(fault.value).splitlines()
    assert [line.partition(": ")[2].partition(": ")[0] for line in said] == [
        "pass",
        "light_model",
        "normals.shade",
        "integrator",
    ]
    assert all(line.startswith("mine: ") for line in said)


LEAST = {"light_model": "measured-poi", "normals": "robust", "integrator": "simchony"}
EVERYTHING = ("level", "lamps", "gloss", "departure", "ambient", "flat-gloss")


@pytest.mark.parametrize(
    ("given", "sought"),
    [
        ({}, None),
        ({"calibration": "none"}, None),
        ({"calibration": {}}, EVERYTHING),
        ({"calibration": {"level": False}}, EVERYTHING[1:]),
        ({"calibration": {"gloss": False, "lamps": False}}, ("level", "departure", "ambient")),
        ({"calibration": dict.fromkeys(("level", "lamps", "gloss", "departure", "ambient"), False)}, ()),
    ],
)
def test_a_recipe_says_what_is_sought_in_a_tiles_own_photographs(given, sought):
    recipe = load_recipe({**LEAST, **given})
    assert (recipe.calibration and recipe.calibration.groups()) == sought
    again = load_recipe({**recipe.record(), "name": recipe.name})
    assert again == recipe
    assert (
        recipe.record()["calibration"] == "none"
        if sought is None
        else {"level", "lamps"} < set(recipe.record()["calibration"])
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("nonne", "calibration: should be none, or a mapping of level, lamps, .* true or false; got 'nonne'"),
        (True, "calibration: should be none, or a mapping of .*; got True"),
        (["level"], r"calibration: should be none, or a mapping of .*; got \['level'\]"),
        ({"lamp": True}, "calibration.lamp: unknown field; did you mean 'lamps'.*: level, lamps, gloss, "),
        ({"level": "perhaps"}, "calibration.level: .*; got 'perhaps'"),
        ({"gloss": 3}, "calibration.gloss: .*; got 3"),
    ],
)
def test_what_a_calibration_cannot_seek_is_named(given, said):
    with pytest.raises(RecipeError, match=said):
        load_recipe({**LEAST, "calibration": given})


def test_the_default_seeks_everything_and_recipes_of_others_nothing():
    assert load_recipe("default").calibration.groups() == EVERYTHING
    for name in ("paper", "paper-compensated", "psbox"):
        assert load_recipe(name).calibration is None


def test_an_algorithm_is_chosen_outside_a_recipe_as_in_one():
    assert (
        choose("detrend.height", "parabolic-fit", {}, "trial")
        == installed().get("detrend.height", "parabolic-fit").algorithm()
    )
    with pytest.raises(
        RecipeError, match=r"trial: detrend.height.use: no detrend of height is called 'parabola'"
    ):
        choose("detrend.height", "parabola", {}, "trial")


def test_an_algorithm_of_another_slot_is_no_answer(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("light_model: simchony\nnormals: least-squares\nintegrator: simchony\n")
    with pytest.raises(RecipeError, match="no light model is called 'simchony'"):
        load_recipe(str(path))


class Half(Integrator):
    name: ClassVar[str] = "half"


class Nameless(HeightDetrend):
    def trend(self, height: HeightMap):
        return height.height * 0


class Stray(Algorithm):
    slot: ClassVar[str] = "nowhere"
    name: ClassVar[str] = "stray"


class Twin(Integrator):
    name: ClassVar[str] = "simchony"

    def integrate(self, normals: NormalField) -> HeightMap:
        return HeightMap(normals.normals[..., 2], normals.grid)


def refused(classes: Iterable[object]) -> str:
    """What is said of algorithms that cannot be used; all others can be."""
    registry = Registry([*installed().offers(), *(Offer(cls, "shady", "1.0") for cls in classes)])  # type: ignore[arg-type]
    assert registry.offers() == installed().offers()
    assert {plugin.origin for plugin in registry.broken} == {"shady 1.0"}
    return "\n".join(plugin.why for plugin in registry.broken)


def test_what_could_fail_at_night_is_told_at_start_with_its_distribution_and_costs_no_other():
    said = refused([Half, Nameless, Stray, int])
    assert "shady 1.0: Half lacks integrate" in said
    assert "shady 1.0: Nameless has no name" in said
    assert "shady 1.0: Stray is of no known kind" in said
    assert "no subclass of Algorithm" in said


def test_a_name_that_two_distributions_offer_fails_only_where_it_is_used():
    registry = Registry([*installed().offers(), Offer(Twin, "shady", "1.0")])
    assert registry.get("integrator", "frankot-chellappa") is not None
    with pytest.raises(PluginError, match=r"is offered by nlights 0\.1\.0 and by shady 1\.0; uninstall one"):
        registry.get("integrator", "simchony")
    recipe = {"light_model": "measured-poi", "normals": "robust", "integrator": "simchony"}
    with pytest.raises(RecipeError, match=r"recipe: integrator\.use: integrator: 'simchony' is offered by"):
        load_recipe(recipe, registry)
    assert load_recipe({**recipe, "integrator": "frankot-chellappa"}, registry).name == "recipe"


def test_every_bundled_algorithm_has_documented_bounded_options():
    for offer in bundled().offers():
        assert offer.algorithm.__doc__
        for name, field in offer.algorithm.model_fields.items():
            assert field.description, f"{offer.algorithm.name}.{name} is not described"


if __name__ == "__main__":
    SCHEMA.write_text(json.dumps(recipe_schema(bundled()), indent=1) + "\n", encoding="utf-8")
