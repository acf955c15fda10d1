"""Standard output and error: what is said there, whatever stands in it and whoever reads it."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from nlights_core.errors import NlightsError
from nlights_core.names.control_characters import escape_controls

_outlives = False


def prepare_streams() -> None:
    """Let nothing that is said end the program but a reader who goes away.

    A letter that the output's encoding lacks is written as a backslash escape.  A stream that was
    closed before the start leads nowhere, so that no file of ours gets its number.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    sys.stdout = sys.stdout or _nowhere()
    sys.stderr = sys.stderr or _nowhere()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if isinstance(logging.lastResort, logging.Handler):  # what libraries say where nobody set up logging
        logging.lastResort.setFormatter(_Escaping())


def say(text: object = "") -> None:
    """Print to the standard output, control characters escaped."""
    print(escape_controls(str(text)))


def say_json(data: Any) -> None:
    """Print values to the standard output as JSON, for programs; every letter is one of ASCII that can be seen."""
    print(json.dumps(data, indent=1).replace("\x7f", "\\u007f"))


def complain(sentence: object) -> None:
    """Print a fault, or what is going on, to the standard error, control characters escaped."""
    try:
        print(escape_controls(str(sentence)), file=sys.stderr, flush=True)
    except BrokenPipeError:
        if not _outlives:
            raise
        silence(sys.stderr.fileno())


@contextmanager
def faults_escaped() -> Iterator[None]:
    """Let no sentence of a fault leave the block with a control character: others log what they are raised."""
    try:
        yield
    except NlightsError as fault:
        if (shown := escape_controls(str(fault))) == str(fault):
            raise
        raise type(fault)(shown) from None


def outlive_listener() -> None:
    """Let this process go on when nobody reads its standard error any more: a night has other work to do."""
    global _outlives
    _outlives = True


def silence(*streams: int) -> None:
    """Let what is said there lead nowhere from now on."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        os.dup2(nowhere, stream)
    os.close(nowhere)


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123 - no Path has this name everywhere


class _Escaping(logging.Formatter):
    """Formatter of a log that goes to a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return escape_controls(super().format(record))
