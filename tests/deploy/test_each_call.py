"""Calls of a small night that fail, and power that fails, 40 and 12 of them; `make faults` takes every one."""

import errno
import os
import shutil
import subprocess
import time

import fault_each
import pytest
from fault_calls import END, GO_ON, require_kernel, run_told
from fault_evidence import FaultError
from fault_night import SkippedError
from fault_power import Disk

from nlights_flows.nights.leftovers import AGE, clear_leftovers


@pytest.fixture(scope="module", autouse=True)
def kernel():
    try:
        require_kernel()
    except SkippedError as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def tile(tmp_path_factory):
    return fault_each.Tile(tmp_path_factory.mktemp("each") / "tile", "paper")


def test_forty_calls_fail_and_each_is_told_or_does_not_matter(tile, capsys):
    assert fault_each.fail_each(tile, 40, seed=1) == 0, capsys.readouterr().out
    assert "40 of 40 survived" in capsys.readouterr().out


def test_power_that_fails_costs_nothing_but_time(tile, capsys):
    assert fault_each.cut_each(tile, 12, seed=1) == 0, capsys.readouterr().out


def test_a_night_that_loses_what_it_said_it_had_is_noticed(tile):
    """The judges of the two tests above find what they look for."""
    tile.empty()
    assert run_told(tile.night, [tile.out], lambda call: GO_ON, tile.log).code == 0
    product = next(tile.out.glob("*/*/height.tif"))
    product.chmod(0o644)
    product.write_bytes(product.read_bytes()[:-1])
    with pytest.raises(FaultError, match="half products"):
        tile.require_no_half()
    (tile.out / ".night.html-00000000").touch()
    with pytest.raises(FaultError):
        tile.require_next()


def test_every_way_of_writing_is_told_and_can_fail(tmp_path):
    """From Python, from C (numpy writes an array with a stream of its own), and in a child of the child."""
    import numpy as np

    place, log = tmp_path / "place", tmp_path / "log"
    place.mkdir()
    ways = {
        "python": lambda: (place / "python").write_text("x"),
        "numpy": lambda: np.arange(9).tofile(str(place / "numpy")),
        "shell": lambda: subprocess.run(["sh", "-c", f"echo x > {place}/shell"], check=True),
    }
    for name, way in ways.items():
        told = []

        def answer(call, told=told):
            told.append(call)
            return errno.ENOSPC if call.kind == "write" else GO_ON

        ended = run_told(lambda way=way: way() and None, [place], answer, log)
        assert [call.kind for call in told if call.paths == (place / name,)][:2] == ["open", "write"], name
        # numpy leaves the end of an array to C's stream, and does not ask whether closing it went well.
        assert ended.code == (0 if name == "numpy" else 70), name
        assert (place / name).read_bytes() == b""
    # What lies elsewhere is nobody's business.
    assert run_told(lambda: (tmp_path / "b").write_text("") or None, [place], lambda call: END, log).code == 0


def test_what_was_not_flushed_is_lost(tmp_path):
    place, log = tmp_path / "place", tmp_path / "log"
    place.mkdir()

    def work():
        for name in ("flushed", "changed", "not"):
            with (place / name).open("w") as file:
                file.write("12345678")
                file.flush()
                if name != "not":
                    os.fsync(file.fileno())
        (place / "folder").mkdir()
        (place / "folder" / "inside").write_text("x")
        folder = os.open(place, os.O_RDONLY)
        os.fsync(folder)
        (place / "changed").write_text("new")
        (place / "late").write_text("late")
        (place / "flushed").rename(place / "renamed")
        return 0

    left = {}
    for way in ("nothing", "empty", "half"):
        shutil.rmtree(place)
        place.mkdir()
        disk = Disk([place])
        assert run_told(work, [place], lambda call, disk=disk: disk.told(call) or GO_ON, log).code == 0
        disk.lose(way)
        disk.close()
        left[way] = {path.name: path.read_text() for path in place.rglob("*") if path.is_file()}
        assert (place / "folder").is_dir()
    assert left["nothing"] == {"flushed": "12345678", "changed": "12345678", "not": ""}
    assert left["empty"] == {"renamed": "12345678", "changed": "", "not": "", "late": "", "inside": ""}
    assert left["half"] == {"renamed": "12345678", "changed": "n", "not": "1234", "late": "la", "inside": ""}


def test_leftovers_of_killed_nights_go_and_those_of_living_ones_stay(tmp_path):
    names = (
        "out/.night.html-01234567",
        "out/nights/2026-03-02/.night.json-01234567",
        "store/.probe-01234567",
    )
    names += (
        "store/.claims/inv-1/.now-0123",
        "store/.digests/.0123-01234567",
        "out/nights/.thumbnails/.01.jpg",
    )
    kept = (
        "out/night.html",
        "out/nights/2026-03-02/night.json",
        "store/.digests/0123",
        "store/.claims/inv-1/a",
    )
    for name in (*names, *kept):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert clear_leftovers(tmp_path / "out", tmp_path / "store") == 0
    for name in (*names, *kept):
        os.utime(tmp_path / name, (time.time() - 2 * AGE,) * 2)
    assert clear_leftovers(tmp_path / "out", tmp_path / "store") == len(names)
    assert all((tmp_path / name).exists() for name in kept)
