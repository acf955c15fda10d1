"""`import nlights`: cheap, typed, whole, and safe for a plugin to import."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import nlights
import nlights_core

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "tests" / "example_plugin"


def python(code: str, *, cwd: Path | None = None, paths: tuple[Path, ...] = ()) -> str:
    """What a fresh interpreter prints."""
    seen = os.pathsep.join(map(str, [*paths, *filter(None, [os.environ.get("PYTHONPATH")])]))
    environment = os.environ | {"PYTHONPATH": seen}
    words = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_it_loads_nothing_heavy():
    code = "import sys, nlights; print(*sys.modules)"
    loaded = {name.split(".")[0] for name in python(code).split()}
    assert not loaded & {"numpy", "pydantic", "prefect", "numba", "rich", "scipy", "nlights_flows"}


def test_every_name_is_there_and_listed():
    for name in dir(nlights):
        assert getattr(nlights, name, name) is not None
    assert nlights.__version__ == nlights_core.__version__
    assert {"digitise", "open", "solve", "integrate", "compare", "hookimpl", "TileError"} <= set(dir(nlights))


def test_type_checkers_are_told_the_same_homes():
    source = Path(nlights.__file__).read_text(encoding="utf-8")
    told = {
        name: home
        for home, name, same in re.findall(r"^    from ([\w.]+) import (\w+) as (\w+)$", source, re.MULTILINE)
        if name == same
    }
    assert told == nlights._HOME_OF
    for name, home in told.items():
        assert getattr(nlights, name) is getattr(importlib.import_module(home), name)


def test_a_misspelt_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'nlights' has no attribute 'digitize'"):
        nlights.digitize  # noqa: B018
    with pytest.raises(ImportError, match="digitize"):
        from nlights import digitize  # noqa: F401


def test_it_runs_as_the_command_line():
    done = subprocess.run(
        [sys.executable, "-m", "nlights", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"nlights {nlights.__version__}\n"


def test_it_is_typed(tmp_path):
    pytest.importorskip("mypy")
    script = tmp_path / "script.py"
    script.write_text(
        "from typing import assert_type\n"
        "import numpy as np\n"
        "import nlights\n"
        "from nlights import HeightMap, Integrator, NormalField, TileError, hookimpl\n"
        "tiles = nlights.digitise('capture', recipe={'passes': 1}, progress=False)\n"
        "assert_type(tiles, list[nlights.TileResult])\n"
        "assert_type(tiles[0].height, nlights.Map)\n"
        "assert_type(tiles[0].height.unit, str)\n"
        "assert_type(tiles[0].height.grid, nlights.PixelGrid)\n"
        "assert_type(tiles[0].quality['Known share'].value, float | None)\n"
        "assert_type(nlights.solve(np.ones((3, 4, 5)), np.eye(3)).normals, nlights.Map)\n"
        "assert_type(nlights.integrate(tiles[0].normals, pixel_size=0.5), nlights.Map)\n"
        "assert_type(nlights.compare(['a'], recipes=['default', 'psbox']).sentence, str)\n"
        "assert_type(nlights.open('products/a/b').failed, bool)\n"
        "class Mine(Integrator):\n"
        "    name = 'mine'\n"
        "    def integrate(self, normals: NormalField) -> HeightMap:\n"
        "        raise TileError('none')\n"
        "@hookimpl\n"
        "def nlights_algorithms() -> list[type[Integrator]]:\n"
        "    return [Mine]\n"
        "nlights.digitize('capture')\n"
        "nlights.digitise('capture', recipes='default')\n"
    )
    words = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", script]
    done = subprocess.run(list(map(str, words)), cwd=ROOT, capture_output=True, text=True, check=False)
    faults = [line for line in done.stdout.splitlines() if "error:" in line]
    assert len(faults) == 2, done.stdout + done.stderr
    assert 'script.py:22: error: Module has no attribute "digitize"' in faults[0]
    assert 'script.py:23: error: Unexpected keyword argument "recipes" for "digitise"' in faults[1]


@pytest.fixture
def example(tmp_path) -> tuple[Path, ...]:
    """Where the example plugin is, and what says that it is installed."""
    record = tmp_path / "installed" / "nlights_cosine-0.1.dist-info"
    record.mkdir(parents=True)
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: nlights-cosine\nVersion: 0.1\n")
    (record / "entry_points.txt").write_text("[nlights]\ncosine = nlights_cosine\n")
    return EXAMPLE, record.parent


def test_a_plugin_needs_one_import_line_and_loads_no_flows(example):
    code = "import sys, nlights_cosine; print(nlights_cosine.__file__, *sys.modules)"
    file, *loaded = python(code, paths=example).split()
    assert Path(file).parent == EXAMPLE
    assert {"nlights", "nlights_core.algorithms"} <= set(loaded)
    assert not {name for name in loaded if name.startswith(("nlights_flows", "nlights.", "prefect"))}
    source = (EXAMPLE / "nlights_cosine.py").read_text(encoding="utf-8")
    assert re.findall(r"^.*nlights(?:_core)?[. ].*import.*$", source, flags=re.MULTILINE) == [
        "from nlights import HeightMap, Integrator, NormalField, hookimpl"
    ]


@pytest.mark.parametrize("first", ["nlights_core.registry", "nlights", "nlights_flows.tiles.direct"])
def test_a_plugin_is_found_whatever_was_imported_first(example, first):
    code = f"import {first}; from nlights_core.registry import installed; print(*installed().offers('integrator'))"
    assert "CosineBasis" in python(code, paths=example)


def test_an_installed_plugin_is_used_by_name(example, painting, products, quick, tile, tmp_path):
    code = (
        "import nlights, sys\n"
        f"quick = {quick!r} | {{'integrator': 'cosine-basis'}}\n"
        f"options = {{'out': 'out', 'store': {str(products / '.store')!r}}}\n"
        f"(tile,) = nlights.digitise({str(painting)!r}, recipe=quick, **options)\n"
        "print(tile.provenance['recipe']['integrator']['use'], tile.height.unit)\n"
        "print(nlights.integrate(tile.normals, integrator='cosine-basis').unit)\n"
        "assert 'prefect' not in sys.modules\n"
    )
    assert python(code, cwd=tmp_path, paths=example) == "cosine-basis mm\nmm\n"
