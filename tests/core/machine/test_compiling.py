"""Compiled loops: which are called from where, and by what they are found again."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nlights_core.machine import kernel_cache, sources
from nlights_core.machine.kernel_cache import kernel_modules, place_of

CORE = sources.CORE

USE = """
import pathlib, sys
import numpy as np
from nlights_core.machine import kernel_cache
kernel_cache.INSTALLED = pathlib.Path(sys.argv[1])
from nlights_core.files.reduction import block_means
from nlights_core.machine import compilation
assert (block_means(np.ones((4, 4), np.float32), 2) == 1).all()
print(len(compilation.so_far().names), compilation.so_far().lost)
"""


def decorated(tree: ast.Module, decorator: str) -> set[str]:
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    return {f.name for f in functions if decorator in map(ast.unparse, f.decorator_list)}


def test_loops_without_a_way_in_are_called_by_loops_only():
    """To call one from Python would kill the process."""
    trees = {path: ast.parse(path.read_text()) for path in CORE.rglob("*.py")}
    inner = {
        (f"nlights_core.{path.relative_to(CORE).with_suffix('').as_posix().replace('/', '.')}", name)
        for path, tree in trees.items()
        for name in decorated(tree, "inner")
    }
    assert len(inner) > 40
    roots = [CORE.parent / "tests", CORE.parent / "plugins", CORE.parent / "benchmarks"]
    for root in roots:
        trees |= {path: ast.parse(path.read_text()) for path in root.rglob("*.py")}
    for path, tree in trees.items():
        if path.name.startswith("compiled_") or path.name == "blocks.py":
            continue
        modules = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    assert (node.module, alias.name) not in inner, f"{path}: {alias.name}"
                    modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                assert (modules.get(node.value.id), node.attr) not in inner, f"{path}: {node.attr}"


def use(folder: Path, core: Path = CORE, installed: str = "/dev/null/compiled") -> tuple[int, str]:
    """Call a compiled loop in a process of its own: how many it compiled, and the folder that was lost."""
    path = os.pathsep.join([str(core.parent), str(CORE.parent / "plugins"), str(CORE.parent / "flows")])
    own = os.environ | {"PYTHONPATH": path, "XDG_CACHE_HOME": str(folder)}
    own.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-P", "-c", USE, installed], env=own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    count, lost = done.stdout.split()
    return int(count), lost


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A user's folder in which one loop is compiled already."""
    folder = tmp_path_factory.mktemp("cache")
    assert use(folder)[0] == 1
    return folder


def test_the_next_process_finds_what_was_compiled(prepared):
    assert use(prepared) == (0, "None")


def test_another_folder_and_other_dates_find_it_too(prepared, tmp_path):
    copy = tmp_path / "elsewhere" / "nlights_core"
    shutil.copytree(CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for path in copy.rglob("*.py"):
        os.utime(path)
    assert use(prepared, copy) == (0, "None")


def test_other_code_compiles_anew(prepared, tmp_path):
    copy = tmp_path / "elsewhere" / "nlights_core"
    shutil.copytree(CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    path = copy / "files" / "compiled_means.py"
    path.write_text(path.read_text() + "\n# another\n")
    assert use(prepared, copy)[0] == 1


def test_half_a_file_is_compiled_anew(prepared, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(prepared, folder)
    for path in folder.rglob("*.nbc"):
        path.write_bytes(path.read_bytes()[:100])
    assert use(folder)[0] == 1
    assert use(folder)[0] == 0


def test_a_folder_in_which_others_may_write_is_not_believed(prepared, tmp_path):
    folder = tmp_path / "cache"
    shutil.copytree(prepared, folder)
    (folder / "nlights" / "compiled").chmod(0o777)
    assert use(folder)[0] == 1


def test_without_a_home_it_still_runs(tmp_path):
    """As an account of a service that has none; what it compiles is not kept."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    for _ in range(2):
        assert use(blocked, installed=str(blocked / "compiled"))[0] == 1


def test_what_is_in_the_installation_serves_an_account_without_a_home(prepared, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert use(blocked, installed=str(prepared / "nlights" / "compiled")) == (0, "None")


def test_what_a_user_compiled_is_copied_to_the_installation_and_other_code_is_deleted(
    prepared, tmp_path, monkeypatch
):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(prepared / "nlights" / "compiled"))
    monkeypatch.setattr(kernel_cache, "INSTALLED", tmp_path / "compiled")
    (tmp_path / "compiled" / "files.compiled_means-0000000000000000").mkdir(parents=True)
    assert kernel_cache.install() == tmp_path / "compiled"
    names = [path.name for path in (tmp_path / "compiled").iterdir()]
    assert names == [place_of("nlights_core.files.compiled_means")]
    assert use(tmp_path, installed=str(tmp_path / "compiled")) == (0, "None")


def test_a_loop_is_found_by_all_that_it_is_made_of_and_nothing_else(tmp_path, monkeypatch):
    copy = tmp_path / "nlights_core"
    shutil.copytree(CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(sources, "CORE", copy)
    monkeypatch.setattr(kernel_cache, "CORE", copy)

    def places() -> dict[str, str]:
        place_of.cache_clear()
        return {module: place_of(module) for module in kernel_modules()}

    before = places()
    (copy / "report" / "chapters.py").write_text("# another\n")
    assert places() == before
    constants = copy / "solving" / "robust_fitting.py"
    constants.write_text(constants.read_text() + "\nTUKEY = 5.0\n")
    after = places()
    changed = {module.rpartition(".")[2] for module in before if before[module] != after[module]}
    assert "compiled_reweighting" in changed
    assert "compiled_meshes" not in changed
    place_of.cache_clear()


def test_what_a_module_reaches_are_files_that_its_imports_name(tmp_path, monkeypatch):
    (tmp_path / "deep").mkdir()
    (tmp_path / "a.py").write_text("from nlights_core.deep import (\n    b,\n)\n")
    (tmp_path / "deep" / "b.py").write_text("def f():\n    from nlights_core.c import X\n")
    (tmp_path / "c.py").write_text("X = 1\n")
    (tmp_path / "d.py").write_text("from nlights_core.a import b\n")
    monkeypatch.setattr(sources, "CORE", tmp_path)
    found = [path.relative_to(tmp_path).as_posix() for path in sources.reached_files(["nlights_core.a"])]
    assert found == ["a.py", "c.py", "deep/b.py"]
