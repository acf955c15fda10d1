"""Wording: faults that the command line would tell, told to somebody who calls from Python."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from nlights_core.errors import NlightsError

OPTION = re.compile(
    r"--(address|compression|grid|memory|out|recipes?|root|runner|stand|store|tile|timeout)\b(?!-)"
)
"""An option of the command line, which is an argument here."""


def in_python(sentence: str) -> str:
    """A sentence whose options are called as the arguments are.

    Examples
    --------
    >>> in_python("--tile: capture has no tile 'b'; it has a")
    "tiles: capture has no tile 'b'; it has a"
    """
    return OPTION.sub(lambda found: "tiles" if found[1] == "tile" else found[1], sentence)


@contextmanager
def told_in_python() -> Iterator[None]:
    """Faults of nLights, with `in_python`'s words."""
    try:
        yield
    except NlightsError as fault:
        raise type(fault)(in_python(str(fault))) from None
