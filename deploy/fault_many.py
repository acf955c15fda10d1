"""A night of very many tiny tiles, twice in one process, to see whether anything grows from tile to tile.

Usage: python deploy/fault_many.py [--tiles 1000] [--recipe NAME] [--folder DIR]

The second night finds everything done.  After every tenth of the tiles it prints the memory, the open files and
threads, the seconds per tile since the last look, and the sizes of the page and of the record.  It exits with 0 only
if from the fourth look to the last none of them has grown by more than `GROWTH`, the record apart.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from fault_evidence import FaultError, record_of, require
from night_captures import FINISHED, simulated

from nlights_core.capture import Tile
from nlights_flows.nights.order import Batch, Order
from nlights_flows.nights.record import PAGE, RECORD, NightRecord
from nlights_flows.nights.running import run_night
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Around, Outcome, run_directly

TILES_OF_ARTWORK = 10
GROWTH = {"memory": 0.15, "files": 0.25, "threads": 0.0, "page": 0.10}
"""Share by which each may grow between the look `FROM` and the last; the seconds are for people to judge.

Memory: the night's own record is kept, and written as one text.  Files: Matplotlib opens its fonts again for each
thread that it meets, and keeps 64 of them at most.
"""

FROM = 3
"""From then on (400 tiles of 1000) the page is full, and every cache."""

ENOUGH = 1000
"""Tiles; fewer tell nothing."""


@dataclass(frozen=True)
class Look:
    """What is measured at a moment of a night.

    Attributes
    ----------
    tiles : int
        Made so far.
    memory : float
        Resident, MB.
    files, threads : int
        Open.
    seconds : float
        Per tile, since the last look.
    page, record : float
        Sizes, kB.
    """

    tiles: int
    memory: float
    files: int
    threads: int
    seconds: float
    page: float
    record: float

    def __str__(self) -> str:
        return (
            f"| {self.tiles} | {self.memory:.0f} | {self.files} | {self.threads} | {self.seconds:.2f} | "
            f"{self.page:.0f} | {self.record:.0f} |"
        )


@dataclass
class Watch:
    """Looks at this process while it runs a night, every so many tiles."""

    out: Path
    every: int
    done: int = 0
    last: float = field(default_factory=time.monotonic)
    looks: list[Look] = field(default_factory=list)

    def run(self, batch: Batch, around: Around) -> None:
        """Run an artwork's tiles here, as a night does, without progress on the console."""
        for tile in batch.tiles:
            around(tile, lambda tile=tile: self._run(batch, tile))  # type: ignore[misc]
            self.done += 1
            if self.done % self.every == 0:
                self.look()

    def look(self) -> None:
        """Measure now."""
        now = time.monotonic()
        tiles = self.done - (self.looks[-1].tiles if self.looks else 0)
        sizes = [self._size(name) for name in (PAGE, RECORD)]
        self.looks.append(
            Look(
                self.done,
                int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6,
                len(list(Path("/proc/self/fd").iterdir())),
                len(list(Path("/proc/self/task").iterdir())),
                (now - self.last) / max(tiles, 1),
                *sizes,
            )
        )
        self.last = now
        print(self.looks[-1], flush=True)

    def _run(self, batch: Batch, tile: Tile) -> Outcome:
        return run_directly(tile, batch.night.recipe, batch.night.options, lambda *told: None)

    def _size(self, name: str) -> float:
        path = self.out / name
        return path.stat().st_size / 1e3 if path.exists() else 0.0


def fill(inbox: Path, tiles: int) -> None:
    """Write an inbox of artworks of `TILES_OF_ARTWORK` tiles each, all with the same photographs."""
    first = simulated(inbox / ".first", "first", "painting", 32, seed=1)
    manifest = yaml.safe_load(first.read_text(encoding="utf-8"))
    for i in range(tiles // TILES_OF_ARTWORK):
        folder, name = inbox / f"inv-{i:04d}", f"inv-{i:04d}"
        (folder / "flat").mkdir(parents=True)
        for path in (first.parent / "dark.tif", *(first.parent / "flat").iterdir()):
            shutil.copy(path, folder / path.relative_to(first.parent))
        names = [f"t{j}" for j in range(TILES_OF_ARTWORK)]
        for tile in names:
            (folder / tile).mkdir()
            for path in first.parent.glob("light_*.tif"):
                shutil.copy(path, folder / tile)
        manifest["artwork"] = {"id": name, "title": f"Artwork {i}"}
        manifest["frames"] = {
            lamp: "{tile}/" + Path(path).name for lamp, path in sorted(manifest["frames"].items())
        }
        manifest["tiles"] = [{"name": tile, "origin_mm": [450 * j, 0]} for j, tile in enumerate(names)]
        (folder / "artwork.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
        (folder / FINISHED).touch()


def require_flat(looks: Sequence[Look]) -> None:
    """See that nothing has grown from the look `FROM` to the last.

    Raises
    ------
    FaultError
        Naming what has.
    """
    full, last = looks[min(FROM, len(looks) - 1)], looks[-1]
    grown = [
        f"{name} from {getattr(full, name):.0f} to {getattr(last, name):.0f}"
        for name, share in GROWTH.items()
        if getattr(last, name) > (1 + share) * getattr(full, name)
    ]
    require(not grown, f"between {full.tiles} and {last.tiles} tiles have grown: {'; '.join(grown)}")


def main(words: Sequence[str] | None = None) -> int:
    """Run the two nights; returns the exit code."""
    options = _options(words)
    folder = options.folder.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    fill(folder / "inbox", options.tiles)
    out = folder / "out"
    order = Order(folder / "inbox", RunOptions(out=out, recipe=options.recipe), settle=0.0)
    print(
        "| tiles | memory, MB | files | threads | s per tile | page, kB | record, kB |\n|---|---|---|---|---|---|---|"
    )
    try:
        first = Watch(out, max(options.tiles // 10, 1))
        _require_all(run_night(order, first.run), "done", options.tiles)
        again = Watch(out, options.tiles)
        _require_all(run_night(order, again.run), "unchanged", options.tiles)
        again.done = options.tiles
        again.look()
        if options.tiles >= ENOUGH:
            require_flat([*first.looks, again.looks[-1]])
    except FaultError as fault:
        print(fault, file=sys.stderr)
        return 1
    return 0


def _require_all(record: NightRecord, state: str, tiles: int) -> None:
    states = [tile.state for tile in record.tiles]
    require(states == [state] * tiles, f"not every tile is {state}: {record_of(Path(record.out))['verdict']}")


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="A night of very many tiny tiles, twice.")
    parser.add_argument("--tiles", type=int, default=1000, metavar="N")
    parser.add_argument("--recipe", default="paper", metavar="NAME")
    default = Path(__file__).resolve().parents[1] / "build" / "faults" / "many"
    parser.add_argument("--folder", type=Path, default=default, metavar="DIR", help="for all data")
    return parser.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
