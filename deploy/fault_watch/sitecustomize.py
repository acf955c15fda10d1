"""Watches a Python process from its start: which artefacts it publishes, and who reads pickles in it.

Python imports this module by itself where its folder stands in ``PYTHONPATH``.  Lines are appended to
the file that ``NLIGHTS_WATCHED`` names; without it nothing happens.
"""

import os
import sys
from typing import Any


def _watch(handle: int) -> None:
    def told(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "pickle.find_class":
            # The frame that called the C code that asks for a class.
            reader = sys._getframe(1).f_code.co_filename
            line = f"pickle {'.'.join(map(str, arguments))} {reader}\n"
        elif event == "os.rename" and "/.draft-" in str(arguments[0]):
            line = f"published {arguments[1]}\n"
        else:
            return
        os.write(handle, line.encode())

    sys.addaudithook(told)


if path := os.environ.get("NLIGHTS_WATCHED"):
    _watch(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600))
