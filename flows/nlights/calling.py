"""Calling: arguments as options of a run, and faults in the words of who calls from Python."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from nlights_core.errors import NlightsError
from nlights_flows.tiles.run_options import RunOptions

OPTION = re.compile(
    r"--(address|compression|grid|memory|out|recipes?|root|runner|stand|store|tile|timeout)\b(?!-)"
)
"""An option of the command line, which is an argument here."""


def run_options(given: Mapping[str, Any]) -> RunOptions:
    """Options of a run from a function's arguments; the recipe, which need be no name, goes another way."""
    stand, tiles = given["stand"], given["tiles"]
    plain = {
        **given,
        "recipe": "given",
        "stand": None if stand is None else str(stand),
        "tiles": [tiles] if isinstance(tiles, str) else tiles,
    }
    return RunOptions.of(plain)


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
