"""The Prefect flow against a real Prefect server: the same chain, the same artefacts."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import yaml

BIN = Path(sys.executable).parent
SWITCHES = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def post(url: str, body: dict) -> list[dict]:
    request = urllib.request.Request(
        url, json.dumps(body).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.load(answer)


@pytest.fixture(scope="module")
def api(tmp_path_factory):
    """A Prefect server of its own on a loopback port."""
    home, port = tmp_path_factory.mktemp("prefect"), free_port()
    environment = {**os.environ, **SWITCHES, "PREFECT_HOME": str(home), "PREFECT_API_URL": ""}
    environment.pop("PREFECT_API_URL")
    log = (home / "server.log").open("w")
    server = subprocess.Popen(
        [BIN / "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"],
        env=environment,
        stdout=log,
        stderr=subprocess.STDOUT,
    )
    url = f"http://127.0.0.1:{port}/api"
    try:
        for _ in range(240):
            try:
                urllib.request.urlopen(f"{url}/health", timeout=2).close()
                break
            except (urllib.error.URLError, OSError):
                if server.poll() is not None:
                    break
                time.sleep(0.5)
        else:
            server.kill()
        if server.poll() is not None:
            pytest.fail("the Prefect server did not start:\n" + (home / "server.log").read_text())
        yield url, {**environment, "PREFECT_API_URL": url}
    finally:
        server.terminate()
        server.wait(timeout=60)
        log.close()


def nlights(environment, *words, code=0) -> subprocess.CompletedProcess:
    done = subprocess.run(
        [BIN / "nlights", *map(str, words)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def made(store: Path) -> dict[str, float]:
    records = store.rglob("artefact.json")
    return {str(path.parent.relative_to(store)): path.stat().st_mtime for path in records}


def direct(environment: dict) -> dict:
    return {name: value for name, value in environment.items() if name != "PREFECT_API_URL"}


def test_the_flow_finds_what_the_direct_call_made_and_makes_the_same(painting, tmp_path, api):
    url, environment = api
    nlights(direct(environment), "digitise", painting, "--out", tmp_path / "a")
    before = made(tmp_path / "a" / ".store")

    # A configured API means the flow; on the same store everything is there already.
    done = nlights(environment, "digitise", painting, "--out", tmp_path / "a")
    assert "unchanged" in done.stdout
    assert made(tmp_path / "a" / ".store") == before
    runs = post(f"{url}/task_runs/filter", {})
    assert {run["state"]["name"] for run in runs} == {"Cached"}
    assert {run["name"] for run in runs} >= {"r0c0 lights", "r0c0 normals", "r0c0 report"}

    # On a store of its own it makes the same, byte for byte.
    nlights(environment, "digitise", painting, "--out", tmp_path / "b", "--prefect")
    assert set(made(tmp_path / "b" / ".store")) == set(before)
    for path in (tmp_path / "a" / "simulated-painting" / "r0c0").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / "simulated-painting" / "r0c0" / path.name).read_bytes()

    # Prefect saw references, never arrays.
    for run in post(f"{url}/task_runs/filter", {}):
        assert len(json.dumps(run)) < 64_000


def test_a_bad_tile_fails_the_flow_and_the_other_tile_is_done(two_tiles, tmp_path, api):
    url, environment = api
    (two_tiles / "a" / "light_3.tif").unlink()
    done = nlights(environment, "digitise", two_tiles, "--out", tmp_path / "out", code=1)
    assert "light_3.tif" in done.stderr
    assert (tmp_path / "out" / "inv-1" / "b" / "report.html").exists()
    newest = post(f"{url}/flow_runs/filter", {"sort": "START_TIME_DESC", "limit": 1})[0]
    assert newest["state"]["type"] == "FAILED"
    assert "1 of 2 tiles done" in newest["state"]["message"]
    failed = [
        run
        for run in post(f"{url}/task_runs/filter", {"flow_runs": {"id": {"any_": [newest["id"]]}}})
        if run["state"]["type"] == "FAILED"
    ]
    assert len(failed) == 1
    assert failed[0]["run_count"] == 1  # a missing photograph is not mended by a retry


def test_a_night_runs_a_subflow_per_artwork_and_one_bad_artwork_stops_no_other(painting, tmp_path, api):
    url, environment = api
    for name, title in (("inv-9", "<b>Good | *fine*</b>"), ("inv-8", "Bad")):
        folder = tmp_path / "inbox" / name
        shutil.copytree(painting, folder, ignore=shutil.ignore_patterns("truth"))
        described = yaml.safe_load((folder / "artwork.yaml").read_text())
        described["artwork"] = {"id": name, "title": title}
        (folder / "artwork.yaml").write_text(yaml.safe_dump(described))
        (folder / "upload-complete").touch()
    # What headers do not tell fails while it runs: two lamps have the same photograph.
    shutil.copy(tmp_path / "inbox" / "inv-8" / "light_1.tif", tmp_path / "inbox" / "inv-8" / "light_2.tif")
    out = tmp_path / "out"
    done = nlights(environment, "nightly", tmp_path / "inbox", "--out", out, code=1)
    assert "1 of 2 artworks done, 1 failed" in done.stdout
    runs = post(f"{url}/flow_runs/filter", {"sort": "START_TIME_DESC", "limit": 3})
    ended = {run["name"]: run["state"]["type"] for run in runs}
    assert ended["inv-9"] == "COMPLETED"
    assert ended["inv-8"] == "FAILED"
    night = next(run for run in runs if run["name"] not in ("inv-8", "inv-9"))
    assert night["state"]["type"] == "FAILED"
    assert "1 of 2 artworks done" in night["state"]["message"]
    assert all(run["parent_task_run_id"] for run in runs if run is not night)
    (shown,) = post(f"{url}/artifacts/filter", {"artifacts": {"key": {"any_": ["night"]}}})
    assert len(shown["data"]) < 64_000
    assert "data:image/jpeg" in shown["data"]
    assert "&lt;b&gt;Good \\| \\*fine\\*&lt;/b&gt;" in shown["data"]
    assert (out / "night.html").is_file()


def test_a_night_on_dask_is_a_flow_run_per_artwork_and_a_task_run_per_tile(painting, tmp_path, api, cluster):
    url, environment = api
    address, _ = cluster
    for name in ("inv-6", "inv-7"):
        shutil.copytree(painting, tmp_path / "inbox" / name, ignore=shutil.ignore_patterns("truth"))
        described = yaml.safe_load((tmp_path / "inbox" / name / "artwork.yaml").read_text())
        described["artwork"] = {"id": name}
        (tmp_path / "inbox" / name / "artwork.yaml").write_text(yaml.safe_dump(described))
        (tmp_path / "inbox" / name / "upload-complete").touch()
    # What headers do not tell: two lamps have the same photograph.
    shutil.copy(tmp_path / "inbox" / "inv-7" / "light_1.tif", tmp_path / "inbox" / "inv-7" / "light_2.tif")
    words = ["--out", tmp_path / "out", "--runner", "dask", "--address", address]
    done = nlights(environment, "nightly", tmp_path / "inbox", *words, code=1)
    assert "1 of 2 artworks done, 1 failed" in done.stdout
    assert (tmp_path / "out" / "inv-6" / "r0c0" / "report.html").exists()
    runs = post(f"{url}/flow_runs/filter", {"sort": "START_TIME_DESC", "limit": 3})
    ended = {run["name"]: run for run in runs}
    assert ended["inv-6"]["state"]["type"] == "COMPLETED"
    assert ended["inv-7"]["state"]["type"] == "FAILED"
    ours = {"flow_runs": {"id": {"any_": [ended["inv-6"]["id"], ended["inv-7"]["id"]]}}}
    tiles = post(f"{url}/task_runs/filter", ours)
    assert sorted((run["name"], run["state"]["type"]) for run in tiles) == [
        ("r0c0", "COMPLETED"),
        ("r0c0", "FAILED"),
    ]
    assert all(run["parent_task_run_id"] for run in (ended["inv-6"], ended["inv-7"]))


def test_a_bad_recipe_stops_the_command_before_prefect_starts(painting, tmp_path, api):
    _, environment = api
    done = nlights(environment, "digitise", painting, "--out", tmp_path / "x", "--recipe", "nosuch", code=2)
    assert "nosuch" in done.stderr
    assert not (tmp_path / "x").exists()


def test_telemetry_is_off_before_prefect_is_imported(monkeypatch):
    from nlights_flows.tiles import environment

    for name in environment.QUIET:
        monkeypatch.delenv(name, raising=False)
    environment.prepare()
    script = (
        "import os, prefect.settings as s; c = s.get_current_settings();"
        "print(c.server.analytics_enabled, os.environ['DO_NOT_TRACK'])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "1"]
