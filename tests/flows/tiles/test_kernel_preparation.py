"""Compiled loops are prepared beforehand, or beside the first painting, and that is said."""

import os
import re
import subprocess
import sys
from contextlib import contextmanager

import pytest

from nlights_core.configurations import load_stand
from nlights_core.machine import compilation, kernel_cache
from nlights_core.machine.targets import NATIVE, supported_targets
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_flows.tiles import kernel_preparation
from nlights_flows.tiles.examination import facts
from nlights_flows.tiles.kernel_preparation import compiled_beside, measure_tiny

DIGITISE = """
import pathlib, sys
from nlights_core.configurations import load_stand
from nlights_core.machine import compilation, kernel_cache
if sys.argv[1] != "as it is":
    kernel_cache.INSTALLED = pathlib.Path(sys.argv[1])
sys.argv = ["nlights", "digitise", *sys.argv[2:]]
from nlights_flows.commands.cli import main
try:
    main()
finally:
    print("compiled", len(compilation.so_far().names), *compilation.so_far().names)
"""


def digitise(installed: str, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-P", "-c", DIGITISE, installed, *words],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """A painting of a usual size: its mesh has fewer faces than its height."""
    folder = tmp_path_factory.mktemp("usual") / "painting"
    simulate(folder, load_stand("horizontal"), scene="painting", width=800, seed=1)
    return folder


@pytest.mark.parametrize("recipe", ["default", "paper", "paper-compensated", "psbox"])
def test_a_prepared_installation_compiles_nothing_for_a_painting(usual, tmp_path, recipe):
    if not any(map(kernel_cache.is_prepared, [target.name for target in supported_targets()] or [NATIVE])):
        pytest.skip("the loops were not prepared: nlights doctor --warm")
    done = digitise("as it is", str(usual), "--recipe", recipe, "--out", str(tmp_path / "out"))
    assert "compiled 0\n" in done.stdout, done.stdout
    assert "once per machine" not in done.stderr


def test_a_first_painting_says_that_it_compiles_and_a_second_one_does_not(painting, tmp_path):
    words = ("/dev/null/compiled", str(painting), "--recipe", "psbox", "--out")
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "NUMBA_CACHE_DIR": ""}
    first = digitise(*words, str(tmp_path / "first"), **cache)
    assert first.stderr.count("compiling loops, once per machine") == 1
    assert "compiled 0\n" not in first.stdout
    assert re.search(r"^compiled \d+ loops$", first.stderr, re.MULTILINE)
    second = digitise(*words, str(tmp_path / "second"), **cache)
    assert "once per machine" not in second.stderr
    assert "compiled 0\n" in second.stdout
    for name in ("normals.tif", "height.tif", "mesh.ply"):
        one, other = ((tmp_path / way / "simulated-painting/r0c0" / name) for way in ("first", "second"))
        assert one.read_bytes() == other.read_bytes()


def test_a_second_process_begins_with_the_first_loop_that_is_compiled_and_ends_with_the_run(monkeypatch):
    begun, ended = [], []
    real = kernel_preparation.children.child

    @contextmanager
    def noted(module, job, scratch):
        begun.append(job)
        with real(module, job, scratch) as child:
            yield child
        ended.append(job)

    monkeypatch.setattr(kernel_preparation.children, "child", noted)
    monkeypatch.setattr(kernel_preparation, "cores", lambda: 2)
    recipe = load_recipe("default")
    with compiled_beside(recipe):
        pass
    assert not begun
    with compiled_beside(recipe):
        compilation.begin("a")
        compilation.begin("b")
        assert [job["runs"][0]["recipe"]["passes"] for job in begun] == [1]
        assert not ended
    assert begun == ended


def test_a_second_tiny_painting_in_8_bits_finds_everything_compiled():
    run = {"recipe": {**load_recipe("default").record(), "passes": 1}, "bits": 8, "until": "normals"}
    measure_tiny([run])
    before = len(compilation.so_far().names)
    measure_tiny([run])
    assert len(compilation.so_far().names) == before


def test_the_doctor_says_what_there_is():
    found = dict(facts())
    assert found["nLights"] == "0.1.0"
    assert "numba 0" in found["Packages"]
    assert "GiB" in found["Memory"]
    assert "GiB free" in found["Disk"]
    assert "prepared" in found["Compiled loops"]
