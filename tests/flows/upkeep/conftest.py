"""A finished tile that tests may spoil: products and store, linked as they were made."""

import subprocess
from pathlib import Path

import pytest

from nlights_core.files import content_digests
from nlights_flows.tiles import direct
from nlights_flows.tiles.run_options import RunOptions


@pytest.fixture(scope="session")
def finished(painting, tmp_path_factory) -> Path:
    """Products of the painting, and their store; never written to."""
    out = tmp_path_factory.mktemp("finished") / "products"
    (outcome,) = direct.digitise(painting, RunOptions(out=out), shown=False)
    assert outcome.state == "done", outcome.message
    return out


@pytest.fixture
def out(finished, tmp_path, monkeypatch) -> Path:
    """A copy of them, in which files of two names are such again; this process knows no digest of it."""
    place = tmp_path / "products"
    subprocess.run(["cp", "-a", finished, place], check=True)
    monkeypatch.setattr(content_digests, "_known", {})
    return place
