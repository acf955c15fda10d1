"""A night from end to end on this machine: PostgreSQL, Prefect server, worker, six artworks, two faults.

Usage: python deploy/night_demo.py [--folder DIR] [--width N] [--keep] [--pictures DIR]

Everything it starts listens on the loopback address only and is stopped at the end, whatever happened.
It exits with 0 only if the good artworks are done and both faults are told.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import page_pictures
from night_captures import BROKEN, TWO_TILES, fill, whole_name
from night_processes import ServiceError
from night_services import Services

WHOLE = 4
PATIENCE = 280.0
"""Seconds that a night of small pictures may take."""

ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
STARTED = time.monotonic()


class DemoError(Exception):
    """A night that did not come out as it should."""


def main(words: Sequence[str] | None = None) -> int:
    """Run the demonstration; returns the exit code."""
    options = _options(words)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    folder = options.folder.resolve()
    if folder.exists() and not (folder / "inbox").is_dir() and any(folder.iterdir()):
        print(f"{folder} holds something else; choose another --folder", file=sys.stderr)
        return 2
    shutil.rmtree(folder, ignore_errors=True)
    inbox, products = folder / "inbox", folder / "products"
    inbox.mkdir(parents=True)
    try:
        say(f"simulating {WHOLE + 2} artworks, {options.width} px wide, in {inbox}")
        for name in fill(inbox, WHOLE, options.width):
            say(f"  {name}")
        say("starting PostgreSQL and the Prefect server")
        with Services(folder / "services", inbox, products, ui=True) as services:
            night(services, products)
            if options.pictures:
                pictures(services, products, options.pictures)
            tell(services, products, options.keep)
            if options.keep:
                _wait(services)
    except (DemoError, ServiceError, page_pictures.PictureError) as fault:
        print(f"\nthe demonstration failed: {fault}\nlogs are in {folder / 'services'}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nstopped; nothing was left running", file=sys.stderr)
        return 130
    say("stopped what was started")
    return 0


def night(services: Services, products: Path) -> None:
    """Register the deployments, start the worker, run the night and see that it came out well."""
    say(f"registering work pool, deployments and automations at {services.url}")
    services.register()
    say("starting the worker")
    services.worker.start()
    # Uploads here carry their marker; and it is night whenever somebody wants to look.
    run = services.run("nightly/nightly", until=None, settle=0)
    say(f"the night '{run['name']}' is asked for; waiting for the worker to take it up")
    state = follow(services, run)
    say(f"the night ended: {state['name']}")
    verify(state, products)
    say(f"as it should be: {WHOLE} artworks and the good tile are done, both faults are told")


def follow(services: Services, run: Mapping[str, Any], patience: float = PATIENCE) -> dict[str, Any]:
    """Print what becomes of a run and its subflows until it ends; returns its last state.

    Raises
    ------
    DemoError
        When it does not end in time.
    """
    told: dict[str, str] = {}
    until = time.monotonic() + patience
    while time.monotonic() < until:
        for one in services.ask("flow_runs/filter", {"sort": "START_TIME_ASC"}):
            if one["state_name"] not in ("Scheduled", told.get(one["id"])) and one["start_time"]:
                told[one["id"]] = one["state_name"]
                say(f"  {one['name']}: {one['state_name']}{_message(one)}")
        state = services.state(run)
        if state["type"] in ENDED:
            return state
        time.sleep(1)
    raise DemoError(f"the run '{run['name']}' did not end within {patience:g} s")


def _message(run: Mapping[str, Any]) -> str:
    lines = (run["state"]["message"] or "").splitlines()
    return f": {lines[0]}" if lines else ""


def verify(state: Mapping[str, Any], products: Path) -> None:
    """See that a night made what it can and told what it cannot.

    Raises
    ------
    DemoError
        With every difference.
    """
    wrong = []
    if state["type"] != "FAILED":  # two artworks failed; a night that says Completed would hide it
        wrong.append(f"the night should end as Failed, with both faults; it ended as {state['name']}")
    done = [*(f"{whole_name(i + 1)}/r0c0" for i in range(WHOLE)), f"{TWO_TILES}/a"]
    wrong += [f"{tile} has no report" for tile in done if not (products / tile / "report.html").exists()]
    undone = [f"{TWO_TILES}/b", BROKEN]
    wrong += [f"{tile} should not be there" for tile in undone if (products / tile).exists()]
    for page in ("night.html", "night.json"):
        path = products / page
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        names = [*(whole_name(i + 1) for i in range(WHOLE)), TWO_TILES, BROKEN]
        expected = [*names, "light_3.tif", "artwork.yaml"]  # the last two: where the faults are
        wrong += [f"{page} does not say '{word}'" for word in expected if word not in text]
    wrong += _states(products / "night.json")
    if wrong:
        raise DemoError("; ".join(wrong))


def _states(record: Path) -> list[str]:
    """What is wrong with the states that a night's record tells."""
    expected = {**{whole_name(i + 1): "done" for i in range(WHOLE)}, TWO_TILES: "failed", BROKEN: "failed"}
    try:
        artworks = json.loads(record.read_text(encoding="utf-8"))["artworks"]
        told = {Path(one["folder"]).name: one["state"] for one in artworks}
    except (OSError, ValueError, KeyError, TypeError) as fault:
        return [f"{record.name}: {fault!r}"]
    return [
        f"{record.name}: {name} should be {state}, is {told.get(name)}"
        for name, state in expected.items()
        if told.get(name) != state
    ]


def pictures(services: Services, products: Path, folder: Path) -> None:
    """Take pictures of both pages where a Chromium is installed; tell where not."""
    if page_pictures.chromium() is None:
        say("no pictures: there is no Chromium here (on Debian: apt install chromium)")
        return
    names = [whole_name(i + 1) for i in range(WHOLE)]
    taken = page_pictures.of_night(
        folder, products / "night.html", [*names, TWO_TILES, BROKEN], ["failed", "done"]
    )
    taken += page_pictures.of_prefect(folder, services.url, services.auth, ["nightly", *names, TWO_TILES])
    for path in taken:
        say(f"picture: {path}")


def tell(services: Services, products: Path, keep: bool) -> None:
    """Say where to look."""
    print(f"\nThe page of the night:  {(products / 'night.html')}")
    print(f"The products:           {products}")
    if keep:
        print(f"The Prefect server:     {services.url}/runs")
        print(f"  which asks for:       {services.auth}")
    else:
        print("The Prefect server is stopped now; --keep leaves it up to be looked at.")
    print(flush=True)


def _wait(services: Services) -> None:
    """Leave everything up until somebody presses Enter; where there is no terminal, until ctrl-C."""
    print("Press Enter to stop.", flush=True)
    if sys.stdin.isatty():
        sys.stdin.readline()
        return
    while services.server.running:
        time.sleep(1)


def say(line: str) -> None:
    """A line with the seconds since the start."""
    print(f"{time.monotonic() - STARTED:6.1f} s  {line}", flush=True)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="A night from end to end on this machine.",
        epilog="Stops what it started, whatever happened.",
    )
    default = Path(__file__).resolve().parents[1] / "build" / "night-demo"
    parser.add_argument("--folder", type=Path, default=default, metavar="DIR", help="for all data and logs")
    parser.add_argument("--width", type=int, default=240, metavar="N", help="of the photographs, px; 240")
    parser.add_argument("--keep", action="store_true", help="leave the server up until Enter or ctrl-C")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="take pictures of the pages with Chromium"
    )
    return parser.parse_args(words)


if __name__ == "__main__":
    sys.exit(main())
