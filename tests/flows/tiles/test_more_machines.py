"""More than one machine: Dask's workers, and two nights, at one store."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from night_processes import free_port

from nlights_core.configurations import load_stand
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.store import Store
from nlights_flows.tiles import dask_runner
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

BIN = Path(sys.executable).parent
WITH_DASK = pytest.mark.skipif(not (BIN / "dask").exists(), reason="Dask is not installed: nlights[dask]")


@pytest.fixture(scope="module")
def three_tiles(tmp_path_factory) -> Path:
    """The same tiny painting at three places."""
    folder = tmp_path_factory.mktemp("more") / "capture"
    simulate(folder, load_stand("horizontal"), scene="painting", width=48, seed=1)
    described = yaml.safe_load((folder / "artwork.yaml").read_text())
    described["artwork"]["id"] = "inv-1"
    described["tiles"] = [{"name": name, "origin_mm": [450 * n, 0]} for n, name in enumerate("abc")]
    (folder / "artwork.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    return folder


def test_a_worker_reads_the_recipe_that_was_sent():
    recipe = load_recipe(
        {**load_recipe("default").record(), "light_model": {"use": "measured-poi", "prior": 1e-5}}
    )
    assert dask_runner._recipe(recipe.name, json.dumps(recipe.record())) == recipe


@pytest.fixture(scope="module")
def done_here(three_tiles, tmp_path_factory) -> dict[str, str]:
    """What this process makes of them."""
    out = tmp_path_factory.mktemp("here")
    recipe, options = load_recipe("default"), RunOptions(out=out)
    for tile in load_capture(three_tiles):
        outcome = run_directly(tile, recipe, options, lambda *told: None)
        assert outcome.state == "done", outcome.message
    return digests(out)


def digests(out: Path) -> dict[str, str]:
    """Digest of every product; the report and the provenance say when and how long, and so differ."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.glob("inv-*/*/*"))
        if path.suffix in (".tif", ".ply", ".glb", ".png")
    }


def nlights(*words) -> subprocess.Popen:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return subprocess.Popen(
        [BIN / "nlights", *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(process: subprocess.Popen) -> str:
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 0, said
    return said


def holds_a_draft(process: int) -> bool:
    """Whether a process holds the mark of a draft: it is in the middle of a tile."""
    for handle in Path(f"/proc/{process}/fd").iterdir():
        with suppress(FileNotFoundError):
            place = handle.readlink()
            if place.name.startswith(".draft-") and ".scratch" not in place.parts:
                return True
    return False


def test_two_dask_workers_make_what_one_process_makes_and_a_killed_one_is_replaced_by_the_other(
    three_tiles, done_here, cluster, tmp_path
):
    address, workers = cluster
    out = tmp_path / "out"
    run = nlights("digitise", three_tiles, "--out", out, "--runner", "dask", "--address", address)
    try:
        until = time.monotonic() + 60
        while not holds_a_draft(workers[0].pid):
            assert time.monotonic() < until
            assert run.poll() is None, ended(run)
            time.sleep(0.005)
        workers[0].kill()
        said = ended(run)
    finally:
        run.kill()
    assert said.count(": done in") == 3, said
    assert digests(out) == done_here
    assert len(done_here) >= 3 * 7
    assert not list(out.rglob(".mark-*"))

    # What is finished is found by whoever asks next, on any machine.
    again = ended(nlights("digitise", three_tiles, "--out", out, "--runner", "dask", "--address", address))
    assert again.count("unchanged") == 3


@WITH_DASK
def test_an_address_where_no_scheduler_is_gives_a_sentence_that_names_the_option(monkeypatch):
    monkeypatch.setattr(dask_runner, "PATIENCE", 0.5)
    nobody = f"tcp://127.0.0.1:{free_port()}"
    with (
        pytest.raises(
            Exception, match=rf"--address: no Dask scheduler answers at '{nobody}'.*dask scheduler"
        ),
        dask_runner.reachable(RunOptions(runner="dask", address=nobody)),
    ):
        pass
    with (
        pytest.raises(CaptureError, match=r"--address: 'nonsense' is no address.*tcp://"),
        dask_runner.reachable(RunOptions(runner="dask", address="nonsense")),
    ):
        pass


def test_a_runner_that_there_is_not_and_an_address_without_a_runner_are_refused():
    with pytest.raises(CaptureError, match=r"--runner: there is no runner 'dusk'; choose one of here, dask"):
        RunOptions(runner="dusk").check()
    with pytest.raises(CaptureError, match=r"--address.*--runner here"):
        RunOptions(address="tcp://10.0.0.5:8786").check()


def test_a_worker_refuses_another_nlights_and_a_folder_of_its_own(three_tiles, tmp_path, monkeypatch):
    monkeypatch.setattr(dask_runner, "SEEN", 1)
    recipe, tile = load_recipe("default"), load_capture(three_tiles)[0]
    store = Store(tmp_path / "store")
    store.prepare()
    job = {
        "tile": json.loads(tile.model_dump_json()),
        "recipe": {"name": recipe.name, "text": json.dumps(recipe.record())},
        "code": ["0.0.0-otherwise"],
        "options": RunOptions(out=tmp_path, store=store.root).plain(),
        "marks": [str(tmp_path / "store")],
    }
    assert "another nLights (" in dask_runner.run_job(job)["message"]
    job["marks"] = [str(tmp_path / "elsewhere" / ".mark-1")]
    assert "mount the same file system" in dask_runner.run_job(job)["message"]
    assert not list(store.root.glob("inv-1"))


def test_two_nights_at_one_store_share_the_tiles_and_make_what_one_process_makes(
    three_tiles, done_here, tmp_path
):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    shutil.copytree(three_tiles, inbox / "inv-1", ignore=shutil.ignore_patterns("truth"))
    (inbox / "inv-1" / "upload-complete").touch()
    runs = [nlights("nightly", inbox, "--out", out) for _ in range(2)]
    try:
        for run in runs:
            ended(run)
    finally:
        for run in runs:
            run.kill()
    assert digests(out) == done_here
    nights = [json.loads(path.read_text()) for path in out.glob("nights/*/night.json")]
    assert len(nights) == 2
    ran = [tile for night in nights for one in night["artworks"] for tile in one["tiles"]]
    assert {tile["state"] for tile in ran} <= {"done", "unchanged"}
    # Each tile is done by one of the two, and found by the other.
    assert sorted(tile["tile"] for tile in ran if tile["state"] == "done") == ["a", "b", "c"]
    assert not [path for path in out.rglob(".draft-*") if path.exists()]
    assert not list(out.glob(".store/.claims/*/*"))
