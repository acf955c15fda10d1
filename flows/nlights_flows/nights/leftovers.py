"""Leftovers: small files that a night was about to put in their place when it was killed."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from nlights_flows.nights.inbox import NIGHTS

AGE = 600.0
"""Seconds after which nobody is about to put such a file in its place any more."""


def clear_leftovers(out: Path, store: Path) -> int:
    """Remove what killed nights left of records, pages, pictures, claims and digests; returns how many.

    Drafts of artefacts and products are swept where they are made.  What cannot be removed stays.
    """
    places = (
        (out, ".night.*-*"),
        (out, ".probe-*"),
        (out / NIGHTS, "*/.night.*-*"),
        (out / NIGHTS / ".thumbnails", ".*.jpg"),
        (store, ".probe-*"),
        (store / ".claims", "*/.now-*"),
        (store / ".claims", "*/.stale-*"),
        (store / ".digests", ".*-*"),
    )
    removed = 0
    for folder, pattern in places:
        for path in folder.glob(pattern):
            with suppress(OSError):
                if time.time() - path.lstat().st_mtime > AGE:
                    path.unlink()
                    removed += 1
    return removed
