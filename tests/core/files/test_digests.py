"""Digests: the same by reading and by mapping, and a child that answers or ends, quietly."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from xxhash import xxh3_128

from nlights_core.files.digests import PIECE, by_mapping, by_reading

CHILD = [sys.executable, "-P", "-m", "nlights_core.files.digests"]


@pytest.mark.parametrize("size", [0, 1, 12345, PIECE, PIECE + 1, 2 * PIECE + 4097])
def test_a_digest_is_the_same_by_reading_and_by_mapping(tmp_path, size):
    content = np.random.default_rng(size).bytes(size)
    (tmp_path / "file").write_bytes(content)
    wanted = xxh3_128(content).hexdigest()
    assert by_reading(tmp_path / "file") == by_mapping(tmp_path / "file") == wanted


def test_a_child_answers_for_one_file_after_the_other_whatever_they_are_called(tmp_path):
    paths = [tmp_path / "a b\n.tif", tmp_path / "ä.tif", tmp_path / os.fsdecode(b"\xff.tif")]
    try:
        for path in paths:
            path.write_text(path.name, errors="surrogateescape")
    except OSError:
        pytest.skip("this file system takes no such names")
    with subprocess.Popen(CHILD, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        for path in paths:
            child.stdin.write(os.fsencode(path).hex().encode() + b"\n")
            child.stdin.flush()
            assert child.stdout.readline().decode().strip() == by_reading(path)
    assert child.returncode == 0


def test_a_child_that_cannot_answer_ends_and_says_nothing(tmp_path):
    asked = os.fsencode(tmp_path / "none").hex() + "\n"
    with subprocess.Popen(
        CHILD, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        child.stdin.write(asked.encode())
        child.stdin.flush()
        assert child.stdout.read() == b""
        assert child.stderr.read() == b""
    assert child.returncode == 1


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="processes are looked at in /proc")
def test_a_file_that_is_truncated_while_it_is_mapped_kills_a_child_without_a_word(tmp_path):
    # It may die between two pieces as well, which it notices; some of ten are in the middle of one.
    codes = [killed_by_truncation(tmp_path) for _ in range(10)]
    assert -signal.SIGBUS in codes
    assert set(codes) <= {-signal.SIGBUS, 1}


def killed_by_truncation(folder: Path) -> int:
    """Code with which a child ends whose file is truncated."""
    path = folder / "file"
    with path.open("wb") as file:
        file.truncate(1 << 34)
    with subprocess.Popen(
        ["sh", "-c", 'ulimit -S -c "$(ulimit -H -c)"; exec "$@"', "sh", *CHILD],  # cores are allowed
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as child:
        child.stdin.write(os.fsencode(path).hex().encode() + b"\n")
        child.stdin.flush()
        while str(path) not in Path(f"/proc/{child.pid}/maps").read_text():
            time.sleep(0.001)
        os.truncate(path, 1)
        assert child.stdout.read() == b""
        assert child.stderr.read() == b""
    assert list(folder.iterdir()) == [path]  # no core
    return child.returncode
