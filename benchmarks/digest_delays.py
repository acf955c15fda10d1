"""By how much the digests of the photographs delay a tile whose photographs are in memory: the store's price.

Everything else that the store does is flushing and renaming, which the stages' own seconds have in them.
"""

from __future__ import annotations

import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

RUNS = 5
DELAYS = {"digests of a first tile": False, "of a further tile": True}
"""Whether the flats were prepared before."""

LAST = "overview"
"""The stage before which all digests have to be known."""


def digest_delay(folder: Path, recipe: str, *, further: bool) -> float:
    """Median seconds between runs that have to find digests and runs that remember them.

    ``further``: only those of the frames, as for a tile whose flats were prepared with another one.
    """
    _seconds(folder, recipe)  # the photographs into memory
    store, differences = folder / "out" / ".store", []
    for _ in range(RUNS):
        seconds = {}
        for known in (True, False):
            _clear(store, further)
            if not known and further:
                for path in (folder / "capture").glob("light_*.tif"):
                    os.utime(path)  # so that its digest is asked for again
            elif not known:
                shutil.rmtree(store / ".digests")
            seconds[known] = _seconds(folder, recipe)
        differences.append(seconds[False] - seconds[True])
    return statistics.median(differences)


def _clear(store: Path, flats_stay: bool) -> None:
    """Take the artefacts out of a store that only has one artwork."""
    for place in store.glob("[!.]*/*"):
        if place.name != "_flats" or not flats_stay:
            shutil.rmtree(place)


def _seconds(folder: Path, recipe: str) -> float:
    """Seconds from the command to the end of its stage `LAST`; what comes after is not awaited."""
    started = time.monotonic()
    with digitising(folder, recipe) as process:
        assert process.stderr is not None
        said = next((line for line in process.stderr if re.match(rf"\S+: {LAST}: ", line)), None)
        seconds = time.monotonic() - started
        process.terminate()
    if said is None:
        raise SystemExit(f"nlights digitise ended with {process.returncode} before its stage {LAST}")
    return seconds


def digitising(folder: Path, recipe: str) -> subprocess.Popen[str]:
    """The command, started on the folder's capture without Prefect; what it says is in its ``stderr``."""
    options = ["--out", folder / "out", "--recipe", recipe]
    return subprocess.Popen(
        [Path(sys.executable).parent / "nlights", "digitise", folder / "capture", *options],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PREFECT_API_URL": ""},
    )
