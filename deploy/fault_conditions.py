"""Faults about a night: disks, photographs, clocks, other nights, and captures that mean harm.

Usage: python deploy/fault_conditions.py [NAME ...] [--folder DIR]

Each fault is a function, made once; without names, all.  It exits with 0 only if all were survived;
what cannot be made here is skipped, with the reason.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path

import fault_evidence as evidence
import page_pictures
import yaml
from fault_evidence import FaultError, require
from fault_night import (
    Bench,
    SkippedError,
    ended,
    remount,
    require_no_pickles,
    run_night,
    small_disk,
    started,
    wait_for,
    watched,
)
from night_captures import whole_name

HOSTILE = "<script>alert(1)</script>"
FIRST = whole_name(1)


def full_disk(bench: Bench) -> str:
    """The store's disk fills up while a tile runs; there is room again later."""
    with small_disk(bench.folder / "full-disk", 64) as disk:
        out, store = bench.folder / "full-disk-out", disk / "store"
        with started(bench.inbox, out, "--store", store) as night:
            wait_for(night, store, 2)
            ballast = disk / "ballast"
            with ballast.open("wb", buffering=0) as file:
                try:
                    while file.write(bytes(100_000)):
                        pass
                except OSError:
                    pass
            ended(night, 1, 2)
        told = evidence.messages(out)
        require("the disk is full; nothing half-written was left" in told, told)
        evidence.require_whole(store)
        left = evidence.left_about(out, store)
        require(not left, f"half-written: {', '.join(left)}")
        before = evidence.seen(store)
        ballast.unlink()
        run_night(bench.inbox, out, "--store", store)
        evidence.require_nothing_redone(before, store)
        bench.require_products(out, store)
    return f"told, nothing half-written; the next night ended well and kept {len(before)} artefacts"


def read_only_store(bench: Bench) -> str:
    """The store becomes read-only while a tile runs, as a disk with errors does; later it can be written."""
    with small_disk(bench.folder / "read-only", 256) as disk:
        out, store = bench.folder / "read-only-out", disk / "store"
        with started(bench.inbox, out, "--store", store) as night:
            wait_for(night, store, 2)
            require(remount(disk, "ro"), "the disk stayed busy")
            ended(night, 1, 2)
        told = evidence.messages(out)
        require("Read-only file system" in told, told)
        evidence.require_whole(store)
        said = run_night(bench.inbox, out, "--store", store, codes=(2,))
        require("cannot be written (Read-only file system)" in said, said)
        before = evidence.seen(store)
        require(remount(disk, "rw"), "the disk stayed read-only")
        run_night(bench.inbox, out, "--store", store)
        evidence.require_nothing_redone(before, store)
        bench.require_products(out, store)
    return f"told, then refused at once; the next night ended well and kept {len(before)} artefacts"


def replaced_photograph(bench: Bench) -> str:
    """An upload replaces a photograph while its tile runs."""
    place = bench.copy("replaced")
    out, photograph = place / "out", place / "inbox" / FIRST / "light_3.tif"
    with started(place / "inbox", out) as night:
        wait_for(night, out / ".store", 3)
        shutil.copy(place / "inbox" / whole_name(2) / "light_3.tif", place / "new.tif")
        (place / "new.tif").replace(photograph)
        ended(night, 1)
    told = evidence.messages(out)
    require("were changed while it ran" in told and "light_3.tif" in told, told)
    require(not (out / FIRST / "r0c0").exists(), "products of a mixture were published")
    run_night(place / "inbox", out)
    run_night(place / "inbox", place / "fresh")
    expected = evidence.digest_of_products(place / "fresh")
    evidence.require_same(expected, evidence.digest_of_products(out), "products")
    changed = any(bench.products[name] != digest for name, digest in expected.items())
    require(changed, "the replaced photograph made no difference, so nothing was tested")
    return "told, nothing published; the next night made what the new photograph gives"


def two_nights(bench: Bench) -> str:
    """Two nights are started at once on one inbox."""
    out, log = bench.folder / "two" / "out", bench.folder / "two" / "watched"
    out.mkdir(parents=True)
    more = watched(log)
    with started(bench.inbox, out, more=more) as one, started(bench.inbox, out, more=more) as other:
        ended(one, 0)
        ended(other, 0)
    bench.require_products(out, out / ".store")
    made = [
        line
        for line in log.read_text(encoding="utf-8").splitlines()
        if line.startswith("published") and ".store" in line
    ]
    twice = len(made) - len(set(made))
    require(len(set(made)) == len(evidence.seen(out / ".store")), "the watch saw not every artefact")
    require(twice == 0, f"{twice} of {len(set(made))} stages were done twice")
    return f"both ended well; {twice} of {len(set(made))} stages were done twice"


def clock_set_back(bench: Bench) -> str:
    """The clock is set back by two hours while a tile runs, and stays so for the next night."""
    library = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"), None)
    if library is None:
        raise SkippedError("libfaketime is not installed (on Debian: apt install libfaketime)")
    place = bench.copy("clock")
    out, clock = place / "out", place / "clock"
    clock.write_text("+0\n")
    more = {
        "LD_PRELOAD": str(library),
        "FAKETIME_TIMESTAMP_FILE": str(clock),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_FORCE_MONOTONIC_FIX": "0",  # else threads wait two hours for each other, which no real clock does
        "NO_FAKE_STAT": "1",  # files keep their dates, which lie in the future then
    }
    until = f"{datetime.now() + timedelta(hours=1):%H:%M}"
    began = time.monotonic()
    with started(place / "inbox", out, "--until", until, more=more) as night:
        wait_for(night, out / ".store", 3)
        clock.write_text("-2h\n")
        ended(night, 0)
    took, record = time.monotonic() - began, evidence.record_of(out)
    bench.require_products(out, out / ".store")
    require(record["ended"] < record["started"], "the clock was not set back, so nothing was tested")
    require(
        0 < record["seconds"] <= took, f"the night says that it took {record['seconds']} s, not {took:.1f} s"
    )
    (place / "inbox" / whole_name(2) / "upload-complete").unlink()
    before = evidence.seen(out / ".store")
    run_night(place / "inbox", out, more=more)
    told = evidence.states(out)
    require(told == {FIRST: "unchanged", whole_name(2): "waiting"}, f"the next night says {told}")
    require("in the future" in evidence.messages(out), evidence.messages(out))
    evidence.require_nothing_redone(before, out / ".store")
    return (
        "the night ended well with true durations; uploads dated in the future wait, unless marked complete"
    )


def hostile_captures(bench: Bench) -> str:
    """A title that is a script; paths and links that leave the inbox; a manifest that calls programs."""
    place = bench.copy("hostile")
    inbox, out, trace = place / "inbox", place / "out", place / "was-run"
    _retell(inbox / FIRST, lambda manifest: manifest["artwork"].update(title=HOSTILE))
    outside = place / "elsewhere"
    shutil.copytree(inbox / FIRST, outside)
    for name in ("dots", "absolute", "link", "tag"):
        shutil.copytree(inbox / whole_name(2), inbox / name)
        _retell(inbox / name, lambda manifest, name=name: manifest["artwork"].update(id=name))  # type: ignore[misc]
    lamps = {str(i): f"light_{i}.tif" for i in range(1, 9)}
    _retell(inbox / "dots", lambda manifest: manifest.update(frames={**lamps, "3": "../../../etc/passwd"}))
    _retell(inbox / "absolute", lambda manifest: manifest.update(dark="/etc/passwd"))
    (inbox / "link" / "light_3.tif").unlink()
    (inbox / "link" / "light_3.tif").symlink_to(outside / "light_3.tif")
    (inbox / "folder-link").symlink_to(outside)
    tag = f'title: !!python/object/apply:os.system ["touch {trace}"]\n'
    (inbox / "tag" / "artwork.yaml").write_text(f"artwork:\n  id: tag\n  {tag}")
    run_night(inbox, out, codes=(1,))
    refused = {"dots", "absolute", "link", "folder-link", "tag"}
    told = {one["folder"]: one for one in evidence.record_of(out)["artworks"]}
    failed = {name for name, one in told.items() if one["state"] == "failed"}
    require(failed == refused, f"refused were {sorted(failed)}, and should be {sorted(refused)}")
    require(told[FIRST]["state"] == "done", "the artwork with the hostile title was not done")
    require(not trace.exists(), "the manifest's program was run")
    require(evidence.messages(out).count("is outside the capture root") == 3, evidence.messages(out))
    shown = _stays_text([out / "night.html", out / FIRST / "r0c0" / "report.html"])
    return f"5 of 5 refused, nothing was run; the title is text{shown}"


def no_pickles(bench: Bench) -> str:
    """A night with an audit hook that sees every class that is asked for by a pickle."""
    out, log = bench.folder / "pickles" / "out", bench.folder / "pickles" / "watched"
    out.mkdir(parents=True)
    run_night(bench.inbox, out, more=watched(log))
    require("published" in log.read_text(encoding="utf-8"), "the hook saw nothing")
    require_no_pickles(log)
    return "none was read, but what numba keeps of compiled code"


def _retell(folder: Path, change: Callable[[dict], object]) -> None:  # type: ignore[type-arg]
    path = folder / "artwork.yaml"
    manifest = yaml.safe_load(path.read_text(encoding="utf-8"))
    change(manifest)
    path.write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")


class _Scripts(HTMLParser):
    """The scripts of a page, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.scripts, self.text = 0, ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Count scripts, and what would run as one."""
        self.scripts += tag == "script" or any(name.startswith("on") for name, _ in attrs)

    def handle_data(self, data: str) -> None:
        """Collect text."""
        self.text += data


def _stays_text(pages: Sequence[Path]) -> str:
    """See that a hostile title is text on pages; says whether a browser agreed."""
    for page in pages:
        parsed = _Scripts()
        parsed.feed(page.read_text(encoding="utf-8"))
        require(parsed.scripts == 0, f"{page} has {parsed.scripts} scripts")
        require(HOSTILE in parsed.text, f"{page} does not show the title")
    if page_pictures.chromium() is None:
        return " (no browser here to confirm it)"
    with page_pictures.browser() as shown:
        for page in pages:
            shown.open(page.resolve().as_uri(), [HOSTILE], patience=20)
    return ", in a browser too"


CONDITIONS = (
    full_disk,
    read_only_store,
    replaced_photograph,
    two_nights,
    clock_set_back,
    hostile_captures,
    no_pickles,
)


def main(words: Sequence[str] | None = None) -> int:
    """Make the faults; returns the exit code."""
    options = _options(words)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    _in_own_mounts()
    failed = 0
    try:
        bench = Bench(options.folder.resolve())
        for condition in CONDITIONS:
            if options.names and condition.__name__ not in options.names:
                continue
            began = time.monotonic()
            try:
                result = condition(bench)
            except SkippedError as reason:
                result = f"skipped: {reason}"
            except (FaultError, page_pictures.PictureError) as fault:
                failed += 1
                result = f"failed: {fault}"
            print(f"{condition.__name__}: {result} ({time.monotonic() - began:.0f} s)", flush=True)
    except KeyboardInterrupt:
        print("stopped; nothing was left running", file=sys.stderr)
        return 130
    return 1 if failed else 0


def _in_own_mounts() -> None:
    """Go on where no other process sees what is mounted, so that nothing stays mounted, whatever happens."""
    unshare = shutil.which("unshare")
    if os.geteuid() == 0 and unshare and "NLIGHTS_OWN_MOUNTS" not in os.environ:
        os.environ["NLIGHTS_OWN_MOUNTS"] = "1"
        os.execv(unshare, [unshare, "--mount", sys.executable, *sys.argv])


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Faults about a night, one by one.")
    names = [condition.__name__ for condition in CONDITIONS]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"only these of {', '.join(names)}")
    default = Path(__file__).resolve().parents[1] / "build" / "faults" / "conditions"
    parser.add_argument("--folder", type=Path, default=default, metavar="DIR", help="for all data and logs")
    options = parser.parse_args(words)
    if unknown := set(options.names) - set(names):
        parser.error(f"there is no fault {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    return options


if __name__ == "__main__":
    sys.exit(main())
