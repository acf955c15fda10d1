"""Memory limits of containers, in both versions of control groups."""

from pathlib import Path

import pytest

from nlights_core import memory
from nlights_core.machine.containers import memory_limit

GIB = 1 << 30


@pytest.fixture
def kernel(tmp_path):
    """Write the kernel's list of groups and the files of the groups; say what is found."""

    def found(groups: str, files: dict[str, str]) -> int | None:
        (tmp_path / "cgroup").write_text(groups)
        for name, content in files.items():
            path = tmp_path / "mount" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content + "\n")
        return memory_limit(tmp_path / "cgroup", tmp_path / "mount")

    return found


def test_a_container_of_version_2_sees_its_own_group_as_the_root(kernel):
    assert kernel("0::/\n", {"memory.max": str(2 * GIB)}) == 2 * GIB


def test_a_limit_of_a_group_above_counts(kernel):
    files = {"a.slice/memory.max": str(3 * GIB), "a.slice/b/memory.max": "max"}
    assert kernel("0::/a.slice/b\n", files) == 3 * GIB


def test_the_smallest_limit_counts(kernel):
    files = {"a/memory.max": str(3 * GIB), "a/b/memory.max": str(GIB)}
    assert kernel("0::/a/b\n", files) == GIB


def test_version_1_names_the_controller(kernel):
    groups = "7:cpu,cpuacct:/docker/x\n5:memory:/docker/x\n1:name=systemd:/docker/x\n"
    assert kernel(groups, {"memory/docker/x/memory.limit_in_bytes": str(4 * GIB)}) == 4 * GIB


def test_a_container_of_version_1_whose_path_is_not_mounted_looks_at_the_root(kernel):
    assert kernel("5:memory:/docker/x\n", {"memory/memory.limit_in_bytes": str(GIB)}) == GIB


def test_no_limit_is_none(kernel):
    assert kernel("0::/\n", {"memory.max": "max"}) is None
    assert kernel("5:memory:/\n", {"memory/memory.limit_in_bytes": str(2**63 - 4096)}) is None


def test_where_there_are_no_groups_there_is_no_limit(tmp_path):
    assert memory_limit(tmp_path / "none", tmp_path) is None


def test_paths_with_colons_are_read_whole(kernel):
    assert kernel("0::/a:b\n", {"a:b/memory.max": str(GIB)}) == GIB


def test_a_limit_counts_as_the_machines_memory(monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    monkeypatch.setattr(memory, "memory_limit", lambda: 256 << 20)
    assert memory.budget() == 128 << 20
    with pytest.raises(memory.TileError, match=r"half of this container's memory is 128\.0 MiB|0\.1 GiB"):
        memory.require(GIB, "x")


@pytest.mark.skipif(not Path("/proc/self/cgroup").exists(), reason="no control groups on this system")
def test_this_machine_can_be_asked():
    limit = memory_limit()
    assert limit is None or limit > 1 << 20
