"""Explaining: what is said of a fault that costs a tile."""

from __future__ import annotations

import errno
import traceback
from pathlib import Path

from nlights_core.errors import NlightsError
from nlights_core.names.control_characters import escape_controls
from nlights_core.store import Store


def explain_fault(fault: BaseException, store: Store) -> str:
    """A fault as a sentence: what happened and what to do; control characters are escaped."""
    return escape_controls(_explain(fault, store))


def _explain(fault: BaseException, store: Store) -> str:
    if isinstance(fault, NlightsError):
        return str(fault)
    if isinstance(fault, OSError):
        if fault.errno in (errno.ENOSPC, errno.EDQUOT):
            return (
                f"{fault.filename or store.root}: the disk is full; nothing half-written was left; free some "
                "space or choose another --store or --out, and run again: what is finished is kept"
            )
        return f"{fault.filename or store.root}: {fault.strerror or fault}"
    if isinstance(fault, MemoryError):
        return f"not enough memory ({fault}); close other programs or use a larger machine"
    where = traceback.extract_tb(fault.__traceback__)[-1]
    return (
        f"a defect, not your data: {type(fault).__name__}: {fault} "
        f"({Path(where.filename).name}:{where.lineno}); please report it to the author of the algorithm"
    )
