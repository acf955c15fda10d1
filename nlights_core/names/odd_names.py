"""Odd names: those that are no text, and those that a file system refuses."""

from __future__ import annotations

import errno
import os
from pathlib import Path

LONGEST_PATH = 4095
"""Bytes of a path; Linux refuses longer ones."""

_REFUSED = (errno.EILSEQ, errno.EINVAL, errno.ELOOP, errno.ENAMETOOLONG)


def is_text(name: str | Path) -> bool:
    r"""Test whether a name is UTF-8; of others Python holds a byte as half of a letter, which cannot be written down.

    For digests take `os.fsencode`, for people `nlights_core.names.control_characters.escape_controls`.

    Examples
    --------
    >>> is_text(os.fsdecode(b"inv-\xe9")), is_text("inv-\u00e9")
    (False, True)
    """
    try:
        str(name).encode()
    except UnicodeEncodeError:
        return False
    return True


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
