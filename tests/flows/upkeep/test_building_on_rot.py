"""A run notices damaged artefacts before it builds on one, and ends with the same bytes."""

import os
import shutil
from pathlib import Path

import pytest

from nlights_core.files import content_digests
from nlights_core.store import RECORD
from nlights_flows.nights.order import Order
from nlights_flows.nights.running import run_here, run_night
from nlights_flows.tiles import direct
from nlights_flows.tiles.run_options import RunOptions

TILE = Path("simulated-painting") / "r0c0"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def zero(path: Path) -> None:
    path.chmod(0o644)
    with path.open("r+b") as file:
        file.write(bytes(path.stat().st_size))
    os.utime(path, (1, 1))


def spoil(out: Path, name: str, gone: str) -> None:
    """Damage a file of the store, and let a run need it: an artefact behind it is gone, and the products are."""
    (path,) = (out / ".store").glob(f"*/*/{name}")
    zero(path)
    shutil.rmtree(out / TILE)
    for folder in (out / ".store").glob(f"*/*/{gone}-*"):
        shutil.rmtree(folder)


CASES = [
    ("normals-*/normals.npy", "height"),
    ("maps-*/albedo.tif", "mesh"),
    ("flat_field-*/flat_field.npy", "normals"),
    ("level-*/height.npy", "maps"),
    ("mesh-*/mesh.ply", "nothing"),
]


@pytest.mark.parametrize(("name", "gone"), CASES)
@pytest.mark.parametrize("timeout", [None, 120.0], ids=["here", "in children"])
def test_zeroed_bytes_in_an_artefact_are_made_again_and_never_become_products(
    painting, finished, out, name, gone, timeout
):
    spoil(out, name, gone)
    (outcome,) = direct.digitise(painting, RunOptions(out=out, timeout=timeout), shown=False)
    assert outcome.state == "done", outcome.message
    assert contents(out / TILE) == contents(finished / TILE)
    assert any("was damaged on the disk" in note and name.split("/")[1] in note for note in outcome.notes)


def test_a_night_does_not_publish_what_is_damaged(painting, finished, out, tmp_path):
    shutil.copytree(painting, tmp_path / "inbox" / "a")
    (tmp_path / "inbox" / "a" / "upload-complete").touch()
    spoil(out, "mesh-*/mesh.ply", "nothing")
    record = run_night(Order(tmp_path / "inbox", RunOptions(out=out)), run_here).as_json()
    (artwork,) = record["artworks"]
    (tile,) = artwork["tiles"]
    assert tile["state"] == "done", tile
    assert contents(out / TILE) == contents(finished / TILE)


@pytest.mark.parametrize("name", ["height.tif", "report.html", "mesh.glb"])
def test_a_product_that_was_cut_short_is_not_done(painting, finished, out, name):
    product = out / TILE / name
    content = product.read_bytes()
    for damaged in (content[:-1], bytes(len(content)), b""):
        product.unlink()
        product.write_bytes(damaged)
        (outcome,) = direct.digitise(painting, RunOptions(out=out), shown=False)
        assert outcome.state == "unchanged"
        assert contents(out / TILE) == contents(finished / TILE)
    product.unlink()
    product.mkdir()
    direct.digitise(painting, RunOptions(out=out), shown=False)
    assert contents(out / TILE) == contents(finished / TILE)


def test_a_finished_tile_is_not_read_again(painting, out, monkeypatch):
    direct.digitise(painting, RunOptions(out=out), shown=False)  # the copy's own photographs and records
    read = []
    real = content_digests.digest_of_content
    for module in (content_digests, __import__("nlights_core.store.artefacts", fromlist=["x"])):
        monkeypatch.setattr(
            module, "digest_of_content", lambda path, *more: (read.append(path), real(path, *more))[1]
        )
    (outcome,) = direct.digitise(painting, RunOptions(out=out), shown=False)
    assert outcome.state == "unchanged"
    assert read == []


def test_a_disk_on_which_everything_rots_fails_its_tile_and_says_so(painting, out, monkeypatch):
    from nlights_core.store import artefacts

    spoil(out, "normals-*/normals.npy", "height")
    monkeypatch.setattr(artefacts, "faults_of_files", lambda folder, files: {RECORD: "other bytes"})
    monkeypatch.setattr("nlights_flows.tiles.running.ROTTEN", 2)
    (outcome,) = direct.digitise(painting, RunOptions(out=out), shown=False)
    assert outcome.state == "failed"
    assert "was damaged on the disk" in outcome.message
