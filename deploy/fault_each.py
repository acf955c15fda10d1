"""Every call of a small night fails once, and the power fails before every one: what is said, left and done next.

Usage: python deploy/fault_each.py [--tries N] [--power N] [--seed N] [--recipe NAME] [--folder DIR]

The calls are those by which a night of one tile opens, writes, flushes, renames, links, makes and removes below
its store and products.  Without --tries every one of them fails, in turn with each of four faults; without --power
the power fails before every one that changes something.  It exits with 0 only if all were survived.
"""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import fault_evidence as evidence
from fault_calls import END, GO_ON, Call, Ended, run_told
from fault_evidence import FaultError, require
from fault_night import SkippedError
from fault_power import WAYS, Disk
from night_captures import simulated

from nlights_flows.commands import cli

FAULTS = (errno.ENOSPC, errno.EIO, errno.EMFILE, errno.EINTR)
CHANGES = ("write", "flush", "rename", "link", "mkdir", "remove")
"""Kinds of calls between which the disk differs."""

NAME = "inv-1801"


class Tile:
    """A night of one small tile, and what an undisturbed one makes of it.

    Parameters
    ----------
    folder : Path
        For everything.
    recipe : str
        By name.
    """

    def __init__(self, folder: Path, recipe: str = "default") -> None:
        self.folder, self.recipe, self.inbox = folder.resolve(), recipe, folder.resolve() / "inbox"
        self.out, self.log = self.folder / "out", self.folder / "log"
        self.store = self.out / ".store"
        shutil.rmtree(folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        simulated(self.inbox / NAME, NAME, "painting", 32, seed=1)
        self.empty()
        self.night()  # here, so that the others find everything loaded
        self.empty()
        self.calls: list[Call] = []
        ended = run_told(self.night, [self.out], self._count, self.log)
        require(ended.code == 0, f"the undisturbed night ended with {ended.code}: {ended.said}")
        self.products = evidence.digest_of_products(self.out)
        self.artefacts = evidence.digest_of_artefacts(self.store)
        require(len(self.products) > 5 and len(self.artefacts) > 10, "the undisturbed night made too little")

    def empty(self) -> None:
        """Begin anew, with empty folders."""
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir()

    def night(self) -> int:
        """Run the night in this process; returns its exit code."""
        words = [str(self.inbox), "--out", str(self.out), "--settle", "0", "--recipe", self.recipe]
        sys.argv = ["nlights", "nightly", *words]
        try:
            cli.main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    def fail(self, number: int, code: int) -> str:
        """One call fails; returns what became of it.

        Raises
        ------
        FaultError
            With everything that the fault cost which it should not.
        """
        self.empty()
        made: list[Call] = []

        def answer(call: Call) -> int:
            made.append(call)
            return code if len(made) == number + 1 else GO_ON

        ended = run_told(self.night, [self.out], answer, self.log)
        require(len(made) > number, f"the night made {len(made)} calls only")
        word = self._require_told(ended, code)
        self.require_no_half()
        if made[number].kind != "remove":  # what could not be removed is removed by the next
            self._require_nothing_left()
        self.require_next()
        return word

    def cut(self, number: int, way: str) -> str:
        """The power fails before a call; returns how much was there by then.

        Raises
        ------
        FaultError
            With everything that the fault cost which it should not.
        """
        self.empty()
        disk, seen = Disk([self.out]), 0

        def answer(call: Call) -> int:
            nonlocal seen
            seen += 1
            if seen == number + 1:
                return END
            disk.told(call)
            return GO_ON

        try:
            run_told(self.night, [self.out], answer, self.log)
            disk.lose(way)
        finally:
            disk.close()
        self.require_no_half()
        before = len(list(self.store.glob("*/*/*-*"))) if self.store.is_dir() else 0
        self.require_next()
        return f"{before} artefacts"

    def require_no_half(self) -> None:
        """See that products and artefacts are whole or not there."""
        found = evidence.digest_of_products(self.out)
        if found:
            evidence.require_same(self.products, found, "half products")
        if self.store.is_dir():
            evidence.require_whole(self.store)

    def require_next(self) -> None:
        """See that the next night ends well, with the bytes of the undisturbed one, and leaves nothing else."""
        ended = run_told(self.night, [self.out], lambda call: GO_ON, self.log)
        require(ended.code == 0, f"the next night ended with {ended.code}: {ended.said[-500:]}")
        require("Traceback" not in ended.said, ended.said)
        evidence.require_same(
            self.products, evidence.digest_of_products(self.out), "the next night's products"
        )
        evidence.require_same(
            self.artefacts, evidence.digest_of_artefacts(self.store), "the next night's artefacts"
        )
        evidence.require_whole(self.store)
        self._require_nothing_left()

    def _count(self, call: Call) -> int:
        self.calls.append(call)
        return GO_ON

    def _require_nothing_left(self) -> None:
        left = evidence.left_about(self.out, self.store)
        require(not left, f"is left: {', '.join(left)}")

    def _require_told(self, ended: Ended, code: int) -> str:
        """See that a night ended well, or with a sentence about the fault."""
        said = ended.said
        require(ended.code in (0, 1, 2), f"it ended with {ended.code}: {said[-1500:]}")
        for word in ("Traceback", "a defect, not your data", "Exception ignored"):
            require(word not in said, f"it said: {said[-1500:]}")
        if ended.code == 0:
            evidence.require_same(self.products, evidence.digest_of_products(self.out), "products")
            return "page not written" if "could not be written" in said else "did not matter"
        reason = "the disk is full" if code == errno.ENOSPC else os.strerror(code)
        require(reason in said and str(self.folder) in said, f"it does not say why: {said[-1500:]}")
        return "told"


def spread(count: int, tries: int | None, seed: int) -> Iterator[int]:
    """Numbers below a count, all or so many of them, evenly spread."""
    if tries is None or tries >= count:
        yield from range(count)
    else:
        yield from sorted({int((i + (seed * 0.618) % 1) * count / tries) for i in range(tries)})


def fail_each(tile: Tile, tries: int | None, seed: int) -> int:
    """Let calls fail, one at a time; prints what became of it, and returns how many were not survived."""
    failed, words = 0, Counter[str]()
    for turn, number in enumerate(spread(len(tile.calls), tries, seed)):
        code = FAULTS[(turn + seed) % len(FAULTS)]
        try:
            words[tile.fail(number, code)] += 1
        except FaultError as fault:
            failed += 1
            print(f"call {number}, {tile.calls[number]}, {errno.errorcode[code]}: {fault}", flush=True)
    told = ", ".join(f"{count} {word}" for word, count in sorted(words.items()))
    print(f"a call fails: {words.total()} of {words.total() + failed} survived ({told})", flush=True)
    return failed


def cut_each(tile: Tile, tries: int | None, seed: int) -> int:
    """Let the power fail, once at a time; prints what became of it, and returns how often it was not survived."""
    failed, survived = 0, 0
    moments = [number for number, call in enumerate(tile.calls) if call.kind in CHANGES]
    for turn, place in enumerate(spread(len(moments), tries, seed)):
        number, way = moments[place], WAYS[(turn + seed) % len(WAYS)]
        try:
            tile.cut(number, way)
            survived += 1
        except FaultError as fault:
            failed += 1
            print(f"power before call {number}, {tile.calls[number]}, {way}: {fault}", flush=True)
    print(f"the power fails: {survived} of {survived + failed} survived", flush=True)
    return failed


def main(words: Sequence[str] | None = None) -> int:
    """Make the faults; returns the exit code."""
    options = _options(words)
    began = time.monotonic()
    try:
        tile = Tile(options.folder, options.recipe)
    except SkippedError as reason:
        print(f"skipped: {reason}")
        return 0
    kinds = Counter(call.kind for call in tile.calls)
    print(
        f"{len(tile.calls)} calls: {', '.join(f'{n} {kind}' for kind, n in kinds.most_common())}", flush=True
    )
    failed = fail_each(tile, options.tries, options.seed) + cut_each(tile, options.power, options.seed)
    print(f"{time.monotonic() - began:.0f} s")
    return 1 if failed else 0


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Every call of a small night fails once.")
    parser.add_argument("--tries", type=int, metavar="N", help="so many calls only")
    parser.add_argument("--power", type=int, metavar="N", help="so many failures of the power only")
    parser.add_argument("--seed", type=int, default=1, help="which of them, and with which fault")
    parser.add_argument("--recipe", default="default", metavar="NAME")
    default = Path(__file__).resolve().parents[1] / "build" / "faults" / "each"
    parser.add_argument("--folder", type=Path, default=default, metavar="DIR", help="for all data and logs")
    return parser.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
