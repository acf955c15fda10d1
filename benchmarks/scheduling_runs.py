"""The ways that `scheduling.py` times, each run in a process of its own; prints one line of JSON."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

from nlights_core.configurations import load_stand
from nlights_core.machine.sources import core_digest
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.store import RECORD, Store
from nlights_core.store.records import described_files, sealed
from nlights_flows.tiles.chain import digitise_tile
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

WIDTH = 48
MANIFEST = (
    "artwork: {{id: {name}, title: Scheduling}}\nstand: horizontal\n"
    'frames: "{{tile}}/light_{{n}}.tif"\nflats: "flat/light_{{n}}.tif"\ndark: dark.tif\ntiles:\n{tiles}'
)


def capture(folder: Path, name: str, tiles: list[str]) -> None:
    """A capture whose tiles have the same photographs, each in a folder of its own."""
    simulate(folder, load_stand("horizontal"), scene="painting", width=WIDTH, seed=1)
    for tile in tiles:
        (folder / tile).mkdir()
        for path in folder.glob("light_*.tif"):
            os.link(path, folder / tile / path.name)
    listed = "".join(f"  - {{name: {tile}, origin_mm: [{450 * n}, 0]}}\n" for n, tile in enumerate(tiles))
    (folder / "artwork.yaml").write_text(MANIFEST.format(name=name, tiles=listed), encoding="utf-8")


def prepare(folder: Path, *sizes: str) -> dict[str, Any]:
    """Captures of so many tiles, with everything about them in the store."""
    for size in map(int, sizes):
        place = folder / str(size)
        ready = place / "ready"
        if not ready.exists() or ready.read_text() != core_digest():
            shutil.rmtree(place, ignore_errors=True)
            capture(place / "capture", "inv-1", [f"t{n:04}" for n in range(size)])
            furnish(place)
            directly(place)  # publishes the products
            ready.write_text(core_digest())
    return {}


def furnish(place: Path) -> None:
    """Compute the first tile; the others get its files, under their own names."""
    recipe, store = load_recipe("default"), Store(place / "out" / ".store")
    store.prepare()
    first: list[Any] = []

    def make(stage: Any, tile: Any, *given: Any) -> Any:
        work = stage(store, tile, *given)
        store.ensure(work)
        first.append(work.ref)
        return work.ref

    tiles = load_capture(place / "capture")
    digitise_tile(tiles[0], recipe, make)
    for tile in tiles[1:]:
        models = iter(first)

        def take(stage: Any, tile: Any, *given: Any, models: Any = models) -> Any:
            return _alike(store, stage(store, tile, *given), next(models))

        digitise_tile(tile, recipe, take)


def _alike(store: Store, work: Any, model: Any) -> Any:
    """An artefact with another's files and a record of its own."""
    target = store.path(work.ref)
    if not store.has(work.ref):
        target.mkdir(parents=True)
        for path in store.path(model).iterdir():
            if path.name != RECORD:
                os.link(path, target / path.name)
        files = described_files(target.iterdir())
        (target / RECORD).write_text(sealed({**work.record, "files": files}), encoding="utf-8")
    return work.ref


def directly(folder: Path) -> dict[str, Any]:
    """Call every stage in this process."""
    started = time.monotonic()
    recipe, options = load_recipe("default"), RunOptions(out=folder / "out")
    outcomes = [
        run_directly(tile, recipe, options, lambda *told: None) for tile in load_capture(folder / "capture")
    ]
    return _judged(outcomes, time.monotonic() - started)


def dask(folder: Path, address: str) -> dict[str, Any]:
    """A Dask task per tile; once before, so that the workers have imported everything."""
    from nlights_flows.tiles.dask_runner import run_everywhere

    recipe, options = load_recipe("default"), RunOptions(out=folder / "out")
    tiles = load_capture(folder / "capture")
    run_everywhere(tiles[:4], recipe, replace(options, runner="dask", address=address))
    started = time.monotonic()
    outcomes = run_everywhere(
        load_capture(folder / "capture"), recipe, replace(options, runner="dask", address=address)
    )
    return _judged(outcomes, time.monotonic() - started)


def prefect(folder: Path, address: str | None = None) -> dict[str, Any]:
    """The flow `digitise`: whole, with one tile, and an empty flow; without the import."""
    started = time.monotonic()
    from prefect import flow
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

    from nlights_flows.tiles.digitise import digitise

    imported = time.monotonic() - started

    @flow(persist_result=False)
    def empty() -> None:
        pass

    empty()
    usual = _middle(lambda: empty())
    place = {"artwork": str(folder / "capture" / "artwork.yaml"), "out": str(folder / "out")}
    where = {"runner": "dask" if address else "here", "address": address}
    recipe, options = load_recipe("default"), RunOptions(out=folder / "out")
    tiles = load_capture(folder / "capture")

    def one_directly() -> None:
        load_capture(folder / "capture")
        run_directly(tiles[0], recipe, options, lambda *told: None)

    # The thread that tells that a flow lives waits for a whole second at its end, and hides what takes less.
    with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        spent = _middle(lambda: empty())
        one = _middle(lambda: digitise(**place, **where, tiles=[tiles[0].name]))
        spared = _middle(one_directly)
        started = time.monotonic()
        outcomes = digitise(**place, **where)
        found = _judged(outcomes, time.monotonic() - started)
    return {
        **found,
        "import": imported,
        "usual_empty": usual,
        "empty": spent,
        "one": one,
        "one_directly": spared,
    }


def _middle(run: Any, times: int = 3) -> float:
    """Seconds of the middle one of some runs."""
    found = []
    for _ in range(times):
        started = time.monotonic()
        run()
        found.append(time.monotonic() - started)
    return sorted(found)[times // 2]


def _judged(outcomes: Any, seconds: float) -> dict[str, Any]:
    states = {outcome.state for outcome in outcomes}
    if states != {"unchanged"}:
        messages = [outcome.message for outcome in outcomes if outcome.message]
        raise SystemExit(f"not everything was in the store: {states} {messages[:3]}")
    return {"seconds": seconds}


def inbox(folder: Path) -> dict[str, Any]:
    """An inbox of two artworks of three tiles."""
    for name in ("inv-1", "inv-2"):
        place = folder / "inbox" / name
        if not place.exists():
            capture(place, name, ["a", "b", "c"])
            (place / "upload-complete").touch()
    return {}


def night(inbox: Path, out: Path, log: Path, claims: str) -> dict[str, Any]:
    """A night that writes down every artefact that it made, with or without claims."""
    from nlights_flows.nights import claims as marks
    from nlights_flows.nights.order import Order
    from nlights_flows.nights.record import night_exit_code
    from nlights_flows.nights.running import run_here, run_night

    ensure = Store.ensure

    def told(self: Store, work: Any, *given: Any) -> bool:
        found = ensure(self, work, *given)
        if not found:
            with log.open("a", encoding="utf-8") as file:
                file.write(work.ref.folder + "\n")
        return found

    Store.ensure = told  # type: ignore[method-assign]
    if claims == "none":
        marks.Claims.take = lambda *given: True  # type: ignore[method-assign]
        marks.Claims.taken = lambda *given: False  # type: ignore[method-assign]
    code = night_exit_code(run_night(Order(inbox, RunOptions(out=out), settle=0), run_here))
    if code:
        raise SystemExit(code)
    return {}


def answers(url: str) -> bool:
    """Whether a server is there."""
    try:
        with urllib.request.urlopen(url, timeout=2):
            return True
    except OSError:
        return False


def task_runs(api: str) -> int:
    """How many task runs a server knows."""
    request = urllib.request.Request(
        f"{api}/task_runs/count", b"{}", {"Content-Type": "application/json"}, method="POST"
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return int(json.load(answer))


def settled(api: str, patience: float = 120.0) -> tuple[int, float]:
    """How many task runs a server knows when no more come in, and how long after now that was."""
    started = last = time.monotonic()
    count = task_runs(api)
    while time.monotonic() - last < 4 and time.monotonic() - started < patience:
        time.sleep(0.25)
        now = task_runs(api)
        if now != count:
            count, last = now, time.monotonic()
    return count, last - started


def database_size(given: dict[str, str]) -> int:
    """Bytes of a server's database."""
    url = given.get("PREFECT_SERVER_DATABASE_CONNECTION_URL")
    if url is None:
        path = Path(given["PREFECT_HOME"]) / "prefect.db"
        with sqlite3.connect(path, timeout=60) as database:
            database.execute("PRAGMA wal_checkpoint(PASSIVE)")
            pages, size = (
                database.execute(f"PRAGMA page_{what}").fetchone()[0] for what in ("count", "size")
            )
        database.close()
        return int(pages * size)
    import asyncio

    import asyncpg

    async def ask() -> int:
        connection = await asyncpg.connect(url.replace("+asyncpg", ""))
        try:
            return int(await connection.fetchval("SELECT pg_database_size(current_database())"))
        finally:
            await connection.close()

    return asyncio.run(ask())


WAYS = {
    "prepare": prepare,
    "directly": directly,
    "dask": dask,
    "prefect": prefect,
    "inbox": inbox,
    "night": night,
}

if __name__ == "__main__":
    way, *words = sys.argv[1:]
    paths = [Path(word) if "/" in word and "://" not in word else word for word in words]
    print(json.dumps(WAYS[way](*paths)))
