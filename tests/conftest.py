"""Captures that several tests look at, simulated once per session; they are never written to."""

import shutil
from pathlib import Path

import pytest

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate


@pytest.fixture(scope="session")
def painting(tmp_path_factory) -> Path:
    """A small simulated painting on the horizontal stand."""
    folder = tmp_path_factory.mktemp("captures") / "painting"
    simulate(folder, load_stand("horizontal"), scene="painting", width=160, seed=1)
    return folder


@pytest.fixture
def capture(painting, tmp_path) -> Path:
    """A copy of the painting that a test may spoil."""
    return Path(shutil.copytree(painting, tmp_path / "capture"))


@pytest.fixture
def two_tiles(capture) -> Path:
    """A capture of two tiles, in folders of their own, sharing flats and dark."""
    for tile in ("a", "b"):
        (capture / tile).mkdir()
        for path in capture.glob("light_*.tif"):
            shutil.copy(path, capture / tile / path.name)
    (capture / "artwork.yaml").write_text(
        "artwork: {id: inv-1, title: Two tiles}\nstand: horizontal\n"
        'frames: "{tile}/light_{n}.tif"\nflats: "flat/light_{n}.tif"\ndark: dark.tif\n'
        "tiles: [{name: a}, {name: b, origin_mm: [450, 0]}]\n",
        encoding="utf-8",
    )
    return capture
