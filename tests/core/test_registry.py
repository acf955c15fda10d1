"""Plugins that cannot be used: told with their names, at no cost to anything else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

NLIGHTS = Path(sys.executable).parent / "nlights"

FAULTS = {
    "imports-nothing": ("import a_module_that_is_not_there\n", "", "a_module_that_is_not_there"),
    "raises": ("raise RuntimeError('no licence on this machine')\n", "", "no licence on this machine"),
    "exits": ("import sys\nsys.exit(3)\n", "", "SystemExit: 3"),
    "of-another-version": ("from nlights_core.algorithms import NormalEstimator\n", "", "NormalEstimator"),
    "names-nothing": ("found = 1\n", ":nowhere", "nowhere"),
    "has-no-hook": ("found = 1\n", "", "has no hook nlights_algorithms"),
    "misspells-its-hook": (
        "from nlights_core.registry import hookimpl\n@hookimpl\ndef nlights_algorithm():\n    return []\n",
        "",
        "nlights_algorithm",
    ),
    "returns-nothing": (
        "from nlights_core.registry import hookimpl\n@hookimpl\ndef nlights_algorithms():\n    return None\n",
        "",
        "should return a list of classes",
    ),
}


def install(site: Path, name: str, code: str, attribute: str = "") -> None:
    module = name.replace("-", "_")
    (site / f"{module}.py").write_text(code)
    record = site / f"{module}-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(f"[nlights]\n{module} = {module}{attribute}\n")


def nlights(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))
    return subprocess.run(
        [NLIGHTS, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=os.environ | {"PYTHONPATH": paths},
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder of installed distributions, each broken in its own way."""
    folder = tmp_path_factory.mktemp("site")
    for name, (code, attribute, _) in FAULTS.items():
        install(folder, name, code, attribute)
    return folder


def test_broken_plugins_that_no_recipe_uses_are_warnings_and_everything_goes_on(site, painting):
    done = nlights(site, "check", painting)
    assert done.returncode == 0, done.stderr
    assert "can be digitised" in done.stdout
    for name, (_, _, words) in FAULTS.items():
        (line,) = (line for line in done.stderr.splitlines() if f"{name} 1.0" in line)
        assert line.startswith("warning: a plugin is not used: ")
        assert words in line
    assert "Traceback" not in done.stderr


def test_a_recipe_that_asks_for_an_unknown_name_is_told_which_plugins_are_broken(site, painting, tmp_path):
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("light_model: measured-poi\nnormals: of-the-broken-plugin\nintegrator: simchony\n")
    done = nlights(site, "digitise", painting, "--recipe", recipe, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "mine.yaml:2: normals.use: no normals is called 'of-the-broken-plugin'" in done.stderr
    assert (
        "    broken: raises 1.0: cannot be loaded (RuntimeError: no licence on this machine)" in done.stderr
    )
    assert not (tmp_path / "out").exists()


def test_the_list_the_doctor_and_the_check_of_plugins_name_what_is_broken(site):
    listed = nlights(site, "plugins")
    assert listed.returncode == 0
    assert "simchony" in listed.stdout
    rows = [line.split() for line in listed.stdout.splitlines() if line.startswith("broken")]
    assert sorted(row[1] for row in rows) == sorted(FAULTS)
    assert "broken: raises 1.0: cannot be loaded" in " ".join(nlights(site, "doctor").stdout.split())
    found = nlights(site, "plugins", "check", "raises")
    assert found.returncode == 1
    assert "no licence on this machine" in found.stdout


def test_without_broken_plugins_nothing_is_said(painting, tmp_path):
    assert nlights(tmp_path, "check", painting).stderr.strip() == ""
