"""Simulated captures that tests of agreement spoil, as files, as samples, and as light."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.comparisons import Comparison, compare_photographs
from nlights_core.agreement.predictions import compare_with_predictions
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.manifest import load_capture
from nlights_core.reduced_light.samples import Samples, sample_photographs
from nlights_core.simulation.captures import BLACK_LEVEL, simulate

Spoiler = Callable[[np.ndarray], np.ndarray]


class Photographs:
    """A copy of a capture, whose photographs a test may change as light (black level taken off)."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def tile(self) -> Tile:
        return load_capture(self.folder)[0]

    def change(self, path: str, spoil: Spoiler) -> None:
        light = tifffile.imread(self.folder / path).astype(np.float32) - BLACK_LEVEL
        numbers = np.clip(np.rint(spoil(light) + BLACK_LEVEL), 0, 65535).astype(np.uint16)
        tifffile.imwrite(
            self.folder / path, numbers, photometric="rgb" if numbers.ndim == 3 else "minisblack"
        )

    def change_frames(self, spoil: Spoiler, *numbers: int) -> None:
        for n in numbers or range(1, 9):
            self.change(f"light_{n}.tif", spoil)

    def said(self, tile: Tile | None = None, lights: LightField | None = None) -> list[CaptureWarning]:
        tile = tile or self.tile
        if lights is None:
            stand = tile.stand
            chosen = [list(stand.lamps).index(lamp) for lamp in tile.lamps]
            lights = LightField(tile.lamps, positions=stand.lamp_positions()[chosen])
        scratch = self.folder / "scratch"
        samples = sample_photographs(tile, True, scratch)
        return compare_with_predictions(samples, tile.lamps, tile, lights, scratch, lambda _: None)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Callable[..., Path]:
    """Folder of a capture 240 px wide, simulated once per session."""
    made: dict[tuple, Path] = {}

    def once(scene: str, stand: str = "horizontal", varnish: bool = False) -> Path:
        key = (scene, stand, varnish)
        if key not in made:
            made[key] = tmp_path_factory.mktemp("agreement") / "capture"
            simulate(made[key], load_stand(stand), scene=scene, width=240, varnish=varnish, seed=5)
        return made[key]

    return once


@pytest.fixture
def photographs(simulated, tmp_path) -> Callable[..., Photographs]:
    """A copy of a simulated capture."""

    def copied(scene: str, stand: str = "horizontal", varnish: bool = False) -> Photographs:
        return Photographs(Path(shutil.copytree(simulated(scene, stand, varnish), tmp_path / "capture")))

    return copied


@pytest.fixture
def copy_of() -> Callable[[Path], Photographs]:
    """Photographs of a folder that a test made itself."""
    return Photographs


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
