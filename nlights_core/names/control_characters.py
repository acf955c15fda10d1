"""Control characters in names and sentences: shown as what they are, never sent to a terminal."""

from __future__ import annotations

import re
from typing import Any

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 but for tab and line feed, DEL, C1
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # those that turn the direction of writing
    "\u2028\u2029\ufeff"  # ends of lines and paragraphs, byte order mark
    "\ud800-\udfff]"  # halves of pairs: bytes of a name that is not UTF-8
)


def escape_controls(text: str) -> str:
    r"""Text with every control character as a person would write it down, ``\x1b``.

    Letters of all scripts stay, and so do tab and line feed.  A byte of a name that is not UTF-8
    becomes ``\xff``.

    Parameters
    ----------
    text : str
        That somebody else may have chosen: an id, a title, a file's name, an excerpt.

    Returns
    -------
    str
        The very same object where there is nothing to escape.

    Examples
    --------
    >>> escape_controls("inv-1\x1b[31m"), escape_controls("a\u202eb"), escape_controls("Käthe Kollwitz, 春")
    ('inv-1\\x1b[31m', 'a\\u202eb', 'Käthe Kollwitz, 春')
    """
    return _CONTROLS.sub(_escaped, text) if _CONTROLS.search(text) else text


def shown_escaped(value: Any) -> Any:
    """Value that is to be put into a page: of text, what `escape_controls` makes of it."""
    return escape_controls(value) if isinstance(value, str) else value


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    if 0xDC80 <= code <= 0xDCFF:  # how Python carries the byte of a name
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
