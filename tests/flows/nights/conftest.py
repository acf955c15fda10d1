"""What several tests of nights need: the smallest capture, uploads of it, and the command."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate

COMMAND = Path(sys.executable).parent / "nlights"


@pytest.fixture(scope="session")
def smallest(tmp_path_factory) -> Path:
    """The smallest capture that is worth a picture."""
    folder = tmp_path_factory.mktemp("captures") / "smallest"
    simulate(folder, load_stand("horizontal"), scene="painting", width=96, seed=1)
    return folder


@pytest.fixture(scope="session")
def upload(smallest) -> Callable[..., Path]:
    """Upload a copy of the smallest capture; its folder's name is its inventory number."""

    def put(inbox: Path, name: str, **artwork: str) -> Path:
        folder = inbox / name
        shutil.copytree(smallest, folder, ignore=shutil.ignore_patterns("truth"))
        manifest = folder / "artwork.yaml"
        described = yaml.safe_load(manifest.read_text(encoding="utf-8"))
        described["artwork"] = {"id": name, **artwork}
        manifest.write_text(yaml.safe_dump(described))
        (folder / "upload-complete").touch()
        return folder

    return put


@pytest.fixture(scope="session")
def nlights() -> Callable[..., subprocess.CompletedProcess]:
    """Run the command line as people do; no command may end with a traceback."""

    def run(*words: object, code: int = 0, **options: object) -> subprocess.CompletedProcess:
        done = subprocess.run(
            [COMMAND, *map(str, words)], capture_output=True, text=True, timeout=300, check=False, **options
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done

    return run
