"""Containers: how much memory the control groups of this process allow (Linux; elsewhere there are none)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

GROUPS = Path("/proc/self/cgroup")
MOUNT = Path("/sys/fs/cgroup")

UNLIMITED = 1 << 60
"""Version 1 says "no limit" by a number near 2^63."""


def memory_limit(groups: Path = GROUPS, mount: Path = MOUNT) -> int | None:
    """The smallest limit of memory among the control groups that this process is in, bytes.

    A limit of a group holds for all groups within it.  Both versions of control groups are understood; in a
    container the path that the kernel names may not be there, because the container sees its own group as the
    root, so the root is looked at too.

    Parameters
    ----------
    groups : Path
        The kernel's list of the groups of this process.
    mount : Path
        Where control groups are mounted.

    Returns
    -------
    int or None
        None where there is no limit, or no control groups.
    """
    limits = [limit for file in _limit_files(groups, mount) if (limit := _read_limit(file)) is not None]
    return min(limits, default=None)


def _limit_files(groups: Path, mount: Path) -> Iterator[Path]:
    try:
        lines = groups.read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        # "0::/system.slice/x" is version 2, "5:memory:/docker/abc" version 1.
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            top, name = mount, "memory.max"
        elif "memory" in controllers.split(","):
            top, name = mount / "memory", "memory.limit_in_bytes"
        else:
            continue
        group = top / path.lstrip("/")
        yield group / name
        for parent in group.parents:
            if not parent.is_relative_to(top):
                break
            yield parent / name


def _read_limit(file: Path) -> int | None:
    try:
        said = file.read_text(encoding="utf-8").strip()
    except OSError:
        return None
    return int(said) if said.isdecimal() and int(said) < UNLIMITED else None  # "max": no limit
