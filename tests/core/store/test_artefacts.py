"""The store: whole or not at all, named by what made it."""

import errno
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from xxhash import xxh3_128

from nlights_core.errors import CaptureError, TileError
from nlights_core.files.arrays import BandWriter, read_array
from nlights_core.store import Store, Work, describe
from nlights_plugins.integrators import Simchony


def work(make, **facts) -> Work:
    ref, record = describe("height", "inv-1", "r0c0", algorithm=Simchony(), facts=facts)
    return Work(ref, record, make)


def write(folder, progress):
    (folder / "x.txt").write_text("made")


def test_an_artefact_is_made_once_and_says_why_it_exists(tmp_path):
    store, calls = Store(tmp_path), []
    job = work(lambda folder, progress: (calls.append(1), write(folder, progress)))
    assert store.ensure(job) is False
    assert store.ensure(job) is True
    assert calls == [1]
    record = json.loads((store.path(job.ref) / "artefact.json").read_text())
    assert record["algorithm"]["use"] == "simchony"
    assert record["algorithm"]["options"]["stencil"] == "6-point"
    assert record["key"] == job.ref.key


@pytest.mark.parametrize("fault", [TileError("no"), OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_a_stage_that_fails_leaves_nothing(tmp_path, fault):
    store = Store(tmp_path)

    def fail(folder, progress):
        write(folder, progress)
        raise fault

    job = work(fail)
    with pytest.raises(type(fault)):
        store.ensure(job)
    assert not store.has(job.ref)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_any_difference_makes_another_key():
    def key(**changes):
        arguments = {"algorithm": Simchony(), "inputs": {}, "facts": {"a": 1}} | changes
        return describe("height", "inv-1", "r0c0", **arguments)[0].key

    other = describe("normals", "inv-1", "r0c0")[0]
    keys = {
        key(),
        key(algorithm=Simchony(stencil="trapezoid")),
        key(algorithm=Simchony(perspective=False)),
        key(facts={"a": 2}),
        key(facts={"a": 1, "b": None}),
        key(inputs={"normals": other}),
    }
    assert len(keys) == 6
    assert key() == key()
    # The same work for another tile is the same work: places are not part of the cause.
    assert describe("height", "x", "y", algorithm=Simchony(), facts={"a": 1})[0].key == key()


def test_an_artefact_damaged_or_of_another_key_is_replaced(tmp_path):
    store, job = Store(tmp_path), work(write)
    store.ensure(job)
    for content in ("{", json.dumps({"key": "0" * 64})):
        (store.path(job.ref) / "artefact.json").write_text(content)
        assert not store.has(job.ref)
        store.ensure(job)
        assert store.has(job.ref)


def test_a_digest_follows_the_content_and_is_remembered(tmp_path):
    store, path = Store(tmp_path / "store"), tmp_path / "photograph"
    store.prepare()
    path.write_bytes(b"one")
    first = store.digest(path)
    assert store.digest(path) == first
    assert len(list((tmp_path / "store" / ".digests").iterdir())) == 1
    path.write_bytes(b"two")
    assert store.digest(path) != first
    path.unlink()
    with pytest.raises(TileError, match="photograph"):
        store.digest(path)


def test_a_digest_that_many_ask_for_at_once_is_found_once(tmp_path, monkeypatch):
    store, path, begun = Store(tmp_path / "store"), tmp_path / "photograph", []
    store.prepare()
    path.write_bytes(bytes(64 << 20))

    def counted():
        begun.append(path)
        return xxh3_128()

    monkeypatch.setattr("nlights_core.files.content_digests.xxh3_128", counted)
    with ThreadPoolExecutor(8) as pool:
        # Each with a store of its own, as tasks have.
        digests = list(pool.map(lambda _: Store(store.root).digest(path), range(8)))
    assert digests == [xxh3_128(path.read_bytes()).hexdigest()] * 8
    assert len(begun) == 1


def test_a_digest_that_is_no_longer_asked_for_stops_reading(tmp_path):
    store, path = Store(tmp_path / "store"), tmp_path / "photograph"
    path.write_bytes(bytes(3 << 20))
    asked = []

    def stopped():
        asked.append(True)
        return True

    with pytest.raises(TileError, match="no longer asked for"):
        store.digest(path, stopped)
    assert len(asked) == 1
    assert store.digest(path) == xxh3_128(path.read_bytes()).hexdigest()


def test_planning_in_a_store_that_is_not_there_writes_nothing(tmp_path):
    store = Store(tmp_path / "store")
    (tmp_path / "x").write_bytes(b"x")
    store.digest(tmp_path / "x")
    assert not (tmp_path / "store").exists()


def test_a_store_that_cannot_be_written_is_told_before_anything_runs(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="--store"):
        Store(tmp_path / "file" / "store").prepare()


def test_bands_make_the_whole_array_and_a_missing_row_is_noticed(tmp_path):
    array = np.arange(60, dtype=np.float32).reshape(5, 4, 3)
    with BandWriter(tmp_path / "a.npy", array.shape) as file:
        file.write(array[:2])
        file.write(array[2:])
    np.testing.assert_array_equal(read_array(tmp_path / "a.npy"), array)
    with pytest.raises(ValueError, match="2 of 5 rows"), BandWriter(tmp_path / "b.npy", array.shape) as file:
        file.write(array[:2])
