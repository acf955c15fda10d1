"""Whatever a tile is made of is watched while it runs: photographs, spheres, lists of lights, the stand."""

import os
import shutil
from pathlib import Path

import pytest
import yaml

from nlights_core.capture import GivenLights, HeightFile, Sphere, TurnedFlats
from nlights_core.configurations import load_stand
from nlights_core.errors import TileError
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.store import Store
from nlights_flows.tiles.photographs import Photographs


@pytest.fixture
def watched(capture, tmp_path):
    """A tile with everything that a tile can have, each file of its own."""
    shutil.copy(load_stand("horizontal").file, capture / "stand.yaml")
    manifest = yaml.safe_load((capture / "artwork.yaml").read_text())
    (capture / "artwork.yaml").write_text(yaml.safe_dump({**manifest, "stand": "stand.yaml"}))
    (tile,) = load_capture(capture)
    for name in (
        "sphere.tif",
        "sphere-mask.png",
        "outline.tif",
        "lamps.lp",
        "strengths.txt",
        "turned.tif",
        "heights.csv",
    ):
        (capture / name).write_bytes(name.encode())
    tile = tile.model_copy(
        update={
            "spheres": (
                Sphere(
                    frames={"a": capture / "sphere.tif"},
                    mask=capture / "sphere-mask.png",
                    outline=capture / "outline.tif",
                ),
            ),
            "lights": GivenLights(directions=capture / "lamps.lp", intensities=capture / "strengths.txt"),
            "turned_flats": (TurnedFlats(turn_deg=90, flats={"a": capture / "turned.tif"}),),
            "known_heights": HeightFile(file=capture / "heights.csv"),
        }
    )
    store = Store(tmp_path / "store")
    store.prepare()
    return tile, store


def replace(path: Path) -> None:
    path.with_name("new").write_bytes(b"another " + path.read_bytes())
    path.with_name("new").replace(path)


def write_behind_the_dates(path: Path) -> None:
    """Change bytes so that size, inode and date of writing stay."""
    status = path.stat()
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    with path.open("r+b") as file:
        file.write(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


FILES = [
    "sphere.tif", "sphere-mask.png", "outline.tif", "lamps.lp", "strengths.txt", "turned.tif", "heights.csv",
    "stand.yaml", "dark.tif", "flat/light_1.tif", "light_1.tif",
]  # fmt: skip


@pytest.mark.parametrize("change", [replace, write_behind_the_dates, Path.unlink])
@pytest.mark.parametrize("name", FILES)
def test_a_file_that_changes_while_its_tile_runs_fails_the_tile(watched, capture, name, change):
    tile, store = watched
    if not (capture / name).exists():
        name = next(
            str(path.relative_to(capture)) for path in capture.rglob("*") if path in tile.flats.values()
        )

    def changed() -> None:
        with Photographs.watched(tile, load_recipe("default"), store) as seen:
            assert all(digest.result() for _, digest in seen.stamps.values())
            change(capture / name)

    with pytest.raises(TileError, match="changed while it ran") as told:
        changed()
    assert Path(name).name in str(told.value)


def test_nothing_else_is_watched(watched, capture):
    tile, store = watched
    with Photographs.watched(tile, load_recipe("default"), store) as seen:
        assert all(digest.result() for _, digest in seen.stamps.values())
        (capture / "notes.txt").write_text("seen by M.")
        assert capture / "notes.txt" not in seen.stamps
        os.utime(capture / "lamps.lp")


def test_a_stand_knows_its_file_and_is_the_same_without(tmp_path):
    stand = load_stand("horizontal")
    assert stand.file is not None
    assert type(stand).model_validate(stand.model_dump(mode="json")).file is None
    assert "file" not in stand.model_dump()
