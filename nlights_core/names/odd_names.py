"""Odd names: those that are no text, and those that a file system refuses."""

from __future__ import annotations

import errno
import os
from pathlib import Path

LONGEST_PATH = 4095
"""Bytes of a path; Linux refuses longer ones."""

_REFUSED = (errno.EILSEQ, errno.EINVAL, errno.ELOOP, errno.ENAMETOOLONG)


def shown(name: str | Path) -> str:
    r"""A name for people, for JSON and for pages: bytes that are no UTF-8 become backslash escapes.

    Python holds such a byte of a file's name as half of a letter, which can be opened but not written down.
    For digests take `os.fsencode`.

    Examples
    --------
    >>> print(shown(os.fsdecode(b"inv-\xe9")), shown("inv-\u00e9"))
    inv-\xe9 inv-é
    """
    text = str(name)
    try:
        return os.fsencode(text).decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # halves that stand for no byte: no name of a file, but perhaps of a field
        return text.encode("utf-8", "backslashreplace").decode()


def refusal(path: Path) -> str:
    """Reason why no file can have a name, as the rest of a sentence; empty where one may, or where that is not known.

    That there is no such file, or that it may not be looked at, is no fault of the name.

    Examples
    --------
    >>> refusal(Path("light_1.tif")), refusal(Path("x" * 5000))[:45]
    ('', 'is 5000 bytes long, and 4095 are allowed; sho')
    """
    size = len(os.fsencode(path))
    if size > LONGEST_PATH:
        return f"is {size} bytes long, and {LONGEST_PATH} are allowed; shorten it"
    try:
        path.stat()
    except OSError as fault:
        if fault.errno == errno.ELOOP:
            return "is a link that leads in a circle; put the file itself there"
        return f"cannot be a file's name ({fault.strerror}); correct it" if fault.errno in _REFUSED else ""
    except ValueError:
        return "cannot be a file's name (it holds U+0000); correct it"
    return ""
