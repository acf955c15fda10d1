"""Simulated captures that tests of agreement spoil, as files and as samples."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.comparisons import Comparison, compare_photographs
from nlights_core.agreement.samples import Samples, sample_photographs
from nlights_core.capture import Tile
from nlights_core.frames import Array
from nlights_core.manifest import load_capture


@pytest.fixture(scope="session")
def sampled(painting, tmp_path_factory) -> tuple[Samples, Tile]:
    """The samples of the sound painting, and its tile."""
    return read(painting, tmp_path_factory.mktemp("scratch"))


@pytest.fixture
def compared(tmp_path) -> Callable[[Path], Comparison]:
    """What is found in the capture of a folder."""

    def compare(folder: Path) -> Comparison:
        samples, tile = read(folder, tmp_path / "scratch")
        return compare_photographs(samples, tile, None)

    return compare


@pytest.fixture
def found(sampled) -> Callable[..., list[tuple[str, tuple[str, ...]]]]:
    """Codes and lamps of what is found where some of the samples are others."""
    samples, tile = sampled

    def find(**changed: Any) -> list[tuple[str, tuple[str, ...]]]:
        comparison = compare_photographs(dataclasses.replace(samples, **changed), tile, None)
        return [(warning.code, warning.lamps) for warning in comparison.warnings]

    return find


@pytest.fixture
def spoil() -> Callable[[Path, Callable[[Array], Array]], None]:
    """Write a TIFF anew with its numbers changed."""

    def write(path: Path, change: Callable[[Array], Array]) -> None:
        numbers = tifffile.imread(path)
        changed = np.clip(np.rint(change(numbers.astype(np.float64))), 0, 65535).astype(np.uint16)
        tifffile.imwrite(path, changed, photometric="rgb")

    return write


def read(folder: Path, scratch: Path) -> tuple[Samples, Tile]:
    """Samples of a capture of one tile."""
    tile = load_capture(folder / "artwork.yaml")[0]
    return sample_photographs(tile, True, scratch), tile
