"""Mappers: digests that children find, whatever becomes of the children, and none of them is left."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import pytest
from xxhash import xxh3_128

from nlights_core.errors import TileError
from nlights_core.files.digests import by_reading
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.store import Store
from nlights_flows.tiles import mappers
from nlights_flows.tiles.mappers import WORTH, Mapper
from nlights_flows.tiles.photographs import Photographs

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="processes are looked at in /proc"
)

PARENT = """
import sys
from pathlib import Path
from nlights_flows import mappers
mappers.WORTH = 0
mappers.Mapper().digest(Path(sys.argv[1]))
"""


@pytest.fixture
def endless(tmp_path, monkeypatch) -> Path:
    """A file from a disk that is so slow that nothing ever comes: a pipe that nobody writes to."""
    monkeypatch.setattr(mappers, "WORTH", 0)
    os.mkfifo(tmp_path / "endless")
    return tmp_path / "endless"


@pytest.fixture
def mapper():
    found = Mapper()
    yield found
    found.stop()


def children(parent: int) -> set[int]:
    """Processes of a parent, also those that ended and that it did not wait for."""
    found = set()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rsplit(")", 1)[1].split()[1]) == parent:
                found.add(int(stat.parent.name))
        except (FileNotFoundError, ProcessLookupError):
            pass
    return found


def at_work(parent: int, others: set[int]) -> int:
    """A child of a parent, as soon as it hashes."""
    return until(
        lambda: next(
            (
                child
                for child in children(parent) - others
                if len(list(Path(f"/proc/{child}/task").iterdir())) == 2
            ),
            None,
        )
    )


def until(look: Callable[[], object]):
    """What is seen as soon as something is."""
    deadline = time.monotonic() + 60
    while not (seen := look()):
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return seen


def sparse(path: Path, size: int) -> Path:
    with path.open("wb") as file:
        file.truncate(size)
    return path


def test_a_large_file_is_hashed_by_a_child_of_its_own_session_and_a_small_one_is_read(
    tmp_path, mapper, capfd
):
    before = children(os.getpid())
    small, large = sparse(tmp_path / "small", WORTH - 1), sparse(tmp_path / "large", WORTH)
    assert mapper.digest(small) == by_reading(small)
    assert children(os.getpid()) == before
    assert mapper.digest(large) == by_reading(large)
    (child,) = children(os.getpid()) - before
    assert os.getsid(child) == child
    assert mapper.digest(large) == by_reading(large)
    assert children(os.getpid()) == before | {child}
    mapper.stop()
    assert children(os.getpid()) == before
    assert capfd.readouterr() == ("", "")


def test_a_child_that_is_killed_while_it_hashes_is_replaced_by_reading_and_then_by_another(
    tmp_path, endless, mapper, capfd
):
    before = children(os.getpid())
    with ThreadPoolExecutor() as pool:
        digest = pool.submit(mapper.digest, endless)
        os.kill(at_work(os.getpid(), before), signal.SIGKILL)
        until(lambda: children(os.getpid()) == before)
        endless.write_bytes(b"content")
        assert digest.result() == xxh3_128(b"content").hexdigest()
    assert children(os.getpid()) == before
    (tmp_path / "file").write_bytes(b"more")
    assert mapper.digest(tmp_path / "file") == xxh3_128(b"more").hexdigest()
    assert len(children(os.getpid()) - before) == 1
    assert capfd.readouterr() == ("", "")


def test_a_file_that_is_truncated_while_it_is_hashed_costs_the_child_only(tmp_path, mapper, capfd):
    before, path = children(os.getpid()), sparse(tmp_path / "large", 1 << 34)
    with ThreadPoolExecutor() as pool:
        digest = pool.submit(mapper.digest, path)
        maps = Path(f"/proc/{at_work(os.getpid(), before)}/maps")
        until(lambda: str(path) in maps.read_text())
        os.truncate(path, 1000)
        assert digest.result() == xxh3_128(bytes(1000)).hexdigest()
    assert children(os.getpid()) == before
    assert capfd.readouterr() == ("", "")


def test_where_no_child_can_be_started_the_file_is_read(tmp_path, mapper, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    path = sparse(tmp_path / "large", WORTH)
    assert mapper.digest(path) == by_reading(path)


def test_what_cannot_be_read_is_told_as_without_a_child(tmp_path, mapper, monkeypatch):
    monkeypatch.setattr(mappers, "WORTH", 0)
    with pytest.raises(
        TileError, match=r"none: cannot be read \(there is no such file\); put the photograph there"
    ):
        Store(tmp_path / "store").digest(tmp_path / "none", mapper.digest)
    with pytest.raises(TileError, match=r"cannot be read \(Is a directory\)"):
        Store(tmp_path / "store").digest(tmp_path, mapper.digest)


@pytest.mark.parametrize(
    "end", [None, TileError("damaged"), KeyboardInterrupt()], ids=["ends", "fails", "stopped"]
)
def test_no_child_is_left_of_a_tile_that(capture, endless, tmp_path, end, capfd):
    before, store = children(os.getpid()), Store(tmp_path / "store")
    slow = endless.replace(capture / "light_3.tif")
    (tile,), started = load_capture(capture), time.monotonic()
    with (
        pytest.raises(type(end)) if end else nullcontext(),
        Photographs.watched(tile, load_recipe("default"), store) as seen,
    ):
        until(lambda: all(digest.done() for path, (_, digest) in seen.stamps.items() if path != slow))
        at_work(os.getpid(), before)
        if end:
            raise end
    assert children(os.getpid()) == before
    assert time.monotonic() - started < 30
    assert capfd.readouterr() == ("", "")


def test_children_find_the_digests_that_the_stages_ask_for(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(mappers, "WORTH", 0)
    for module in ("nlights_core.store", "nlights_flows.tiles.mappers"):
        monkeypatch.setattr(f"{module}.by_reading", None)
    (tile,), store = load_capture(capture), Store(tmp_path / "store")
    store.prepare()
    with Photographs.watched(tile, load_recipe("default"), store):
        for path in tile.frames.values():
            assert Store(store.root).digest(path) == xxh3_128(path.read_bytes()).hexdigest()


def test_a_child_does_not_outlive_a_parent_that_is_killed_while_it_hashes(endless):
    with subprocess.Popen([sys.executable, "-c", PARENT, endless], stderr=subprocess.PIPE) as parent:
        child = at_work(parent.pid, set())
        parent.kill()
        assert parent.stderr.read() == b""
    until(lambda: ended(child))


def ended(process: int) -> bool:
    """Whether a process ended; whoever inherited it need not have waited for it yet."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True
