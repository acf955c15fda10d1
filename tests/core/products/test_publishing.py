"""Products appear whole and people's files stay, however many runs publish the same tile at once."""

import json
import multiprocessing
import shutil
from datetime import datetime
from pathlib import Path

import pytest

from nlights_core.manifest import load_capture
from nlights_core.products.publishing import publish
from nlights_core.store import RECORD, ArtefactRef, Store
from nlights_core.store.records import described_files, sealed

ROUNDS = 150


def refs_of(store: Store, tile, key: str, photographs: str = "") -> dict[str, ArtefactRef]:
    """Artefacts of a recipe: as many files as a tile has, which say whose they are; a letter is a photograph."""
    refs = {name: ArtefactRef(name, tile.artwork, tile.name, key * 64) for name in ("maps", "mesh", "report")}
    if (store.path(refs["report"]) / RECORD).exists():
        return refs
    files = {"maps": ("height.tif", "normals.tif"), "mesh": ("mesh.ply",), "report": ("report.html",)}
    for name, ref in refs.items():
        store.path(ref).mkdir(parents=True, exist_ok=True)
        for file in files[name]:
            (store.path(ref) / file).write_text(key)
    stages = [{"facts": {"frames": {str(i): digest for i, digest in enumerate(photographs)}}}, {"facts": {}}]
    provenance = {"key": key * 64, "stages": stages}
    (store.path(refs["report"]) / "provenance.json").write_text(json.dumps(provenance))
    for ref in refs.values():
        folder = store.path(ref)
        described = described_files(path for path in folder.iterdir() if path.name != RECORD)
        (folder / RECORD).write_text(sealed({"key": ref.key, "files": described}))
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
    target = publish(store, tile, refs_of(store, tile, "a"), tmp_path / "out").folder
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
    assert publish(store, tile, refs_of(store, tile, "a"), tmp_path / "out").folder.is_dir()


def key_of(folder: Path) -> str:
    assert {(folder / name).read_text() for name in ("height.tif", "mesh.ply", "report.html")} == {
        json.loads((folder / "provenance.json").read_text())["key"][0]
    }
    return (folder / "height.tif").read_text()


def test_products_of_other_photographs_are_kept_with_what_people_added(painting, tmp_path):
    (tile,) = load_capture(painting)
    store, out = Store(tmp_path / "store"), tmp_path / "out"
    target = publish(store, tile, refs_of(store, tile, "a", "pqr"), out).folder
    (target / "notes.txt").write_text("seen by M.")
    published = publish(store, tile, refs_of(store, tile, "b", "xyz"), out)
    assert published.folder == target
    (kept,) = published.kept
    assert kept.parent.parent == target.parent / ".former"
    assert datetime.strptime(kept.parent.name, "%Y-%m-%dT%H%M") <= datetime.now()
    assert (key_of(kept), key_of(target)) == ("a", "b")
    assert (kept / "notes.txt").read_text() == "seen by M."
    assert not (target / "notes.txt").exists()
    assert str(kept) in published.notes[0]
    assert publish(store, tile, refs_of(store, tile, "b", "xyz"), out).kept == ()
    # The same minute most often: a second place beside the first.
    (again,) = publish(store, tile, refs_of(store, tile, "a", "pqr"), out).kept
    assert again != kept
    assert (key_of(kept), key_of(again), key_of(target)) == ("a", "b", "a")
    assert sorted(path.name for path in target.parent.iterdir()) == [".former", tile.name]


@pytest.mark.parametrize("photographs", ["pqr", "pxy", ""], ids=["the same", "one of them", "nobody knows"])
def test_products_with_a_photograph_in_common_are_replaced(painting, tmp_path, photographs):
    (tile,) = load_capture(painting)
    store, out = Store(tmp_path / "store"), tmp_path / "out"
    target = publish(store, tile, refs_of(store, tile, "a", "pqr"), out).folder
    (target / "notes.txt").write_text("seen by M.")
    assert publish(store, tile, refs_of(store, tile, "b", photographs), out) == (target, (), ())
    assert key_of(target) == "b"
    assert (target / "notes.txt").read_text() == "seen by M."
    assert [path.name for path in target.parent.iterdir()] == [tile.name]


@pytest.mark.parametrize("stands", ["", "b"], ids=["nothing", "the new ones"])
def test_a_run_that_was_killed_while_it_replaced_products_of_others_lost_nothing(painting, tmp_path, stands):
    (tile,) = load_capture(painting)
    store, out = Store(tmp_path / "store"), tmp_path / "out"
    target = publish(store, tile, refs_of(store, tile, "a", "pqr"), out).folder
    target.rename(target.parent / f".former-{tile.name}")
    for key in stands:
        aside = publish(store, tile, refs_of(store, tile, key, "xyz"), tmp_path / "other").folder
        aside.rename(target)
    published = publish(store, tile, refs_of(store, tile, "b", "xyz"), out)
    (kept,) = published.kept
    assert (key_of(kept), key_of(target)) == ("a", "b")
    assert sorted(path.name for path in target.parent.iterdir()) == [".former", tile.name]


def publish_in_turn(painting: Path, place: Path, keys: str, start) -> None:
    (tile,) = load_capture(painting)
    store = Store(place / "store")
    start.wait()
    for i in range(40):
        key = keys[i % len(keys)]
        publish(
            store, tile, refs_of(store, tile, key, {"a": "pqr", "b": "xyz", "c": "pst"}[key]), place / "out"
        )


def test_runs_of_different_artworks_under_one_number_at_once_lose_nothing_of_what_was_there(
    painting, tmp_path
):
    (tile,) = load_capture(painting)
    store = Store(tmp_path / "store")
    for key, photographs in {"a": "pqr", "b": "xyz", "c": "pst"}.items():
        refs_of(store, tile, key, photographs)
    target = publish(store, tile, refs_of(store, tile, "d", "ijk"), tmp_path / "out").folder
    (target / "notes.txt").write_text("seen by M.")
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(3)
    runs = [
        context.Process(target=publish_in_turn, args=(painting, tmp_path, keys, start))
        for keys in ("ab", "bc", "a")
    ]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0, 0]
    assert sorted(path.name for path in target.parent.iterdir()) == [".former", tile.name]
    kept = [key_of(path) for path in (target.parent / ".former").glob("*/*")]
    assert kept.count("d") == 1
    (notes,) = target.parent.rglob("notes.txt")
    assert key_of(notes.parent) == "d"
