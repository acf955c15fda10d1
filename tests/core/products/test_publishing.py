"""Products appear whole and people's files stay, however many runs publish the same tile at once."""

import json
import multiprocessing
import shutil
from pathlib import Path

import pytest

from nlights_core.manifest import load_capture
from nlights_core.products.publishing import publish
from nlights_core.store import ArtefactRef, Store

ROUNDS = 150


def refs_of(store: Store, tile, key: str) -> dict[str, ArtefactRef]:
    """Artefacts of a recipe: as many files as a tile has, which say whose they are."""
    refs = {name: ArtefactRef(name, tile.artwork, tile.name, key * 64) for name in ("maps", "mesh", "report")}
    files = {"maps": ("height.tif", "normals.tif"), "mesh": ("mesh.ply",), "report": ("report.html",)}
    for name, ref in refs.items():
        store.path(ref).mkdir(parents=True, exist_ok=True)
        for file in files[name]:
            (store.path(ref) / file).write_text(key)
    (store.path(refs["report"]) / "provenance.json").write_text(json.dumps({"key": key * 64}))
    return refs


def publish_often(painting: Path, place: Path, keys: str, start) -> None:
    (tile,) = load_capture(painting)
    store = Store(place / "store")
    start.wait()
    for i in range(ROUNDS):
        publish(store, tile, refs_of(store, tile, keys[i % len(keys)]), place / "out")


@pytest.mark.parametrize("others", ["a", "b", "ab"])
def test_runs_that_publish_the_same_tile_at_once_do_not_fail_each_other(painting, tmp_path, others):
    (tile,) = load_capture(painting)
    store = Store(tmp_path / "store")
    for key in "ab":
        refs_of(store, tile, key)
    target = publish(store, tile, refs_of(store, tile, "a"), tmp_path / "out")
    (target / "notes.txt").write_text("seen by M.")
    (target / "sketches").mkdir()
    for name in "xyz":
        (target / "sketches" / name).write_text(name)
    # Another product each time, so that nearly every call moves folders; "others" at other times.
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(3)
    runs = [
        context.Process(target=publish_often, args=(painting, tmp_path, keys, start))
        for keys in ("ab", "ba", others)
    ]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0, 0]
    assert sorted(path.name for path in target.parent.iterdir()) == [tile.name]
    products = {"height.tif", "normals.tif", "mesh.ply", "report.html", "provenance.json"}
    assert {path.name for path in target.iterdir()} == products | {"notes.txt", "sketches"}
    key = json.loads((target / "provenance.json").read_text())["key"][0]
    assert {(target / name).read_text() for name in products - {"provenance.json"}} == {key}
    assert (target / "notes.txt").read_text() == "seen by M."
    assert sorted(path.read_text() for path in (target / "sketches").iterdir()) == ["x", "y", "z"]


def test_a_fault_that_lasts_is_told_at_once_and_leaves_what_was_there(painting, tmp_path):
    (tile,) = load_capture(painting)
    store = Store(tmp_path / "store")
    target = tmp_path / "out" / tile.artwork / tile.name
    target.parent.mkdir(parents=True)
    target.write_text("a file in the folder's place")
    with pytest.raises(NotADirectoryError):
        publish(store, tile, refs_of(store, tile, "a"), tmp_path / "out")
    assert target.read_text() == "a file in the folder's place"
    assert list(target.parent.iterdir()) == [target]
    shutil.rmtree(tmp_path / "out")
    assert publish(store, tile, refs_of(store, tile, "a"), tmp_path / "out").is_dir()
