"""Nights that are killed: worker, run, server or database, at a random moment; the last time all of them.

Usage: python deploy/fault_kills.py [--kills 20] [--first N] [--last N] [--seed N] [--folder DIR] [--width N]

Every round is a night of its own over the same inbox, on one Prefect server, PostgreSQL and worker.
It exits with 0 only if every night ended Completed with the bytes of an undisturbed one.
"""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import fault_evidence as evidence
from fault_evidence import FaultError, require
from fault_night import require_no_pickles, watched
from fault_victims import RUN_DIES, VICTIMS, bring_back, end_runs, follow, give_up, kill
from night_captures import fill
from night_processes import ServiceError
from night_services import Services

ARTWORKS = 4
PATIENCE = 150.0
"""Seconds that one night may take, its faults included."""

SETTINGS = {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30", "PREFECT_WORKER_QUERY_SECONDS": "1"}
WATCHED = "watched"
"""File of what every process of the services published and unpickled."""

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Kill:
    """Who is killed, and when: so many seconds after so many artefacts were there."""

    victim: str
    artefacts: int
    later: float

    def __str__(self) -> str:
        return f"{self.victim} after artefact {self.artefacts} + {self.later:.2f} s"


@dataclass
class Round:
    """What became of a night that was killed."""

    kills: list[Kill]
    finished: list[int] = field(default_factory=list)
    drafts: list[int] = field(default_factory=list)
    acts: list[str] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class Whole:
    """What an undisturbed night makes."""

    products: dict[str, str]
    artefacts: dict[str, str]
    folders: int

    @classmethod
    def of(cls, out: Path, store: Path) -> Whole:
        """Look at what a night left."""
        evidence.require_whole(store)
        products, artefacts = evidence.digest_of_products(out), evidence.digest_of_artefacts(store)
        return cls(products, artefacts, len(evidence.seen(store)))


def undisturbed(services: Services, folder: Path) -> Whole:
    """Run a night that nothing happens to, through the worker.

    Raises
    ------
    FaultError
        When it does not complete.
    """
    run = begin(services, folder)
    state = follow(services, run, PATIENCE)
    require(state["type"] == "COMPLETED", f"the undisturbed night ended {state['name']}: {state['message']}")
    return Whole.of(folder / "out", folder / "store")


def begin(services: Services, folder: Path) -> dict[str, Any]:
    """Ask for a night with folders of its own."""
    return services.run(
        "nightly/nightly", out=str(folder / "out"), store=str(folder / "store"), until=None, settle=0
    )


def killed_night(services: Services, folder: Path, whole: Whole, kills: Sequence[Kill]) -> Round:
    """Run a night, kill as is asked, bring back what was killed, and ask again until a night is completed.

    Raises
    ------
    FaultError
        With everything that a fault cost which it should not.
    """
    started, one = time.monotonic(), Round(list(kills))
    out, store = folder / "out", folder / "store"
    run = begin(services, folder)
    before: evidence.Seen = {}
    for blow in kills:
        _await(services, run, store, blow)
        evidence.require_nothing_redone(before, store)
        before = evidence.seen(store)
        kill(services, blow.victim, run)
        one.finished.append(len(before))
        one.drafts.append(len(evidence.left_about(out, store)))
        bring_back(services, blow.victim)
        if blow.victim in RUN_DIES:
            run = _again(services, run, folder, one)
    state = follow(services, run, PATIENCE)
    for _ in range(3):
        if state["type"] == "COMPLETED":
            break
        run = _again(services, run, folder, one)
        state = follow(services, run, PATIENCE)
    one.seconds = time.monotonic() - started
    require(state["type"] == "COMPLETED", f"no night completed: {state['name']}: {state['message']}")
    evidence.require_whole(store)
    evidence.require_nothing_redone(before, store)
    evidence.require_same(whole.products, evidence.digest_of_products(out), "products")
    evidence.require_same(whole.artefacts, evidence.digest_of_artefacts(store), "artefacts")
    left = evidence.left_about(out, store)
    require(not left, f"is left of the killed night: {', '.join(left)}")
    require(evidence.record_of(out)["ended"] is not None, "the page of the night says that it is at work")
    return one


def _await(services: Services, run: dict[str, Any], store: Path, blow: Kill) -> None:
    """Wait for the moment of a kill."""
    until = time.monotonic() + PATIENCE
    while len(evidence.seen(store)) < blow.artefacts or not store.exists():
        require(time.monotonic() < until, f"the moment never came: {blow}: {services.state(run)}")
        time.sleep(0.01)
    time.sleep(blow.later)


def _again(services: Services, run: dict[str, Any], folder: Path, one: Round) -> dict[str, Any]:
    """Ask for the night again, as an operator does who finds it dead in the morning."""
    state = follow(services, run, 30)
    act = f"it ended {state['name']}"
    if state["type"] == "RUNNING":  # nobody is left to report it
        give_up(services, run)
        act = "it stayed Running; marked Crashed"
    one.acts.append(f"{act}; asked for again")
    for _ in range(20):
        run = begin(services, folder)
        state = follow(services, run, 2.5)
        if state["type"] != "CANCELLED":
            return run
        # The deployment runs once at a time, and the dead run's turn is not given back yet.
    raise FaultError("the night was asked for again and again, and cancelled each time")


def plan(kills: int, seed: int, folders: int) -> Iterator[Kill]:
    """Draw whom to kill and when; each victim as often as the others."""
    chance = random.Random(seed)
    while kills > 0:
        victims = list(VICTIMS)
        chance.shuffle(victims)
        for victim in victims[:kills]:
            # Not after the last: there must be something to disturb.
            yield Kill(victim, chance.randrange(folders - 1), chance.uniform(0, 0.5))
        kills -= len(victims)


@contextmanager
def at_work(folder: Path, artworks: int, width: int) -> Iterator[Services]:
    """Fill an inbox and start the services; end everything at the end, whatever happens."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    list(fill(folder / "inbox", artworks, width, faults=False))
    settings = {**SETTINGS, **watched(folder / WATCHED)}
    with Services(folder / "services", folder / "inbox", folder / "products", settings=settings) as services:
        try:
            services.register()
            services.worker.start()
            yield services
        finally:
            services.worker.kill()
            end_runs(services)


def rounds(services: Services, folder: Path, whole: Whole, kills: Iterable[tuple[int, Kill]]) -> int:
    """Run one night for each kill; returns how many were not survived."""
    failed = 0
    print("| round | killed | finished then | being written | by itself, or whose act | s | result |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for number, blow in kills:
        place = folder / f"round-{number}"
        try:
            one = killed_night(services, place, whole, [blow])
        except (FaultError, ServiceError) as fault:
            failed += 1
            print(f"| {number} | {blow} | | | | | failed: {fault} |", flush=True)
            continue
        acts = "; ".join(one.acts) or "went on by itself"
        counts = f"{one.finished[0]} of {whole.folders} | {one.drafts[0]}"
        print(f"| {number} | {blow} | {counts} | {acts} | {one.seconds:.0f} | same bytes |", flush=True)
        shutil.rmtree(place)
    return failed


def main(words: Sequence[str] | None = None) -> int:
    """Run the rounds; returns the exit code."""
    options = _options(words)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    folder = options.folder.resolve()
    try:
        with at_work(folder, ARTWORKS, options.width) as services:
            whole = undisturbed(services, folder / "undisturbed")
            print(f"seed {options.seed}; {len(whole.products)} product files, {whole.folders} artefacts")
            drawn = [
                *plan(options.kills, options.seed, whole.folders),
                Kill("power", whole.folders // 2, 0.2),
            ]
            chosen = list(enumerate(drawn, 1))[options.first - 1 : options.last]
            failed = rounds(services, folder, whole, chosen)
            require_no_pickles(folder / WATCHED)
    except (FaultError, ServiceError) as fault:
        print(f"failed: {fault}; logs are in {folder / 'services'}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped; nothing was left running", file=sys.stderr)
        return 130
    print(f"{len(chosen) - failed} of {len(chosen)} survived")
    return 1 if failed else 0


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Nights that are killed at random moments.")
    parser.add_argument("--kills", type=int, default=20, metavar="N", help="how many nights; 20")
    parser.add_argument("--first", type=int, default=1, metavar="N", help="the first of them to run; 1")
    parser.add_argument("--last", type=int, metavar="N", help="the last of them to run")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of victims and moments; 1")
    parser.add_argument("--width", type=int, default=96, metavar="N", help="of the photographs, px; 96")
    default = HERE.parent / "build" / "faults" / "kills"
    parser.add_argument("--folder", type=Path, default=default, metavar="DIR", help="for all data and logs")
    return parser.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
