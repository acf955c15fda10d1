"""Variants from files and from grids, and what is said of those that cannot be."""

import pytest

from nlights_core.errors import RecipeError
from nlights_core.recipe import load_recipe
from nlights_flows.commands.compare import spread
from nlights_flows.comparison.variants import folder_of, variants_of


def test_a_grid_makes_every_combination_under_readable_names():
    found = variants_of([], ["integrator=simchony,frankot-chellappa", "passes=1,3"])
    assert [recipe.name for recipe in found] == [
        "simchony + passes 1",
        "simchony + passes 3",
        "frankot-chellappa + passes 1",
        "frankot-chellappa + passes 3",
    ]
    assert found[0].record() == {**load_recipe("default").record(), "passes": 1}
    assert found[3].integrator.name == "frankot-chellappa"


def test_options_follow_the_slot_whatever_the_order_on_the_command_line():
    found = variants_of([], ["normals.shadow=0.02,0.05", "normals=robust,least-squares"])
    assert [(recipe.normals.name, recipe.normals.shadow) for recipe in found] == [
        ("robust", 0.02),
        ("least-squares", 0.02),
        ("robust", 0.05),
        ("least-squares", 0.05),
    ]
    assert found[0].name == "shadow 0.02 + robust"


def test_a_detrend_can_be_left_out_or_put_in():
    without, put_in = variants_of([], ["detrend.height=none,parabolic-fit"])
    assert without.detrend.height is None
    assert without.name == "no detrend.height"
    assert put_in.detrend.height.name == "parabolic-fit"
    assert put_in.detrend.images.name == "flat-field"


def test_values_are_read_as_yaml_scalars():
    on, off = variants_of([], ["integrable=true,off"])
    assert (on.integrable, off.integrable) == (True, False)
    assert [on.name, off.name] == ["integrable on", "integrable off"]


def test_variants_seek_what_their_recipe_seeks_unless_the_grid_says_otherwise():
    everything = load_recipe("default").calibration
    for variant in variants_of([], ["normals=robust,least-squares"]):
        assert variant.calibration == everything
    on, off, none = (
        variants_of([], ["calibration.lamps=true,false"])
        + variants_of([], ["calibration=none", "passes=1,2"])[:1]
    )
    assert [on.name, off.name, none.name] == ["lamps on", "lamps off", "calibration none + passes 1"]
    assert (on.calibration, none.calibration) == (everything, None)
    assert off.calibration == everything.model_copy(update={"lamps": False})
    added = variants_of([], ["calibration.gloss=true,false"], "paper")[1].calibration
    assert added == everything.model_copy(update={"gloss": False})


def test_files_and_a_grid_add_up():
    names = [recipe.name for recipe in variants_of(["psbox"], ["passes=1,2"], "paper")]
    assert names == ["psbox", "passes 1", "passes 2"]


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ("integrator", "--grid integrator: should be like"),
        ("integratr=simchony", "did you mean 'integrator'?"),
        ("integrator=simchonny", "no algorithm is called 'simchonny'; did you mean 'simchony'?"),
        ("integrator=3", "should be the name of an algorithm; got 3"),
        ("normals.shadow=-1", "--grid normals.shadow: should be at least 0; got -1"),
        ("normals.shadow=yes", "--grid normals.shadow: should be a number; got True"),
        ("normals.shade=0.1", "--grid normals.shade: unknown field; allowed here: shadow"),
        ("passes=0", "--grid passes: should be at least 1; got 0"),
        ("passes=9", "--grid passes: should be at most 5; got 9"),
        ("calibration=3", "--grid calibration: "),
        ("calibration.lamp=true", "--grid calibration.lamp: unknown field"),
        ("calibration.lamps=perhaps", "--grid calibration.lamps: "),
        ("passes=1,1", "the value 1 stands twice"),
        ("passes=[1,2]", "should be plain values between commas"),
        ("passes=1,", "should be plain values between commas"),
        ("detrend.height.degree=2", "there is no detrend.height in the recipe 'default'"),
    ],
)
def test_a_fault_of_the_grid_names_the_option_what_was_found_and_what_is_allowed(grid, said):
    with pytest.raises(RecipeError) as fault:
        variants_of(["psbox"], [grid])
    assert said in str(fault.value)
    assert str(fault.value).startswith("--grid")


def test_a_field_given_twice_one_variant_and_too_many_are_refused():
    with pytest.raises(RecipeError, match="stands twice"):
        variants_of([], ["passes=1", "passes=2"])
    with pytest.raises(RecipeError, match="a comparison needs two"):
        variants_of(["default"], [])
    many = ",".join(str(i / 100) for i in range(70))
    with pytest.raises(RecipeError, match="at most 64"):
        variants_of([], [f"normals.shadow={many}"])


def test_recipes_of_the_same_file_name_are_told_apart(tmp_path):
    text = "light_model: measured-poi\nnormals: robust\nintegrator: simchony\n"
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.yaml").write_text(text)
    paths = [str(tmp_path / folder / "mine.yaml") for folder in ("a", "b")]
    names = [recipe.name for recipe in variants_of(paths, [])]
    assert names == paths


def test_no_name_of_a_variant_leads_out_of_the_folder():
    recipe = load_recipe("default")
    for name in ("..", "../x", "/etc/x", "a\x00b", ". .", "<script>"):
        folder = folder_of(recipe.model_copy(update={"name": name}))
        assert "/" not in folder
        assert folder.strip(". ")


def test_several_values_behind_one_option_are_spread():
    assert spread(["a", "--grid", "x=1", "y=2", "--out", "o"]) == [
        "a", "--grid", "x=1", "--grid", "y=2", "--out", "o",
    ]  # fmt: skip
    assert spread(["--recipes=p", "q", "--", "a"]) == ["--recipes", "p", "--recipes", "q", "--", "a"]
    assert spread(["a", "--recipes"]) == ["a", "--recipes"]
