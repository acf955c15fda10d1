"""An inbox to try a night on: simulated artworks, some whole, one with a broken manifest, one with a bad tile."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate

SCENES = ("painting", "relief", "drawing", "plane")
FINISHED = "upload-complete"
"""The file that says that an upload is finished."""

BROKEN = "inv-broken-manifest"
TWO_TILES = "inv-two-tiles"


def whole_name(number: int) -> str:
    """The inventory number of a whole artwork, counted from 1."""
    return f"inv-{1800 + number}"


def fill(inbox: Path, whole: int, width: int, faults: bool = True) -> Iterator[str]:
    """Write artworks into an inbox, and tell each when it is there.

    Parameters
    ----------
    inbox : Path
        A new folder.
    whole : int
        How many artworks without a fault.
    width : int
        Of the photographs, px.
    faults : bool
        Whether to add `BROKEN`, whose manifest is no YAML, and `TWO_TILES`, whose tile "b" has a
        photograph that breaks off.
    """
    for i in range(whole):
        name = whole_name(i + 1)
        simulated(inbox / name, name, SCENES[i % len(SCENES)], width, seed=i + 1)
        yield name
    if faults:
        broken = simulated(inbox / BROKEN, BROKEN, "painting", width, seed=90)
        broken.write_text(broken.read_text(encoding="utf-8").replace("frames:", "frames: [", 1))
        yield BROKEN
        two_tiles(inbox / TWO_TILES, width)
        yield TWO_TILES


def simulated(folder: Path, name: str, scene: str, width: int, seed: int) -> Path:
    """One artwork under a given inventory number; returns its manifest."""
    simulate(folder, load_stand("horizontal"), scene=scene, width=width, seed=seed)
    shutil.rmtree(folder / "truth")
    path = folder / "artwork.yaml"
    manifest = yaml.safe_load(path.read_text(encoding="utf-8"))
    _write(path, {**manifest, "artwork": {"id": name, "title": f"Simulated {scene}"}})
    (folder / FINISHED).touch()
    return path


def two_tiles(folder: Path, width: int) -> None:
    """Tile "a" is good; the third photograph of tile "b" breaks off in the middle."""
    path = simulated(folder, TWO_TILES, "painting", width, seed=91)
    for tile in ("a", "b"):
        (folder / tile).mkdir()
        for frame in folder.glob("light_*.tif"):
            shutil.copy(frame, folder / tile)
    for frame in folder.glob("light_*.tif"):
        frame.unlink()
    cut = folder / "b" / "light_3.tif"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    manifest = yaml.safe_load(path.read_text(encoding="utf-8"))
    manifest["frames"] = "{tile}/light_{n}.tif"
    manifest["tiles"] = [{"name": "a"}, {"name": "b", "origin_mm": [450, 0]}]
    _write(path, manifest)


def _write(path: Path, manifest: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
