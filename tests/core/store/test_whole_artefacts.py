"""Artefacts that were damaged: found before anything is built on them, whatever became of their bytes."""

import json
import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
from xxhash import xxh3_128

from nlights_core.files import content_digests
from nlights_core.files.arrays import write_array
from nlights_core.files.tiffs import write_tiff
from nlights_core.frames import PixelGrid
from nlights_core.store import RECORD, ArtefactRef, RottenArtefactError, Store, Work, describe
from nlights_core.store.records import read_sealed, sealed
from nlights_core.store.whole_files import give_out, link_or_copy


@pytest.fixture
def store(tmp_path, monkeypatch):
    """A store in a process that knows nothing yet."""
    monkeypatch.setattr(content_digests, "_known", {})
    return Store(tmp_path)


def forget() -> None:
    """Be another process."""
    content_digests._known.clear()


def fill(folder: Path, progress) -> None:
    write_array(folder / "height.npy", np.arange(50_000, dtype=np.float32).reshape(200, 250))
    (folder / "lights.json").write_text('{"a": 1}\n')
    (folder / "other.json").write_text('{"b": 2}\n')


def made(store: Store, stage: str = "height", fill=fill, **inputs: ArtefactRef) -> Work:
    ref, record = describe(stage, "inv-1", "r0c0", inputs=inputs)
    return Work(ref, record, fill)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, (1, 1))  # else in the same tick of the clock


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))
    os.utime(path, (1, 1))


def lose(path: Path) -> None:
    path.unlink()


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replace_by_socket(path: Path) -> None:
    path.unlink()
    with socket.socket(socket.AF_UNIX) as one:
        place = Path.cwd()
        os.chdir(path.parent)  # a socket's name is short
        try:
            one.bind(path.name)
        finally:
            os.chdir(place)


def link_to_nothing(path: Path) -> None:
    path.unlink()
    path.symlink_to("nothing")


FAULTS = [
    flip,
    cut,
    empty,
    zero,
    lose,
    replace_by_folder,
    replace_by_pipe,
    replace_by_socket,
    link_to_nothing,
]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["height.npy", "lights.json", RECORD])
def test_a_stage_does_not_read_what_is_not_what_was_written(store, fault, name):
    first = made(store)
    store.ensure(first)
    forget()
    place = store.path(first.ref)
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    fault(place / name)
    second = made(store, "trend", height=first.ref)
    with pytest.raises(RottenArtefactError, match="damaged"):
        store.ensure(second)
    assert not place.exists()
    assert not store.has(second.ref)
    # Begun anew, as a chain does.
    assert store.ensure(first) is False
    assert store.ensure(second) is False
    after = {path.name: path.read_bytes() for path in place.iterdir()}
    assert {name: after[name] for name in after if name != RECORD} == {
        name: before[name] for name in before if name != RECORD
    }
    assert [path.name for path in place.parent.iterdir() if path.name.startswith(".")] == []


def test_two_files_that_were_exchanged_are_noticed(store):
    first = made(store)
    store.ensure(first)
    forget()
    place = store.path(first.ref)
    (place / "lights.json").rename(place / "aside")
    (place / "other.json").rename(place / "lights.json")
    (place / "aside").rename(place / "other.json")
    assert store.has(first.ref)  # by size
    with pytest.raises(RottenArtefactError, match=r"lights\.json: other bytes .*; other\.json: other bytes"):
        store.ensure(made(store, "trend", height=first.ref))


def test_two_artefacts_that_were_exchanged_are_noticed(store):
    first, other = made(store), made(store, "level")
    store.ensure(first)
    store.ensure(other)
    a, b = store.path(first.ref), store.path(other.ref)
    a.rename(a.with_name("aside"))
    b.rename(a)
    a.with_name("aside").rename(b)
    assert not store.has(first.ref)
    with pytest.raises(RottenArtefactError, match="of another artefact"):
        store.ensure(made(store, "trend", height=first.ref))


@pytest.mark.parametrize(
    "fault", [shutil.rmtree, lambda path: (shutil.rmtree(path), path.write_text("a file"))]
)
def test_an_artefact_that_is_gone_or_a_file_is_made_again(store, fault):
    first = made(store)
    store.ensure(first)
    fault(store.path(first.ref))
    with pytest.raises(RottenArtefactError, match="damaged"):
        store.ensure(made(store, "trend", height=first.ref))
    assert store.ensure(first) is False
    assert store.has(first.ref)


def test_a_file_in_an_artefacts_place_is_replaced(store):
    first = made(store)
    place = store.path(first.ref)
    place.parent.mkdir(parents=True)
    place.write_text("a file")
    assert store.ensure(first) is False
    assert store.has(first.ref)


def test_the_mask_that_the_store_found_is_looked_at_too(store):
    mask = made(store, "mask", lambda folder, progress: (folder / "mask.tif").write_bytes(b"mask"))
    store.ensure(mask)
    forget()
    ref, record = describe("agreement", "inv-1", "r0c0", facts={"mask": store.path(mask.ref).name})
    flip(store.path(mask.ref) / "mask.tif")
    with pytest.raises(RottenArtefactError, match=r"mask\.tif"):
        store.ensure(Work(ref, record, fill))


def test_a_record_of_which_one_character_changed_is_no_record(store):
    first = made(store)
    store.ensure(first)
    path = store.path(first.ref) / RECORD
    whole = path.read_text()
    assert read_sealed(path)["seconds"] >= 0
    for place in range(0, len(whole), 7):
        changed = whole[:place] + chr(ord(whole[place]) ^ 1) + whole[place + 1 :]
        path.write_text(changed)
        assert not store.has(first.ref)
    for changed in (whole + " ", whole[:-1], "[]", "1", "{}", "", "\udce9"):
        path.write_bytes(changed.encode("utf-8", "surrogateescape"))
        assert not store.has(first.ref)


def test_what_this_process_wrote_or_read_is_read_no_more(store, monkeypatch):
    first = made(store)
    read: list[Path] = []
    real = content_digests.digest_of_content
    monkeypatch.setattr(
        content_digests, "digest_of_content", lambda path, *more: (read.append(path), real(path, *more))[1]
    )
    store.ensure(first)
    assert sorted(path.name for path in read) == [
        "lights.json",
        "other.json",
    ]  # the array's is found on its way
    del read[:]
    for stage in ("trend", "level"):
        store.ensure(made(store, stage, lambda folder, progress: None, height=first.ref))
    assert read == []
    forget()
    for stage in ("maps", "mesh"):
        store.ensure(made(store, stage, lambda folder, progress: None, height=first.ref))
    assert sorted(path.name for path in read) == ["height.npy", "lights.json", "other.json"]


def test_a_record_names_every_file_with_its_size_and_digest(store):
    first = made(store)
    store.ensure(first)
    place = store.path(first.ref)
    assert json.loads((place / RECORD).read_text())["files"] == {
        path.name: {"bytes": path.stat().st_size, "xxh3": xxh3_128(path.read_bytes()).hexdigest()}
        for path in sorted(place.iterdir())
        if path.name != RECORD
    }


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_the_digest_that_is_found_while_a_tiff_is_written_is_that_of_the_file(store, tmp_path, compression):
    path = tmp_path / "map.tif"
    grid = PixelGrid(700, 900, 0.1, "mm")
    values = np.random.default_rng(1).normal(size=(*grid.shape, 3)).astype(np.float32)
    write_tiff(path, values, grid, description="a map", compression=compression)
    assert content_digests.digest_of_file(path) == xxh3_128(path.read_bytes()).hexdigest()
    assert bool(content_digests._known)


def test_no_more_digests_are_remembered_than_a_bounded_number(store, tmp_path, monkeypatch):
    monkeypatch.setattr(content_digests, "REMEMBERED", 3)
    for name in "abcde":
        (tmp_path / name).write_text(name)
        content_digests.digest_of_file(tmp_path / name)
    assert len(content_digests._known) == 3
    assert content_digests.digest_of_file(tmp_path / "a") == xxh3_128(b"a").hexdigest()


def test_a_second_name_of_a_file_needs_no_reading(store, tmp_path, monkeypatch):
    write_array(tmp_path / "a.npy", np.zeros((10, 10), np.float32))
    link_or_copy(tmp_path / "a.npy", tmp_path / "b.npy")
    monkeypatch.setattr(content_digests, "digest_of_content", None)
    assert content_digests.digest_of_file(tmp_path / "b.npy") == content_digests.digest_of_file(
        tmp_path / "a.npy"
    )


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o444])
def test_what_shares_its_place_loses_its_write_bits_and_nothing_else(tmp_path, mode):
    (tmp_path / "a").write_text("a")
    (tmp_path / "a").chmod(mode)
    give_out(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "a"
    assert (tmp_path / "b").stat().st_mode & 0o777 == mode & 0o555


def test_a_seal_is_of_all_that_a_record_says(tmp_path):
    for number, record in enumerate(({}, {"a": [1, 2.5, None]}, {"é": {"deep": "ü"}})):
        path = tmp_path / str(number)
        path.write_text(sealed(record))
        assert read_sealed(path) == record
