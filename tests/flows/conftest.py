"""What several tests of the flows start: a Dask cluster of this machine."""

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
