"""A night: every artwork of an inbox, one after the other; a fault is told and passed by."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import asdict, replace
from datetime import datetime
from functools import partial

from nlights_core.capture import Tile
from nlights_core.errors import NlightsError
from nlights_core.names.artworks import require_own_folder
from nlights_core.names.control_characters import escape_controls
from nlights_core.products.publishing import publish
from nlights_core.store import sweep_below
from nlights_flows.nights.checking import in_store, require_usable
from nlights_flows.nights.claims import Claims
from nlights_flows.nights.earlier import TIMED, earlier_nights
from nlights_flows.nights.estimates import learn_estimate, require_disk
from nlights_flows.nights.inbox import Candidate, Inbox, require_inbox, scan
from nlights_flows.nights.leftovers import clear_leftovers
from nlights_flows.nights.notifying import Hook, notify
from nlights_flows.nights.numbers import look_at_products
from nlights_flows.nights.order import Batch, Checked, Order, RunArtwork, check_order
from nlights_flows.nights.page import write_pages
from nlights_flows.nights.record import (
    NOT_REACHED,
    ArtworkEntry,
    NightRecord,
    TileEntry,
    new_night,
    take_in_decisions,
    write_record,
)
from nlights_flows.nights.trends import captures_of, trends
from nlights_flows.tiles import console, dask_runner
from nlights_flows.tiles.explaining import explain_fault
from nlights_flows.tiles.preparing import make_folders
from nlights_flows.tiles.running import Around, Outcome, run_directly

LOOK = 2.0
"""Seconds between two looks at tiles that another night is at."""

SHARE = 0.05
"""Of a night's time, that its record and page may take beyond `QUICK`, the last ones apart."""

QUICK = 1.0
"""Seconds."""

PATIENCE = 6 * 3600.0
"""Seconds for which a night without an end waits for another at most."""


def run_night(order: Order, run_artwork: RunArtwork, at_once: int = 1) -> NightRecord:
    """Carry out a night.

    Parameters
    ----------
    order : Order
        What is asked for.
    run_artwork : callable
        How to run an artwork's tiles.
    at_once : int
        How many artworks are run at the same time.

    Returns
    -------
    NightRecord
        As it stands in ``night.json``.

    Raises
    ------
    NlightsError
        When order, recipe, limits or inbox are at fault; nothing was run then.
    """
    night = check_order(order)
    require_inbox(order.inbox)
    with night.options.in_force():
        make_folders(night.options)
        for root in (night.store.root, night.options.out):
            sweep_below(root)  # what killed runs left where nobody has been since
        clear_leftovers(order.options.out, night.store.root)
        with Claims(night.store.root) as claims:
            return Night(night, run_artwork, claims, at_once).run()


@contextmanager
def elsewhere(order: Order) -> Iterator[tuple[Order, int]]:
    """The order with the address of the scheduler that does it, and how many artworks keep its workers busy."""
    with order.options.in_force(), dask_runner.reachable(order.options) as address:
        there = replace(order, options=replace(order.options, address=address))
        yield there, dask_runner.workers(address) if address else 1


def run_on_dask(batch: Batch, around: Around) -> None:
    """Run an artwork's tiles on the workers of a Dask scheduler, without Prefect."""
    night = batch.night
    console.complain(f"{batch.artwork}: {len(batch.tiles)} of its tiles to run on {night.options.address}")
    dask_runner.run_tiles(batch.tiles, night.recipe, night.options, around)


def run_here(batch: Batch, around: Around) -> None:
    """Run an artwork's tiles in this process, one after the other, with progress on the console."""
    night = batch.night
    console.complain(f"{batch.artwork}: {len(batch.tiles)} of its tiles to run")
    with console.TileProgress(night.recipe, batch.tiles) as watch:
        for tile in batch.tiles:
            run = partial(run_directly, tile, night.recipe, night.options, watch)
            outcome = around(tile, run)
            watch.tile_done(outcome or Outcome(tile.artwork, tile.name, "unchanged"))


class Night:
    """One night, while it runs.

    Parameters
    ----------
    night : Checked
    run_artwork : callable
    claims : Claims
        Begun.
    at_once : int
        How many artworks are run at the same time.
    """

    def __init__(self, night: Checked, run_artwork: RunArtwork, claims: Claims, at_once: int = 1) -> None:
        self.night, self.run_artwork, self.claims, self.at_once = night, run_artwork, claims, at_once
        order, started = night.order, datetime.now().astimezone()
        self.folder = new_night(order.options.out, started)
        self._began, self._writing = time.monotonic(), 0.0
        self._earlier = earlier_nights(order.options.out, night.recipe.name, but=self.folder.name)
        self._timed = self._earlier.timed
        self._estimate = learn_estimate(self._timed)
        self._tiles: dict[tuple[str, str], TileEntry] = {}
        self._running: list[tuple[Candidate, ArtworkEntry]] = []
        self._lock = threading.RLock()
        self.record = NightRecord(
            date=started.date().isoformat(),
            name=self.folder.name,
            inbox=str(order.inbox.resolve()),
            out=str(order.options.out.resolve()),
            store=str(night.store.root.resolve()),
            recipe=night.recipe.name,
            started=started.isoformat(timespec="seconds"),
            until=night.deadline.at.isoformat(timespec="minutes") if night.deadline.at else None,
            limits=[limit.model_dump() for limit in night.limits.limits],
        )

    def run(self) -> NightRecord:
        """Take what is ready, then what has become ready meanwhile, then what others were at."""
        order, store = self.night.order, self.night.store
        while True:
            found = scan(order.inbox, order.settle, (order.options.out, store.root))
            seen = {candidate.folder for candidate, _ in self._running}
            new = [candidate for candidate in found.ready if candidate.folder not in seen]
            entries = [(candidate, self._enter(candidate)) for candidate in new]
            self._running += entries
            self._tell_passed_by(found)
            self._write()
            if not new:
                break
            self._run_all(entries)
        self._wait_for_others()
        self.record.ended = datetime.now().astimezone().isoformat(timespec="seconds")
        self._write(last=True)
        if self.night.hook:  # after the page, which whoever is told opens
            self._tell(self.night.hook)
            self._write(last=True)
        return self.record

    def _tell(self, hook: Hook) -> None:
        """Tell somebody of the night; that it failed is said, and changes nothing else."""
        self.record.notified = told = notify(self.record, hook)
        if not told["told"]:
            console.complain(told["message"])
            self.record.notes.append(told["message"])

    def _run_all(self, entries: list[tuple[Candidate, ArtworkEntry]]) -> None:
        """Run artworks in their order, ``at_once`` of them at the same time."""
        if self.at_once == 1:
            for candidate, entry in entries:
                self._run(candidate, entry)
            return
        with ThreadPoolExecutor(self.at_once) as threads:
            # A context for each: Prefect finds its flow run there.
            begun = [threads.submit(copy_context().run, partial(self._run, *one)) for one in entries]
            for one in begun:
                one.result()

    def _enter(self, candidate: Candidate) -> ArtworkEntry:
        """Take an artwork into the record: what is done already, what cannot be done, what is to be run."""
        entry = ArtworkEntry(
            candidate.artwork,
            candidate.title,
            escape_controls(candidate.folder.relative_to(self.night.order.inbox.resolve()).as_posix()),
            priority=candidate.priority,
            uploaded=datetime.fromtimestamp(candidate.uploaded).astimezone().isoformat(timespec="minutes"),
            tiles=[TileEntry(tile.name) for tile in candidate.tiles],
        )
        for tile, one in zip(candidate.tiles, entry.tiles, strict=True):
            self._tiles[tile.artwork, tile.name] = one
            try:
                require_own_folder(tile.artwork, self.night.order.options.out)
                if self._already_done(tile):
                    continue
                one.megapixels = require_usable(tile, self.night.recipe) / 1e6
            except Exception as fault:  # nothing that somebody uploads may end a night
                said = explain_fault(fault, self.night.store)
                self._take_down(Outcome(tile.artwork, tile.name, "failed", None, said))
        entry.settle()
        return entry

    def _tell_passed_by(self, found: Inbox) -> None:
        root = self.night.order.inbox.resolve()
        self.record.artworks = [entry for _, entry in self._running] + [
            ArtworkEntry(
                one.artwork,
                "",
                escape_controls(one.folder.relative_to(root).as_posix()),
                "failed" if one.failed else "waiting",
                escape_controls(one.message),
            )
            for one in found.passed_by
        ]

    def _already_done(self, tile: Tile) -> bool:
        """Publish a tile of which the store has everything, without running anything."""
        order, store = self.night.order, self.night.store
        try:
            refs = in_store(tile, self.night.recipe, store, order.options.compression)
            if refs is None:
                return False
            started = time.monotonic()
            published = publish(store, tile, refs, order.options.out, copied=order.options.copies)
        except Exception:  # artefacts are gone or damaged: running the tile makes them again, or says why not
            return False
        took = time.monotonic() - started
        self._take_down(
            Outcome(tile.artwork, tile.name, "unchanged", published.folder, "", took, published.notes)
        )
        return True

    def _run(self, candidate: Candidate, entry: ArtworkEntry) -> None:
        """Run what is to be run of an artwork now; whatever happens, the next artwork has its turn."""
        open_tiles = []
        for tile in candidate.tiles:
            one = self._tiles[tile.artwork, tile.name]
            if one.state == "claimed elsewhere" and not self._busy(tile) and self._already_done(tile):
                continue
            if one.state in ("left", "claimed elsewhere") and self._in_time(one) and not self._busy(tile):
                open_tiles.append(tile)
        if open_tiles:
            batch = Batch(candidate.artwork, candidate.folder / "artwork.yaml", open_tiles, self.night)
            try:
                self.run_artwork(batch, self.around)
            except (Exception, SystemExit) as fault:
                self._give_up(open_tiles, explain_fault(fault, self.night.store))
            self._give_up(open_tiles, "was never begun, and nobody said why; see the log of the run")
        entry.settle()
        self._write()

    def around(self, tile: Tile, run: Callable[[], Outcome]) -> Outcome | None:
        """Run a tile if there is time and room and nobody else is at it; take down what became of it."""
        one = self._tiles[tile.artwork, tile.name]
        if not self._in_time(one):
            return None
        try:
            pixels = round(1e6 * (one.megapixels or 0))
            require_disk(
                pixels, self.night.store.root, self.night.order.options.out, f"{tile.artwork}/{tile.name}"
            )
        except NlightsError as fault:
            return self._take_down(Outcome(tile.artwork, tile.name, "failed", None, str(fault)))
        if not self.claims.take(tile.artwork, tile.name):
            self._busy(tile)
            return None
        try:
            return self._take_down(run())
        finally:
            self.claims.give_back(tile.artwork, tile.name)

    def _in_time(self, one: TileEntry) -> bool:
        """Test whether a tile would end in time; say so in its entry where not."""
        needed, left = self._estimate.seconds(one.megapixels or 0), self.night.deadline.left
        if needed <= left:
            return True
        one.state = "left"
        remain = f"{_minutes(left)} remained" if left > 0 else "no time remained"
        until = f"{self.night.deadline.at:%H:%M}"
        one.message = (
            f"would take about {_minutes(needed)}, and {remain} until {until}; the next night takes it up"
        )
        return False

    def _busy(self, tile: Tile) -> bool:
        """Test whether another night is at a tile; say so in its entry."""
        if not self.claims.taken(tile.artwork, tile.name):
            return False
        one = self._tiles[tile.artwork, tile.name]
        one.state = "claimed elsewhere"
        one.message = f"{self.claims.holder(tile.artwork, tile.name)} is at it"
        return True

    def _take_down(self, outcome: Outcome) -> Outcome:
        """Enter what became of a tile."""
        with self._lock:
            one = self._tiles[outcome.artwork, outcome.tile]
            one.state, one.message = outcome.state, escape_controls(outcome.message)
            one.notes = [escape_controls(note) for note in outcome.notes]
            one.seconds = round(outcome.seconds, 2)
            if outcome.folder is not None:
                one.products = outcome.folder.relative_to(self.night.order.options.out).as_posix()
                look_at_products(one, outcome.folder, self.night.limits)
            if outcome.state == "done" and one.megapixels:
                self._timed = [(one.megapixels, outcome.seconds), *self._timed][:TIMED]
                self._estimate = learn_estimate(self._timed)
        return outcome

    def _give_up(self, tiles: list[Tile], message: str) -> None:
        for tile in tiles:
            one = self._tiles[tile.artwork, tile.name]
            if one.state == "left" and one.message == NOT_REACHED:
                one.state, one.message = "failed", message

    def _wait_for_others(self) -> None:
        """Look again at what other nights were at, until they are done or the time is over."""
        patience = time.monotonic() + PATIENCE
        while waiting := [
            (candidate, entry)
            for candidate, entry in self._running
            if any(one.state == "claimed elsewhere" for one in entry.tiles)
        ]:
            for candidate, entry in waiting:
                mine = [
                    t for t in candidate.tiles if self._tiles[t.artwork, t.name].state == "claimed elsewhere"
                ]
                if not all(self._busy(tile) for tile in mine):
                    self._run(candidate, entry)
            left = min(self.night.deadline.left, patience - time.monotonic())
            if left <= 0:
                return
            time.sleep(min(LOOK, left))

    def _write(self, last: bool = False) -> None:
        """Write record and page as of now; a page that cannot be drawn must not stop the work.

        Both grow with the night: they are left for later while they would take more than their share
        of the time, but the last ones are always written.
        """
        with self._lock:
            began = time.monotonic()
            if not last and self._writing > QUICK + SHARE * (began - self._began):
                return
            record, out = self.record, self.night.order.options.out
            if record.notified is None:  # that a hook keeps us waiting is not the night's work
                record.seconds = round(time.monotonic() - self._began, 1)
            record.estimate = asdict(self._estimate)
            take_in_decisions(record, out)
            record.trends = trends((*captures_of(record.as_json()), *self._earlier.captures))
            try:
                write_record(record, self.folder, out)
                write_pages(record, self.folder, out)
            except Exception as fault:
                said = f"the page could not be written: {explain_fault(fault, self.night.store)}"
                console.complain(said)
                if said not in record.notes:
                    record.notes.append(said)
            self._writing += time.monotonic() - began


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} minutes"
