"""A plugin that hangs, crashes, fails or cheats is named, and costs its own tiles only."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nlights_core import stages
from nlights_core.configurations import load_stand
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.store import Store
from nlights_flows.tiles import isolation
from nlights_flows.tiles.run_options import RunOptions

NLIGHTS = Path(sys.executable).parent / "nlights"

RECIPE = """
light_model: {{use: measured-poi}}
detrend:
  images: {{use: inverse-square}}
normals: {{use: least-squares}}
integrator: {{use: {integrator}}}
"""


@pytest.fixture(scope="module")
def plane(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "relief"
    simulate(folder, load_stand("horizontal"), scene="relief", width=96, seed=1)
    return folder


def run(place: Path, rascals: dict[str, str], plane: Path, integrator: str, *options: object):
    recipe = place / f"{integrator}.yaml"
    recipe.write_text(RECIPE.format(integrator=integrator))
    words = [NLIGHTS, "digitise", plane, "--recipe", recipe, "--out", "out", *options]
    done = subprocess.run(
        list(map(str, words)),
        cwd=place,
        env=rascals,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture(scope="module")
def store(rascals, plane, tmp_path_factory) -> Path:
    """A store that holds all that comes before the integrator."""
    place = tmp_path_factory.mktemp("before")
    run(place, rascals, plane, "raises", "--store", place / "store")
    assert list((place / "store").rglob("normals-*"))
    return place / "store"


@pytest.fixture
def digitise(rascals, plane, store, tmp_path):
    def in_store(integrator: str, *options: object, code: int) -> subprocess.CompletedProcess:
        done = run(tmp_path, rascals, plane, integrator, "--store", store, *options)
        assert done.returncode == code, done.stdout + done.stderr
        assert leftovers(store) == []
        return done

    return in_store


def leftovers(folder: Path) -> list[Path]:
    return [*folder.rglob(".draft-*"), *folder.rglob("trace.txt")]


def running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_plugin_that_hangs_is_stopped_and_named_and_leaves_nothing(digitise, tmp_path):
    started = time.monotonic()
    said = digitise("hangs", "--timeout", 5, code=2).stderr
    assert time.monotonic() - started < 60
    assert "integrator: hangs (nlights-rascals 0.1): the stage 'height' was stopped after 5 s" in said
    assert "in nlights_rascals.py:" in said
    assert "allow more with --timeout, choose another algorithm" in said
    if Path("/proc").is_dir():
        assert not running(int((tmp_path / "child.pid").read_text()))


@pytest.mark.parametrize(
    ("integrator", "words"),
    [
        ("crashes", "crashed (signal SIGSEGV) in nlights_rascals.py:"),
        ("leaves", "crashed (exit code 3)"),
        ("hoards", "wanted more memory than a tile may take"),
        ("raises", "failed with KeyError: 'missing' (nlights_rascals.py:"),
        ("scribbles", "changed its input (nlights_rascals.py:"),
        ("microns", "times what the normals say, as in another unit"),
    ],
)
def test_a_plugin_that_fails_is_named_with_slot_and_distribution(digitise, tmp_path, integrator, words):
    said = digitise(integrator, code=2).stderr
    assert f"integrator: {integrator} (nlights-rascals 0.1)" in said
    assert words in said


def test_a_plugin_that_behaves_makes_the_same_bytes_in_a_child(digitise, store, tmp_path):
    (tmp_path / "behave").touch()
    digitise("crashes", code=0)
    digitise("simchony", code=0)
    made = [path.parent for path in store.rglob("height-*/artefact.json")]
    by_name = {json.loads((p / "artefact.json").read_text())["algorithm"]["use"]: p for p in made}
    heights = [(by_name[name] / "height.npy").read_bytes() for name in ("crashes", "simchony")]
    assert heights[0] == heights[1]


def test_every_stage_can_run_in_a_child(plane, tmp_path):
    from nlights_flows.tiles.running import run_directly

    (tile,) = load_capture(plane)
    recipe = load_recipe("default")
    told: list[tuple[str, float]] = []

    def watch(tile: str, stage: str, share: float) -> None:
        told.append((stage, share))

    outcomes = {}
    for name, timeout in (("child", 600.0), ("here", None)):
        options = RunOptions(out=tmp_path / name, timeout=timeout)
        outcomes[name] = run_directly(tile, recipe, options, watch)
        assert outcomes[name].state == "done", outcomes[name].message
    files = {
        name: {
            path.relative_to(tmp_path / name): path.read_bytes()
            for path in (tmp_path / name / ".store").rglob("*.npy")
        }
        for name in outcomes
    }
    assert files["child"] == files["here"]
    assert len(files["here"]) > 10
    assert any(0 < share < 1 for _, share in told)


def test_what_the_capture_is_to_blame_for_is_told_as_without_a_child(plane, tmp_path):
    (tile,) = load_capture(plane)
    store = Store(tmp_path)
    model = load_recipe("default").light_model
    bare = tile.model_copy(update={"stand": None})
    work = stages.lights(store, bare, model)
    with pytest.raises(Exception, match="needs a stand, but the capture names none"):
        isolation.ensure(store, work, bare, (model,), timeout=60)


def test_a_child_does_not_outlive_its_parent(rascals, plane, store, tmp_path):
    recipe = tmp_path / "hangs.yaml"
    recipe.write_text(RECIPE.format(integrator="hangs"))
    words = [NLIGHTS, "digitise", plane, "--recipe", recipe, "--out", "out", "--store", store]
    parent = subprocess.Popen(
        list(map(str, words)),
        cwd=tmp_path,
        env=rascals,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    note, child = tmp_path / "child.pid", 0
    try:
        for _ in range(300):
            if note.exists() and note.read_text():
                child = int(note.read_text())
                break
            time.sleep(0.1)
        assert child, "the plugin was not reached"
        stat = Path(f"/proc/{child}/stat")
        if not stat.exists():
            pytest.skip("processes are looked at in /proc")
        stage = int(stat.read_text().rsplit(")", 1)[1].split()[1])
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        for _ in range(100):
            if not running(stage):
                break
            time.sleep(0.1)
        assert not running(stage)
    finally:
        parent.kill()
        parent.wait()
        if child:
            os.kill(child, signal.SIGKILL)


SECRETS = {
    "PREFECT_API_AUTH_STRING": "operator:hush",
    "PREFECT_SERVER_DATABASE_CONNECTION_URL": "postgresql+asyncpg://nlights:hush@127.0.0.1/nlights",
    "DATABASE_URL": "hush",
    "AWS_SECRET_ACCESS_KEY": "hush",
    "GITHUB_TOKEN": "hush",
    "MYSQL_PWD": "hush",
    "NOTIFY": "https://me:hush@example.org/hook",
    "smtp_password": "hush",
}


def test_a_plugin_is_told_no_secrets_of_the_process_that_runs_it(store, plane, rascals, tmp_path):
    environment = rascals | SECRETS | {"PREFECT_API_URL": "", "HOUSE": "open", "KEYBOARD": "qwertz"}
    done = run(tmp_path, environment, plane, "peeks")
    assert done.returncode == 0, done.stderr
    seen = (tmp_path / "environment.txt").read_text()
    assert "hush" not in seen
    assert "PREFECT" not in seen
    assert {"HOUSE=open", "KEYBOARD=qwertz", f"PATH={environment['PATH']}"} <= set(seen.splitlines())
