"""What the tests of Python's door share: a recipe that is quick, and a tile that it made."""

from pathlib import Path

import pytest

import nlights

QUICK = {
    "name": "quick",
    "light_model": "measured-poi",
    "detrend": {"images": "flat-field"},
    "normals": {"use": "least-squares"},
    "integrator": "simchony",
}


@pytest.fixture(scope="session")
def quick() -> dict:
    return QUICK


@pytest.fixture(scope="session")
def products(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("products")


@pytest.fixture(scope="session")
def tile(painting, products) -> nlights.TileResult:
    (found,) = nlights.digitise(painting, recipe=QUICK, out=products, progress=False)
    return found
