"""The docs cannot lie: what they name exists, and what exists they name."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from nlights_core import fields, stages
from nlights_core.algorithms import KINDS
from nlights_core.manifest import Manifest
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.products.writing import WHAT
from nlights_core.recipe import load_recipe
from nlights_core.registry import installed
from nlights_core.stands import Stand

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {
    "light_model": "light-models.md",
    "detrend.images": "image-detrends.md",
    "normals": "normal-solvers.md",
    "detrend.normals": "normal-detrends.md",
    "integrator": "integrators.md",
    "detrend.height": "height-detrends.md",
}


def text(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("offer", installed().offers(), ids=lambda offer: offer.algorithm.name)
def test_every_bundled_algorithm_and_option_is_on_its_slots_page(offer):
    if offer.distribution != "nlights":
        pytest.skip("not bundled")
    page = text(PAGES[offer.algorithm.slot])
    assert f"`{offer.algorithm.name}`" in page or f"## {offer.algorithm.name}" in page
    for option in offer.algorithm.model_fields:
        assert f"`{option}`" in page, f"{offer.algorithm.name}: {option}"


def test_every_slot_and_kind_is_documented():
    recipes, plugin = text("recipes.md"), text("writing-a-plugin.md")
    for kind in KINDS:
        assert f"`{kind.slot}`" in recipes
        assert f"`{kind.__name__}`" in plugin


def test_every_command_and_option_is_documented():
    page = text("command-line.md")
    nlights = Path(sys.executable).parent / "nlights"

    def options(*words: str) -> set[str]:
        done = subprocess.run([nlights, *words, "--help"], capture_output=True, text=True, check=True)
        return set(re.findall(r"--[a-z]+(?:-[a-z]+)*", done.stdout)) - {"--help"}

    shown = subprocess.run([nlights, "--help"], capture_output=True, text=True, check=True).stdout
    commands = re.findall(r"^│ ([a-z]+)  ", shown, flags=re.MULTILINE)
    assert len(commands) >= 7
    for command in commands:
        assert f"`nlights {command}" in page
        for option in options(command):
            assert f"`{option}`" in page or option in text("tolerance.md"), f"{command} {option}"


def test_the_recipe_of_the_readme_is_the_default_and_the_others_load(tmp_path):
    for path in (ROOT / "README.md", *DOCS.glob("*.md")):
        for i, block in enumerate(blocks(path, "yaml")):
            data = yaml.safe_load(block)
            if "normals" in data:
                file = tmp_path / f"{path.stem}-{i}.yaml"
                file.write_text(block)
                recipe = load_recipe(str(file))
                if path.name == "README.md":
                    assert recipe.record() == load_recipe("default").record()
            elif "artwork" in data:
                Manifest.model_validate(data)
            elif "lamps" in data and "camera" in data:
                Stand.model_validate(data)


def test_the_example_plugin_is_quoted_to_the_letter():
    quoted = blocks(DOCS / "writing-a-plugin.md", "python") + blocks(DOCS / "writing-a-plugin.md", "toml")
    for name in ("nlights_cosine.py", "test_nlights_cosine.py", "pyproject.toml"):
        source = (ROOT / "tests" / "example_plugin" / name).read_text(encoding="utf-8")
        assert source in quoted, name


def test_the_example_plugin_is_under_thirty_lines():
    source = (ROOT / "tests" / "example_plugin" / "nlights_cosine.py").read_text(encoding="utf-8")
    assert len(source.splitlines()) < 30


@pytest.mark.parametrize("path", [ROOT / "README.md", *DOCS.rglob("*.md")], ids=lambda path: path.name)
def test_every_link_leads_somewhere(path):
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        assert (path.parent / target).exists(), target


def test_the_examples_from_python_run_in_order_and_print_what_is_shown(tmp_path, monkeypatch, capsys):
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```\n(?:```text\n(.*?)```)?", page, flags=re.DOTALL)
    assert len(examples[0][0].replace("\n\n", "\n").splitlines()) < 6
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for code, shown in examples:
        exec(compile(code, "docs/python.md", "exec"), names)
        assert capsys.readouterr().out == shown, code


def test_every_page_is_listed():
    listed = text("README.md")
    for path in DOCS.glob("*.md"):
        if path.name != "README.md":
            assert f"({path.name})" in listed, path.name


def entries() -> list[list[str]]:
    """Rows of the glossary: term, what it is, unit and frame, what others call it."""
    rows = [line for line in text("glossary.md").splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[1:]]


def test_every_slot_kind_field_stage_and_product_is_in_the_glossary():
    page = "\n".join(f"{what} {unit}" for _, what, unit, _ in entries())
    for kind in KINDS:
        assert f"`{kind.slot}`" in page
        assert f"`{kind.__name__}`" in page
    kinds_of_field = [
        name for name, kind in vars(fields).items() if getattr(kind, "__module__", "") == fields.__name__
    ]
    assert {"LightField", "NormalField", "HeightMap"} <= set(kinds_of_field)
    for name in (*kinds_of_field, FlatField.__name__, *stages.__all__, *WHAT):
        assert f"`{name}`" in page, name


def test_the_glossary_is_in_alphabetical_order_and_every_term_has_a_unit():
    found = entries()
    assert all(len(entry) == 4 and all(entry) for entry in found)
    terms = [entry[0].casefold() for entry in found]
    assert terms == sorted(set(terms))


OTHER_NAMES_OF_A_FLAT = r"\bplates?\b|white\s+reference|flat\s+reference"


@pytest.mark.parametrize("path", [ROOT / "README.md", *DOCS.rglob("*.md")], ids=lambda path: path.name)
def test_a_flat_is_called_a_flat(path):
    if path.name == "glossary.md":
        pytest.skip("it says what others call it")
    words = path.read_text(encoding="utf-8")
    assert not re.findall(OTHER_NAMES_OF_A_FLAT, words, flags=re.IGNORECASE)


CODE = re.compile(r'(?:CaptureWarning\(\s*|code=)"([a-z-]+)"')


def test_every_code_of_a_warning_is_explained():
    places = [ROOT / "nlights_core", ROOT / "plugins", ROOT / "flows"]
    sources = "".join(path.read_text("utf-8") for place in places for path in place.rglob("*.py"))
    codes = set(CODE.findall(sources))
    assert {"exchanged", "moved", "tone-curve", "stand"} <= codes
    page = (DOCS / "warnings.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| `([a-z-]+)` \|", page, flags=re.MULTILINE))
    assert codes - explained == set()
    assert [code for code in explained if f'"{code}"' not in sources] == []
