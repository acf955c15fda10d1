"""What several tests of the flows need: a Dask cluster of this machine, plugins that misbehave."""

import os
import sys
import time
from pathlib import Path

import pytest
from night_processes import Service, free_port

BIN = Path(sys.executable).parent


@pytest.fixture
def cluster(tmp_path):
    """A Dask scheduler and two workers, processes of this machine."""
    if not (BIN / "dask").exists():
        pytest.skip("Dask is not installed: pip install -c constraints.txt 'nlights[dask]'")
    address = f"tcp://127.0.0.1:{free_port()}"
    words = [BIN / "dask", "scheduler", "--host", address, "--no-dashboard"]
    scheduler = Service("scheduler", tmp_path, words, os.environ, lambda: "Scheduler at" in scheduler.said)
    options = ["--nthreads", "1", "--memory-limit", "0", "--no-nanny", "--no-dashboard"]
    words = [BIN / "dask", "worker", address, *options, "--local-directory", tmp_path / "dask"]
    workers = [Service(f"worker-{n}", tmp_path, words, os.environ, lambda: True) for n in range(2)]
    try:
        scheduler.start()
        for worker in workers:
            worker.start()
        until = time.monotonic() + 60
        while scheduler.said.count("Register worker") < 2:
            assert time.monotonic() < until, scheduler.said
            time.sleep(0.1)
        yield address, workers
    finally:
        for service in (*workers, scheduler):
            service.kill()


@pytest.fixture(scope="session")
def rascals(tmp_path_factory) -> dict[str, str]:
    """The environment of a process in which the rascals are installed: their folder, and their metadata."""
    record = tmp_path_factory.mktemp("installed") / "nlights_rascals-0.1.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: nlights-rascals\nVersion: 0.1\n")
    (record / "entry_points.txt").write_text("[nlights]\nrascals = nlights_rascals\n")
    paths = [Path(__file__).with_name("rascals"), record.parent, os.environ.get("PYTHONPATH")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(str(path) for path in paths if path)}
