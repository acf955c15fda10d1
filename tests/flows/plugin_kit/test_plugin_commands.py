"""The plugin author's day: a new distribution that works at once, its contract, its place in a recipe."""

import json
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import time
import venv
from pathlib import Path

import pytest

from nlights_core.algorithms import Integrator
from nlights_core.errors import PluginError
from nlights_core.fields import HeightMap
from nlights_core.registry import Offer, installed
from nlights_flows.commands.plugins import KindName
from nlights_flows.plugin_kit.contracts import CONTRACTS, choose_offers, run_contract
from nlights_flows.plugin_kit.distributions import begin
from nlights_plugins.integrators import Simchony

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "writing-a-plugin.md"
NLIGHTS = Path(sys.executable).parent / "nlights"
KINDS = [kind.value for kind in KindName]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A distribution of every kind."""
    place = tmp_path_factory.mktemp("made")
    for kind in KINDS:
        begin(f"my-{kind}", kind, place)
    return place


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_distribution_passes_its_tests_at_once(made, kind):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        cwd=made / f"nlights-my-{kind}",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert re.search(r"^\d+ passed", done.stdout, flags=re.MULTILINE)


def test_new_distributions_are_written_in_good_style(made):
    for words in (["check", "--select", "E,F,I,N,B,UP,ANN,D"], ["format", "--check"]):
        options = ["--isolated", "--line-length", "110", "--no-cache"]
        ignored = ["--ignore", "D203,D213,D211,D100,D101,D401"] if words[0] == "check" else []
        for folder in made.iterdir():
            done = subprocess.run(
                [sys.executable, "-m", "ruff", *words, *options, *ignored, "."],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stdout


def test_a_new_distribution_is_whole_and_nothing_else_is_left(tmp_path):
    folder = begin("line-sums", "integrator", tmp_path)
    assert list(tmp_path.iterdir()) == [folder]
    assert {path.name for path in folder.iterdir()} == {
        "README.md",
        "nlights_line_sums.py",
        "pyproject.toml",
        "recipe.yaml",
        "test_nlights_line_sums.py",
    }


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("", "is no name of an algorithm"),
        ("Line", "lower-case words with hyphens"),
        ("two_words", "lower-case words with hyphens"),
        ("a--b", "lower-case words with hyphens"),
        ("../escaped", "lower-case words with hyphens"),
        ("x" * 61, "lower-case words with hyphens"),
        ("simchony", "'simchony' is taken: nlights"),
        ("core", "nlights-core|hide|taken"),
        ("integrator", "its class Integrator would hide one of nLights' own"),
        ("none", "its class None would hide"),
    ],
)
def test_a_name_that_is_taken_or_no_name_is_refused_and_nothing_is_written(tmp_path, name, words):
    with pytest.raises(PluginError, match=words):
        begin(name, "integrator", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_ever_overwritten(tmp_path):
    precious = tmp_path / "nlights-line-sums" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("two years of work")
    done = subprocess.run(
        [NLIGHTS, "plugins", "new", "line-sums", "--kind", "integrator", "--out", tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "is there already and is left as it is" in done.stderr
    assert list(precious.parent.iterdir()) == [precious]


def test_every_kind_has_a_contract_and_every_bundled_algorithm_keeps_it_or_says_why_not():
    unchecked = []
    for offer in choose_offers(installed(), [], everything=True):
        found = run_contract(offer)
        assert found.broken == (), offer.algorithm.name
        if found.unchecked:
            unchecked.append(offer.algorithm.name)
    assert unchecked == ["chrome-sphere", "given-directions"]
    assert set(CONTRACTS) == {
        kind for o in installed().offers() for kind in CONTRACTS if issubclass(o.algorithm, kind)
    }


class UpsideDown(Integrator):
    """Heights that grow away from the camera."""

    name = "upside-down"

    def integrate(self, normals):
        return HeightMap(-Simchony().integrate(normals).height, normals.grid)


class Fussy(Integrator):
    """An option without a default."""

    name = "fussy"
    strictness: int

    def integrate(self, normals):
        raise AssertionError


class Raising(Integrator):
    """Divides by zero."""

    name = "raising"

    def integrate(self, normals):
        return 1 / 0


def test_a_broken_contract_is_told_rule_by_rule():
    found = run_contract(Offer(UpsideDown, "nlights-wrong", "1"))
    assert any(
        rule.startswith("a tilted plane is recovered in mm with y up: plane wrong by")
        for rule in found.broken
    )
    raised = run_contract(Offer(Raising, "nlights-wrong", "1"))
    assert any(
        "ZeroDivisionError: division by zero (test_plugin_commands.py:" in rule for rule in raised.broken
    )


def test_an_option_without_a_default_is_named():
    assert "no default for strictness" in run_contract(Offer(Fussy, "nlights-wrong", "1")).unchecked


def test_plugins_are_chosen_by_name_or_distribution():
    registry = installed()
    assert [o.algorithm.name for o in choose_offers(registry, ["simchony"])] == ["simchony"]
    assert len(choose_offers(registry, ["nlights"])) == len(
        choose_offers(registry, [], everything=True)
    ) - len(choose_offers(registry, []))
    assert all(o.distribution != "nlights" for o in choose_offers(registry, []))
    with pytest.raises(PluginError, match="no algorithm or distribution is called 'simchoni'"):
        choose_offers(registry, ["simchoni"])


def test_check_says_what_is_broken_with_exit_code_1(tmp_path):
    module = tmp_path / "nlights_wrong.py"
    module.write_text(
        "from nlights_core.registry import hookimpl\n"
        "from nlights_plugins.integrators import Simchony\n"
        "class Wrong(Simchony):\n"
        "    name = 'wrong'\n"
        "    def integrate(self, normals):\n"
        "        found = super().integrate(normals)\n"
        "        found.height[:] *= 1000\n"
        "        return found\n"
        "@hookimpl\n"
        "def nlights_algorithms():\n"
        "    return [Wrong]\n"
    )
    record = tmp_path / "nlights_wrong-0.3.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: nlights-wrong\nVersion: 0.3\n")
    (record / "entry_points.txt").write_text("[nlights]\nwrong = nlights_wrong\n")
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    for name, code in (("wrong", 1), ("simchony", 0)):
        done = subprocess.run(
            [NLIGHTS, "plugins", "check", name],
            env=os.environ | {"PYTHONPATH": paths},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert ("nlights-wrong 0.3" in done.stdout) == (name == "wrong")
        assert ("hills wrong by" in done.stdout) == (name == "wrong")
        assert ("kept" in done.stdout) == (name == "simchony")


def test_a_check_that_hangs_or_crashes_is_named_and_costs_its_plugin_only(rascals, tmp_path):
    started = time.monotonic()
    done = subprocess.run(
        [NLIGHTS, "plugins", "check", "hangs", "crashes", "raises", "simchony", "--timeout", "5"],
        cwd=tmp_path,
        env=rascals,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert time.monotonic() - started < 120
    assert done.returncode == 1, done.stdout + done.stderr
    rule = "a tilted plane is recovered in mm with y up"
    hung, crashed = sorted(line for line in done.stderr.splitlines() if "the check '" in line)[::-1]
    assert hung.startswith(
        f"integrator: hangs (nlights-rascals 0.1): the check '{rule}' was stopped after 5 s"
    )
    assert re.search(
        r" in nlights_rascals.py:\d+; allow more with --timeout, or report it to its author", hung
    )
    assert f"crashes (nlights-rascals 0.1): the check '{rule}' crashed (signal SIGSEGV) in" in crashed
    assert f"{rule}: did not end" in done.stdout
    assert "KeyError: 'missing'" in done.stdout
    assert re.search(r"integrator +simchony +nlights \S+ +kept", done.stdout)
    assert "3 of 4 break their contract" in done.stdout
    if Path("/proc").is_dir():
        child = Path("/proc", (tmp_path / "child.pid").read_text())
        # It was killed with its group; whoever inherited it may take a moment to notice.
        deadline = time.monotonic() + 30
        while child.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not child.exists()


def test_the_schema_is_printed_by_the_group_and_by_list():
    def printed(*words: str) -> dict:
        done = subprocess.run([NLIGHTS, "plugins", *words], capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    assert printed("--schema") == printed("list", "--schema")


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    """A virtual environment of its own that sees what is installed in this one, as variables."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, symlinks=True)
    folder = place / "bin"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)}))
    seen = [path for path in sys.path if "site-packages" in path]
    lines = [f"import site; site.addsitedir({path!r})\n" for path in seen]
    (packages / "outer.pth").write_text("".join(lines))
    for command, start in {
        "nlights": "from nlights_flows.commands.cli import main; main()",
        "pip": "import runpy; runpy.run_module('pip', run_name='__main__')",
        "pytest": "import pytest; raise SystemExit(pytest.console_main())",
    }.items():
        script = folder / command
        script.unlink(missing_ok=True)
        script.write_text(f"#!{folder / 'python'}\n{start}\n")
        script.chmod(0o755)
    return os.environ | {
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "VIRTUAL_ENV": str(place),
        # What the plugin is built with and needs is there.
        "PIP_NO_BUILD_ISOLATION": "0",
        "PIP_NO_DEPS": "1",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }


def commands() -> list[str]:
    block = re.search(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert block is not None
    return [line for line in block[1].splitlines() if line and not line.startswith("#")]


def test_the_page_leads_from_nothing_to_a_compared_result_in_under_15_commands(environment, tmp_path):
    assert len(commands()) < 15
    helped = subprocess.run([NLIGHTS, "--help"], capture_output=True, text=True, check=True).stdout
    said = {}
    for command in commands():
        words = shlex.split(command)
        if words[:2] == ["nlights", "compare"] and "compare" not in helped:
            continue
        done = subprocess.run(
            command,
            shell=True,
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        said[" ".join(words[:3])] = done.stdout
    listed = said["nlights plugins"]
    assert re.search(r"integrator +cosine-sums +nlights-cosine-sums 0.1.0", listed), listed
    assert "kept" in said["nlights plugins check"]
    assert re.search(r"mean|median", said["nlights evaluate products/simulated-painting/r0c0"])
    record = next((tmp_path / "products").rglob("height-*/artefact.json"))
    assert json.loads(record.read_text())["origin"] == "nlights-cosine-sums 0.1.0"
    again = subprocess.run(
        ["nlights", "plugins", "new", "cosine-sums", "--kind", "integrator", "--out", "other"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert again.returncode == 2
    assert "'cosine-sums' is taken: nlights-cosine-sums 0.1.0 offers" in again.stderr
