"""Calls to the system by which a process opens, writes, flushes and renames: each is told first, and may be failed.

The kernel itself tells them (seccomp's user notification; Linux 5.5 or newer, x86-64), so it does not matter
which library, thread or child makes the call, or in which language.  Nothing is told of bytes that are written
through a memory map or by io_uring, nor of ioctl (a reflink).
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import platform
import select
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fault_evidence import FaultError
from fault_night import SkippedError

GO_ON, END = 0, -1
"""Answers to a call, beside a number of `errno`: let it happen; kill all that was started, before it happens."""

PATIENCE = 120.0
"""Seconds that the work may take."""

AT = -100
"""Handle that means the working folder."""

CALLS: dict[int, tuple[str, str, tuple[tuple[int | None, int], ...]]] = {
    # number: (name, kind, (argument of the folder's handle or None, argument of the path) ...)
    2: ("open", "open", ((None, 0),)),
    85: ("creat", "open", ((None, 0),)),
    257: ("openat", "open", ((0, 1),)),
    437: ("openat2", "open", ((0, 1),)),
    82: ("rename", "rename", ((None, 0), (None, 1))),
    264: ("renameat", "rename", ((0, 1), (2, 3))),
    316: ("renameat2", "rename", ((0, 1), (2, 3))),
    86: ("link", "link", ((None, 0), (None, 1))),
    265: ("linkat", "link", ((0, 1), (2, 3))),
    83: ("mkdir", "mkdir", ((None, 0),)),
    258: ("mkdirat", "mkdir", ((0, 1),)),
    87: ("unlink", "remove", ((None, 0),)),
    84: ("rmdir", "remove", ((None, 0),)),
    263: ("unlinkat", "remove", ((0, 1),)),
}
"""Calls that name paths."""

HANDLES: dict[int, tuple[str, str, int]] = {
    # number: (name, kind, argument of the handle)
    1: ("write", "write", 0),
    18: ("pwrite64", "write", 0),
    20: ("writev", "write", 0),
    296: ("pwritev", "write", 0),
    328: ("pwritev2", "write", 0),
    40: ("sendfile", "write", 0),
    326: ("copy_file_range", "write", 2),
    77: ("ftruncate", "write", 0),
    285: ("fallocate", "write", 0),
    74: ("fsync", "flush", 0),
    75: ("fdatasync", "flush", 0),
}
"""Calls about a file that is open."""

_SECCOMP, _LISTEN, _NO_NEW_RIGHTS, _X86_64 = 317, 8, 38, 0xC000003E
_RECEIVE, _ANSWER = 0xC0502100, 0xC0182101


@dataclass(frozen=True)
class Call:
    """A call to the system that is about to happen.

    Attributes
    ----------
    name, kind : str
        "renameat2"; open, write, flush, rename, link, mkdir or remove.
    paths : tuple of Path
        What it is about; of a rename or a link the source and the target.
    opened : Path
        Of a call about an open file: the way to that file, whatever name it has by now.
    """

    name: str
    kind: str
    paths: tuple[Path, ...]
    opened: Path = Path()

    def __str__(self) -> str:
        return f"{self.name} {' to '.join(map(str, self.paths))}"


@dataclass(frozen=True)
class Ended:
    """End of some work.

    Attributes
    ----------
    code : int
        What it returned; negative: minus the signal that killed it.
    said : str
        Its output and errors.
    """

    code: int
    said: str


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_uint16),
        ("yes", ctypes.c_uint8),
        ("no", ctypes.c_uint8),
        ("k", ctypes.c_uint32),
    )


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("first", ctypes.POINTER(_Instruction)))


def run_told(
    work: Callable[[], int | None], folders: Sequence[Path], answer: Callable[[Call], int], log: Path
) -> Ended:
    """Do some work in a child of this process, whose calls below some folders are told before they happen.

    Parameters
    ----------
    work : callable
        Returns an exit code, or nothing for 0.
    folders : sequence of Path
        Resolved.
    answer : callable
        Told every call; returns `GO_ON`, a number of `errno`, or `END`.
    log : Path
        For what the work says; outside the folders.

    Raises
    ------
    SkippedError
        Where the kernel cannot tell.
    FaultError
        When the work takes longer than `PATIENCE`.
    """
    require_kernel()
    ours, theirs = socket.socketpair()
    process = os.fork()
    if process == 0:
        ours.close()
        _do(work, theirs, log)
    theirs.close()
    try:
        listener = _received(ours)
        try:
            _listen(listener, folders, answer, process)
        finally:
            os.close(listener)
    finally:
        ours.close()
        _kill(process)
        _, status = os.waitpid(process, 0)
    return Ended(os.waitstatus_to_exitcode(status), log.read_text(encoding="utf-8", errors="replace"))


def require_kernel() -> None:
    """See that calls can be told here.

    Raises
    ------
    SkippedError
        With the reason.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SkippedError("only Linux on x86-64 is known to tell its calls")
    try:
        known = Path("/proc/sys/kernel/seccomp/actions_avail").read_text().split()
    except OSError:
        known = []
    if "user_notif" not in known:
        raise SkippedError("this kernel does not tell calls (seccomp's user_notif)")


def _do(work: Callable[[], int | None], theirs: socket.socket, log: Path) -> None:
    """Be the child: say what is said into a file, have calls told, work, end."""
    code = 70
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        for stream in (1, 2):
            os.dup2(handle, stream)
        sys.stdout = os.fdopen(1, "w", buffering=1, encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", buffering=1, encoding="utf-8", closefd=False)
        listener = _have_calls_told()
        socket.send_fds(theirs, [b"."], [listener])
        os.close(listener)
        code = int(work() or 0)
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _have_calls_told() -> int:
    """Ask the kernel to stop this process at every call of the tables; returns where it tells them."""
    numbers = [*CALLS, *HANDLES]
    load, equal, end, allow, tell = 0x20, 0x15, 0x06, 0x7FFF0000, 0x7FC00000
    lines = [(load, 0, 0, 4), (equal, 1, 0, _X86_64), (end, 0, 0, allow), (load, 0, 0, 0)]
    # Each jumps over those behind it, and over the line that lets the call happen untold.
    lines += [(equal, len(numbers) - i, 0, number) for i, number in enumerate(numbers)]
    lines += [(end, 0, 0, allow), (end, 0, 0, tell)]
    program = (_Instruction * len(lines))(*lines)
    whole = _Program(len(lines), program)
    system = ctypes.CDLL(None, use_errno=True)
    system.prctl(_NO_NEW_RIGHTS, 1, 0, 0, 0)
    listener = int(system.syscall(_SECCOMP, 1, _LISTEN, ctypes.byref(whole)))
    if listener < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return listener


def _received(ours: socket.socket) -> int:
    """Take from the child where the kernel tells its calls."""
    ours.settimeout(PATIENCE)
    _, handles, _, _ = socket.recv_fds(ours, 1, 1)
    if not handles:
        raise SkippedError("calls cannot be told here: the child was refused (see its log)")
    return int(handles[0])


def _listen(listener: int, folders: Sequence[Path], answer: Callable[[Call], int], process: int) -> None:
    """Answer calls until the child and all that it started have ended, or are ended."""
    poll, until = select.poll(), time.monotonic() + PATIENCE
    poll.register(listener, select.POLLIN)
    while True:
        ready = poll.poll(1000)
        if time.monotonic() > until:
            raise FaultError(f"the work did not end in {PATIENCE:g} s")
        if not ready:
            continue
        if not ready[0][1] & select.POLLIN:  # nobody is left
            return
        told = bytearray(80)
        try:
            fcntl.ioctl(listener, _RECEIVE, told)
        except OSError as fault:
            if fault.errno in (errno.ENOENT, errno.EINTR):  # who called is gone
                continue
            raise
        number, thread, _, call, _, _, *arguments = struct.unpack("=QIIiIQ6Q", told)
        made = _call(call, thread, arguments)
        wanted = GO_ON
        if made is not None and any(_below(path, folders) for path in made.paths):
            wanted = answer(made)
        if wanted == END:
            _kill(process)
            return
        said = struct.pack("=QqiI", number, 0, -wanted, 1 if wanted == GO_ON else 0)
        try:
            fcntl.ioctl(listener, _ANSWER, said)
        except OSError as fault:
            if fault.errno != errno.ENOENT:
                raise


def _below(path: Path, folders: Sequence[Path]) -> bool:
    return any(path == folder or folder in path.parents for folder in folders)


def _call(number: int, thread: int, arguments: Sequence[int]) -> Call | None:
    """A call in words; None where it cannot be told any more what it is about."""
    about = Path(f"/proc/{thread}")
    try:
        if number in HANDLES:
            name, kind, place = HANDLES[number]
            opened = about / "fd" / str(ctypes.c_int(arguments[place]).value)
            return Call(name, kind, (Path(str(opened.readlink()).removesuffix(" (deleted)")),), opened)
        name, kind, places = CALLS[number]
        paths = tuple(
            _path(about, AT if folder is None else ctypes.c_int(arguments[folder]).value, arguments[path])
            for folder, path in places
        )
        return Call(name, kind, paths)
    except OSError:
        return None


def _path(about: Path, folder: int, address: int) -> Path:
    """The path at an address in a process, as it is meant there."""
    with (about / "mem").open("rb", buffering=0) as memory:
        memory.seek(address)
        text = memory.read(4096).partition(b"\0")[0]
    base = about / "cwd" if folder == AT else about / "fd" / str(folder)
    return Path(os.path.normpath(base.readlink() / os.fsdecode(text)))


def _kill(process: int) -> None:
    """Kill a child with all that it started; it leads a session of its own."""
    try:
        os.killpg(process, signal.SIGKILL)
    except ProcessLookupError:
        pass
    except PermissionError:
        os.kill(process, signal.SIGKILL)
