"""Small simulated captures, and what the comparison with predictions says of a copy of one that a test has spoilt."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.agreement.predictions import compare_with_predictions
from nlights_core.agreement.samples import sample_photographs
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.manifest import load_capture
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
