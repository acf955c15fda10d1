"""Interrupts by hand: the first ends a command in order, and those that follow do not disturb its end."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import Any

INTERRUPTED = 130
"""What a shell calls a command that was interrupted (128 + SIGINT)."""

GRACE = 5.0
"""Seconds that a command has to end in order; an interrupt after that ends it at once."""

PATIENCE = 20.0
"""Seconds in which Python must have tidied up after a command that was interrupted."""

AGAIN = 0.05
"""Seconds after which an interrupt is repeated that was lost where Python cannot raise it."""

SENTENCE = "stopped; what is finished is kept: the same command goes on from there"

_since: float | None = None
"""When the interrupt came that is being heeded."""


def heed_early() -> None:
    """Answer an interrupt while the program is still being loaded, or already ending, with a sentence."""
    default = sys.excepthook

    def say(kind: type[BaseException], fault: BaseException, trace: TracebackType | None) -> None:
        if not issubclass(kind, KeyboardInterrupt):
            default(kind, fault, trace)
        else:
            _end_at_once()

    sys.excepthook = say


def heed() -> None:
    """Let the first interrupt raise KeyboardInterrupt, and one that comes when `GRACE` is over end all at once.

    Where interrupts are ignored, as in a job that a shell runs in the background, they still are.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    signal.signal(signal.SIGINT, _heed)
    default = sys.unraisablehook

    def repeat(lost: Any) -> None:
        global _since
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            default(lost)
            return
        _since = None  # raised where nobody could catch it, as in a destructor: it is yet to be heeded
        threading.Timer(AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()

    sys.unraisablehook = repeat


def disregard() -> None:
    """Let no interrupt change the exit code of a command that has ended, while Python tidies up.

    What a thread or a server of this process still does is waited for, but not for longer than
    `PATIENCE` where an interrupt has come.
    """
    if signal.getsignal(signal.SIGINT) is not _heed:
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _since is not None:
        end = threading.Timer(PATIENCE, os._exit, (INTERRUPTED,))
        end.daemon = True
        end.start()


def _heed(number: int, frame: FrameType | None) -> None:
    global _since
    if _since is None:
        _since = time.monotonic()
        raise KeyboardInterrupt
    if time.monotonic() - _since > GRACE:
        _end_at_once()


def _end_at_once() -> None:
    """End without a further step; every file that matters appears whole or not at all."""
    shown = "\x1b[?25h" if sys.stderr and sys.stderr.isatty() else ""  # a progress bar hides the cursor
    try:
        os.write(2, f"{shown}{SENTENCE}\n".encode())
    finally:
        os._exit(INTERRUPTED)
