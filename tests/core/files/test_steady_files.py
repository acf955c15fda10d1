"""Large files: whole on the disk, let go by the memory where nobody reads them soon, faults told."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from nlights_core.files import steady_files
from nlights_core.files.steady_files import SteadyFile

MIB = 1 << 20


@pytest.fixture(autouse=True)
def short_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steady_files, "STEP", MIB)


def written(path: Path, size: int, *, read_soon: bool) -> bytes:
    """Write random bytes in pieces of odd sizes; what was meant to be written."""
    data = np.random.default_rng(1).bytes(size)
    with SteadyFile(path, read_soon=read_soon) as file:
        for start in range(0, size, 300_007):
            file.write(data[start : start + 300_007])
    return data


def in_memory(path: Path, start: int, size: int) -> bool:
    """Whether the system has these bytes of a file at hand."""
    with path.open("rb", buffering=0) as file:
        try:
            return os.preadv(file.fileno(), [bytearray(size)], start, os.RWF_NOWAIT) == size
        except BlockingIOError:
            return False
        except OSError as fault:
            pytest.skip(f"the file system does not say what is in memory: {fault.strerror}")


@pytest.mark.parametrize("read_soon", [True, False])
@pytest.mark.parametrize("size", [0, 5, MIB, 5 * MIB + 11])
def test_all_bytes_arrive_in_their_order(tmp_path: Path, size: int, read_soon: bool) -> None:
    data = written(tmp_path / "file", size, read_soon=read_soon)
    assert (tmp_path / "file").read_bytes() == data


def test_arrays_are_written_as_their_bytes(tmp_path: Path) -> None:
    records = np.array([(1, 2.5), (2, -1.0)], [("corners", "u1"), ("z", "<f4")])
    with SteadyFile(tmp_path / "file", "wb") as file:
        file.write(records.data)
    assert (tmp_path / "file").read_bytes() == records.tobytes()


def test_writing_goes_on_after_a_header(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"header--")
    with SteadyFile(path, "r+b", start=6) as file:
        file.write(b"pixels")
    assert path.read_bytes() == b"headerpixels"


@pytest.mark.skipif(not hasattr(os, "RWF_NOWAIT"), reason="only Linux says what is in memory")
def test_only_what_is_read_soon_stays_in_memory(tmp_path: Path) -> None:
    written(tmp_path / "kept", 8 * MIB, read_soon=True)
    written(tmp_path / "gone", 8 * MIB, read_soon=False)
    assert in_memory(tmp_path / "kept", 0, 4 * MIB)
    assert not in_memory(tmp_path / "gone", 0, 4 * MIB)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_told_as_such() -> None:
    with pytest.raises(OSError) as caught, SteadyFile(Path("/dev/full"), "wb") as file:
        file.write(bytes(2 * MIB))
    assert caught.value.errno == errno.ENOSPC


def test_a_fault_of_the_flush_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(handle: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="Input/output"), SteadyFile(tmp_path / "file") as file:
        file.write(bytes(2 * MIB))
