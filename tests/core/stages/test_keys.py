"""A key holds the code that its result rests on: all of it, and nothing else."""

import importlib
import shutil

import grimp
import pytest

from nlights_core import registry, stages
from nlights_core.machine import sources
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.registry import installed
from nlights_core.store import Store
from nlights_flows.tiles import planning

STAGES = sorted(stages.__all__)

USED_BY = {
    "light_model": ["lights"],
    "detrend.images": ["flat_field"],
    "normals": ["normals", "bias"],
    "detrend.normals": ["bias"],
    "integrator": ["height"],
    "detrend.height": ["trend"],
}
"""By slot, the stages that call its algorithms."""

DECIDES_NOTHING = {"nlights_core", "nlights_core.errors"}
"""The version, and sentences."""


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph("nlights_core", "nlights_plugins", exclude_type_checking_imports=True)


def rests_on(stage: str) -> set[str]:
    module = importlib.import_module(f"nlights_core.stages.{stage}")
    return {*sources.EVERYTHING_RESTS_ON, *module.RESTS_ON, f"stages.{stage}"}


def unnamed(reached: set[str], named: set[str]) -> set[str]:
    """Modules of the core that are reached, but in no named place."""
    places = [f"nlights_core.{place}" for place in named]
    return {
        module
        for module in reached - DECIDES_NOTHING
        if module.startswith("nlights_core.")
        and not any(module == place or module.startswith(f"{place}.") for place in places)
    }


@pytest.mark.parametrize("stage", STAGES)
def test_what_a_stage_can_reach_is_within_what_it_names(graph, stage):
    reached = graph.find_upstream_modules(f"nlights_core.stages.{stage}")
    assert len(reached) > 10
    assert unnamed(reached, rests_on(stage)) == set()


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_names_no_department_that_it_cannot_reach(graph, stage):
    reached = set(graph.find_upstream_modules(f"nlights_core.stages.{stage}"))
    for offer in installed().offers():
        if registry.is_bundled(offer.algorithm) and stage in USED_BY[offer.algorithm.slot]:
            reached |= graph.find_upstream_modules(offer.algorithm.__module__)
    departments = {module.split(".")[1] for module in reached if module.startswith("nlights_core.")}
    assert set(importlib.import_module(f"nlights_core.stages.{stage}").RESTS_ON) <= departments


BUNDLED = [offer for offer in installed().offers() if registry.is_bundled(offer.algorithm)]
"""The key of somebody else's holds all that plugins may import."""


@pytest.mark.parametrize("offer", BUNDLED, ids=lambda offer: offer.algorithm.name)
def test_what_a_bundled_algorithm_can_reach_is_within_what_its_stages_name(graph, offer):
    reached = graph.find_upstream_modules(offer.algorithm.__module__)
    for stage in USED_BY[offer.algorithm.slot]:
        assert unnamed(reached, rests_on(stage)) == set()


def test_what_plugins_may_import_is_within_what_the_key_of_somebody_elses_holds(graph):
    may = {"algorithms", "capture", "contracts", "fields", "frames", "machine", "memory", "registry"}
    reached: set[str] = set()
    for place in may | set(registry.PLUGINS_REST_ON):
        top = f"nlights_core.{place}"
        for module in {top} | graph.find_descendants(top):
            reached |= {module} | graph.find_upstream_modules(module)
    assert unnamed(reached, {*sources.EVERYTHING_RESTS_ON, *registry.PLUGINS_REST_ON}) == set()


TWO_PASSES = load_recipe(
    {**load_recipe("default").record(), "name": "two-passes", "calibration": "none", "passes": 2}
)
"""What has an overview in place of a calibration."""

ALIGNED = load_recipe({**load_recipe("default").record(), "name": "aligned", "calibration": {"align": True}})


@pytest.fixture
def keys(capture, tmp_path, monkeypatch):
    """The keys of all stages of a capture, in some recipes, by the code of a copy of the core."""
    copy = tmp_path / "core"
    shutil.copytree(sources.CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(sources, "CORE", copy)
    tile = load_capture(capture / "artwork.yaml")[0]
    own: dict[str, dict] = {}

    def found() -> dict[str, str]:
        sources._digest_of_place.cache_clear()
        registry.code_digest.cache_clear()
        unmasked = tile.model_copy(update={"auto_mask": True})
        default, paper = load_recipe("default"), load_recipe("paper")
        for which, recipe, one in (
            ("", default, tile),
            ("", paper, tile),
            ("", TWO_PASSES, tile),
            ("", ALIGNED, tile),
            ("auto-", default, unmasked),
        ):
            steps = planning.plan(one, recipe, Store(tmp_path / "store"))
            own.update({f"{which}{recipe.name} {step.ref.stage}": step.ref.key for step in steps})
        return dict(own)

    yield copy, found
    sources._digest_of_place.cache_clear()
    registry.code_digest.cache_clear()


def changed(before: dict[str, str], after: dict[str, str]) -> set[str]:
    return {name.split()[1] for name in before if before[name] != after[name]}


def test_a_changed_caption_of_the_report_costs_the_report(keys):
    copy, found = keys
    before = found()
    caption = copy / "report" / "chapters.py"
    caption.write_text(caption.read_text() + "\nCAPTION = 'Another'\n")
    assert changed(before, found()) == {"report"}


def test_a_changed_template_of_the_report_costs_the_report(keys):
    copy, found = keys
    before = found()
    (copy / "report" / "templates" / "report.html.j2").write_text("another")
    assert changed(before, found()) == {"report"}


def test_a_changed_kernel_of_the_solver_costs_what_follows_from_it(keys):
    copy, found = keys
    before = found()
    kernel = copy / "solving" / "compiled_reweighting.py"
    kernel.write_text(kernel.read_text() + "\n# faster\n")
    after = found()
    assert changed(before, after) == {
        "overview", "calibration", "bias", "normals", "height", "trend", "level", "maps", "mesh", "report"
    }  # fmt: skip
    for recipe in ("default", "paper", "two-passes"):
        for stage in ("lights", "flat_field"):
            assert before[f"{recipe} {stage}"] == after[f"{recipe} {stage}"]


DEPARTMENTS = sorted(
    {path.parent.name for path in sources.CORE.glob("*/*.py")} - {"stages", "simulation", "testing"}
)


@pytest.mark.parametrize("place", DEPARTMENTS)
def test_a_file_in_any_depth_of_a_department_changes_the_keys_of_the_stages_that_name_it(keys, place):
    copy, found = keys
    before = found()
    (copy / place / "deeper").mkdir()
    (copy / place / "deeper" / "new.py").write_text("X = 1\n")
    own = {stage for stage in STAGES if place in rests_on(stage)}
    assert own
    assert own <= changed(before, found())


@pytest.mark.parametrize("place", ["errors.py", "manifest.py", "__init__.py", "simulation/scenes.py"])
def test_what_decides_nothing_costs_nothing(keys, place):
    copy, found = keys
    before = found()
    (copy / place).write_text("# another\n")
    assert changed(before, found()) == set()


def test_another_version_with_the_same_code_costs_nothing(keys, monkeypatch):
    _, found = keys
    before = found()
    monkeypatch.setattr("nlights_core.store.references.__version__", "9.9.9")
    monkeypatch.setattr(registry.Offer, "origin", property(lambda self: "nlights 9.9.9"))
    assert found() == before


def test_a_stage_that_changes_costs_itself_and_what_follows(keys):
    copy, found = keys
    before = found()
    (copy / "stages" / "mesh.py").write_text("# another\n")
    assert changed(before, found()) == {"mesh", "report"}


def test_a_helper_in_the_package_of_somebody_elses_plugin_changes_its_key(tmp_path, monkeypatch):
    package = tmp_path / "nlights_guest"
    (package / "inner").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "inner" / "__init__.py").write_text("")
    (package / "helper.py").write_text("SCALE = 1\n")
    (package / "inner" / "solvers.py").write_text(
        "from tests_guest import Guest as Base\nclass Guest(Base): pass\n"
    )
    (tmp_path / "tests_guest.py").write_text(
        "from nlights_core.algorithms import NormalSolver\nclass Guest(NormalSolver): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    guest = importlib.import_module("nlights_guest.inner.solvers").Guest
    before = registry.code_digest(guest)
    registry.code_digest.cache_clear()
    assert registry.code_digest(guest) == before
    (package / "helper.py").write_text("SCALE = 2\n")
    registry.code_digest.cache_clear()
    assert registry.code_digest(guest) != before


def test_a_folder_without_files_has_no_digest(tmp_path):
    with pytest.raises(ValueError, match="no files"):
        sources.digest_of_files([], tmp_path)


def test_hidden_files_and_what_python_makes_are_no_source(tmp_path):
    for name in ("a.py", "__pycache__/a.pyc", ".hidden", "deep/b.txt", "deep/.x/c.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    assert {p.relative_to(tmp_path).as_posix() for p in sources.files_below(tmp_path)} == {
        "a.py",
        "deep/b.txt",
    }
