"""What is no regular file is refused before it is opened: a pipe would be waited for."""

import os
import socket
from contextlib import chdir

import pytest

from nlights_core.configurations import Source
from nlights_core.errors import CaptureError, TileError
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.photographs.images import probe
from nlights_core.photographs.masks import Mask
from nlights_core.store import Store
from nlights_plugins.given_directions import read_directions


def pipe(path):
    os.mkfifo(path)


def listener(path):
    with socket.socket(socket.AF_UNIX) as one, chdir(path.parent):  # the name of a socket may not be long
        one.bind(path.name)


KINDS = {
    "a folder": os.mkdir,
    "a named pipe": pipe,
    "a socket": listener,
    "a device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.skipif(os.name == "nt", reason="has no such files")
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_called_what_it_is_by_whoever_would_open_it(tmp_path, kind):
    path = tmp_path / "a.tif"
    KINDS[kind](path)
    assert irregular_kind(path) == kind
    for read, error in (
        (probe, TileError),
        (Mask, TileError),
        (Store(tmp_path / "store").digest, TileError),
        (read_directions, TileError),
        (lambda path: Source(path, CaptureError), CaptureError),
    ):
        with pytest.raises(error, match=rf"a\.tif: {kind}, where a "):
            read(path)


def test_a_link_to_a_file_is_a_file(tmp_path):
    (tmp_path / "a").write_text("")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert irregular_kind(tmp_path / "b") == ""
