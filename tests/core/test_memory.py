"""The memory budget: how it is written, and what is said when it does not suffice."""

from pathlib import Path

import pytest

from nlights_core.errors import TileError
from nlights_core.memory import GIB, VARIABLE, budget, parse_size, require


@pytest.mark.parametrize(
    ("text", "size"),
    [("6GiB", 6 * GIB), ("6 g", 6 * GIB), ("1.5GB", 3 * GIB // 2), ("800M", 800 << 20), ("2097152", 2 << 20)],
)
def test_sizes_are_read_as_people_write_them(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "lots", "-3GiB", "3 apples", "12"])
def test_what_is_no_size_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="write for instance 6GiB"):
        parse_size(text)


def test_half_of_the_machine_may_be_used_unless_said_otherwise(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("nlights_core.memory.memory_limit", lambda: None)
    with Path("/proc/meminfo").open() as file:
        kilobytes = int(file.readline().split()[1])
    assert budget() == pytest.approx(kilobytes * 1024 / 2, rel=0.01)
    monkeypatch.setenv(VARIABLE, "3GiB")
    assert budget() == 3 * GIB


def test_what_does_not_fit_is_refused_with_need_and_budget_and_remedy(monkeypatch):
    monkeypatch.setenv(VARIABLE, "2GiB")
    require(2 * GIB, "height")
    with pytest.raises(
        TileError, match=r"height: needs 3\.0 GiB .*NLIGHTS_MEMORY allows 2\.0 GiB; allow more"
    ):
        require(3 * GIB, "height")
