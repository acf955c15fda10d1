"""Tiles on other machines: a Dask task per tile, which runs the tile's chain on the shared store.

What travels is JSON: the tile, the recipe's text and paths there, the outcome back.  Dask itself is
an optional part (``nlights[dask]``) and is imported only when it is asked for.
"""

from __future__ import annotations

import json
import os
import re
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError, NlightsError, TileError
from nlights_core.machine.band_threads import cores
from nlights_core.machine.sources import core_digest
from nlights_core.memory import VARIABLE, allowed, budget
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.registry import code_digest
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Around, Outcome, run_directly

if TYPE_CHECKING:
    from distributed import Client

ADDRESS = re.compile(r"([a-z+]+://)?[^\s/]+:\d+")

PATIENCE = 10.0
"""Seconds in which a scheduler must answer and have a worker."""

CORES_PER_WORKER = 2
"""Of the workers that are started on this machine; a full-size tile keeps two cores busy."""

SEEN = 5
"""How often, a second apart, a worker looks for the mark: a network file system may show it late."""

_one_tile = threading.Lock()
"""A tile takes all the cores and the memory of a process: a second one waits, whatever --nthreads says."""


@contextmanager
def reachable(options: RunOptions) -> Iterator[str | None]:
    """Address of a scheduler that has workers, for as long as the block lasts; None with the runner "here".

    Parameters
    ----------
    options : RunOptions
        Without an address, scheduler and workers are started on this machine.

    Raises
    ------
    NlightsError
        When Dask is not installed, or nothing answers, or there is no worker.
    """
    if options.runner == "here":
        yield None
    elif options.address:
        with _client(options.address):
            pass
        yield options.address
    else:
        with _workers_here() as started:
            yield started


@contextmanager
def _workers_here() -> Iterator[str]:
    """A scheduler and workers of this machine's own, who share its cores and its memory."""
    _require_dask()
    from distributed import LocalCluster

    mine = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(cores()))
    count = max(1, len(mine) // CORES_PER_WORKER)
    cluster = LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        memory_limit=0,  # pages of mapped photographs would count; nLights keeps its own budget
        dashboard_address=None,
        host="127.0.0.1",
        env={VARIABLE: str(budget() // count)},
    )
    with cluster, _client(cluster.scheduler_address) as client:
        if count > 1 and hasattr(os, "sched_setaffinity"):
            for index, worker in enumerate(client.scheduler_info(n_workers=-1)["workers"]):
                client.run(os.sched_setaffinity, 0, mine[index::count], workers=[worker])
        yield cluster.scheduler_address


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError as fault:
        raise CaptureError(
            f"--runner dask: Dask is not installed ({fault}); pip install -c constraints.txt 'nlights[dask]', on "
            "every machine, or leave --runner out"
        ) from fault


@contextmanager
def _client(address: str) -> Iterator[Client]:
    """A connection to a scheduler that has at least one worker."""
    _require_dask()
    from distributed import Client

    if not ADDRESS.fullmatch(address):
        raise CaptureError(
            f"--address: '{address}' is no address of a Dask scheduler; write tcp://10.0.0.5:8786"
        )
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as fault:
        raise CaptureError(
            f"--address: no Dask scheduler answers at '{address}' ({_first_line(fault)}); start one with `dask "
            "scheduler` and write the address that it prints, as tcp://10.0.0.5:8786"
        ) from fault
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as fault:
            raise CaptureError(
                f"--address: the Dask scheduler at {address} has no workers; start some with `dask worker {address} "
                "--nthreads 1 --memory-limit 0`"
            ) from fault
        yield client


def workers(address: str) -> int:
    """Number of workers that a scheduler has now."""
    with _client(address) as client:
        return _count(client)


def _count(client: Client) -> int:
    return len(client.scheduler_info(n_workers=-1)["workers"])


def run_tiles(
    tiles: Iterable[Tile],
    recipe: Recipe,
    options: RunOptions,
    around: Around,
    task: Any = None,
) -> list[Outcome | None]:
    """Run tiles on the workers of a scheduler, as many at once as there are workers.

    Parameters
    ----------
    tiles, recipe, options
        As for `nlights_flows.tiles.running.run_directly`; store and products are in folders that every worker
        sees under the same path, and there is an address.
    around : callable
        Told each tile right before it is sent; called from several threads.
    task : prefect.Task, optional
        `run_job` as a Prefect task: then each tile is a task run of the flow that calls this.

    Returns
    -------
    list of Outcome or None
        In the order of the tiles; None for those that ``around`` declined.
    """
    assert options.address is not None
    store, out = options.artefacts.root, options.out
    with _client(options.address) as client, _mark(store) as one, _mark(out) as other:
        at_once = _count(client)
        places = _places(options.address, at_once)
        common = {
            "recipe": {"name": recipe.name, "text": json.dumps(recipe.record())},
            "code": _code(recipe),
            "options": replace(options, store=store.resolve(), out=out.resolve()).plain(),
            "marks": [str(one.resolve()), str(other.resolve())],
        }

        with _sender(client, options.address, task) as send, ThreadPoolExecutor(at_once) as threads:

            def run(tile: Tile) -> Outcome | None:
                job = {"tile": tile.model_dump(mode="json"), **common}
                with places:  # so that `around` decides when there is a worker for it
                    return around(tile, partial(_sent, tile, job, send))

            # A context for each: Prefect finds its flow run there.
            told = [threads.submit(copy_context().run, run, tile) for tile in tiles]
            return [one.result() for one in told]


def run_everywhere(tiles: Iterable[Tile], recipe: Recipe, options: RunOptions) -> list[Outcome]:
    """Run all tiles, without Prefect; see `reachable` and `run_tiles`."""
    with reachable(replace(options, runner="dask")) as scheduler:
        told = run_tiles(tiles, recipe, replace(options, address=scheduler), lambda tile, run: run())
    return [outcome for outcome in told if outcome is not None]


@lru_cache(maxsize=8)
def _places(address: str, count: int) -> threading.Semaphore:
    """Semaphore with a place per worker of a scheduler, shared by all artworks that this process runs at once."""
    return threading.Semaphore(count)


Send = Callable[[dict[str, Any]], dict[str, Any]]
"""Send a job to a worker and wait for what it answers."""


@contextmanager
def _sender(client: Client, address: str, task: Any) -> Iterator[Send]:
    """Sender of jobs: to Dask directly, or as a Prefect task through Dask."""
    if task is None:
        yield lambda job: client.submit(run_job, job, key=_name(job), pure=False).result()
        return
    from prefect_dask import DaskTaskRunner

    with DaskTaskRunner(address=address) as runner:

        def send(job: dict[str, Any]) -> dict[str, Any]:
            named = task.with_options(task_run_name=job["tile"]["name"])
            state = runner.submit(named, {"job": job}).wrapped_future.result()
            answer = state.result(raise_on_failure=False)
            if isinstance(answer, BaseException):
                raise answer
            return answer  # type: ignore[no-any-return]

        yield send


def _name(job: dict[str, Any]) -> str:
    """Name of a tile on Dask's own pages; never twice the same, since nothing is to be taken from its memory."""
    return f"{job['tile']['artwork']}/{job['tile']['name']}-{uuid.uuid4().hex[:8]}"


def _sent(tile: Tile, job: dict[str, Any], send: Send) -> Outcome:
    """Send a tile; what befalls its task is the tile's own fault."""
    started = time.monotonic()
    try:
        answer = send(job)
    except Exception as fault:
        message = (
            f"its Dask task was lost ({type(fault).__name__}: {_first_line(fault)}): a worker that ends again and "
            "again at one tile most often lacks memory; see its log, and run again: what is finished is kept"
        )
        return Outcome(tile.artwork, tile.name, "failed", None, message, time.monotonic() - started)
    folder = Path(answer["folder"]) if answer["folder"] else None
    notes = tuple(answer["notes"])
    return Outcome(
        tile.artwork, tile.name, answer["state"], folder, answer["message"], answer["seconds"], notes
    )


def run_job(job: dict[str, Any]) -> dict[str, Any]:
    """Run a tile; this is what a Dask worker calls.

    Parameters
    ----------
    job : dict
        JSON, as `run_tiles` makes it.

    Returns
    -------
    dict
        "state", "folder", "message", "seconds" and "notes" of the `Outcome`, as JSON.
    """
    with _one_tile:
        tile = Tile.model_validate(job["tile"])
        try:
            _require_shared(job["marks"])
            options = RunOptions.of(job["options"])
            recipe = _recipe(job["recipe"]["name"], job["recipe"]["text"])
            _require_same_code(job["code"], recipe)
        except NlightsError as fault:
            return {"state": "failed", "folder": None, "message": str(fault), "seconds": 0.0, "notes": []}
        with allowed(_memory(options)):
            outcome = run_directly(tile, recipe, options, lambda tile, stage, share: None)
    folder = str(outcome.folder) if outcome.folder else None
    return {
        "state": outcome.state,
        "folder": folder,
        "message": outcome.message,
        "seconds": outcome.seconds,
        "notes": list(outcome.notes),
    }


def _memory(options: RunOptions) -> int | None:
    """Memory that a worker's tile may take: what was asked for, but no more than the worker itself was allowed."""
    asked = options.memory_bytes()
    return min(asked, budget()) if asked and os.environ.get(VARIABLE) else asked


@lru_cache(maxsize=8)
def _recipe(name: str, text: str) -> Recipe:
    """A recipe from its text, by the one reader that there is."""
    return load_recipe({**json.loads(text), "name": name})


def _code(recipe: Recipe) -> list[str]:
    """Digests of all that must be the same on all machines, lest they make artefacts of other names."""
    return [core_digest(), *(code_digest(type(algorithm)) for algorithm in recipe.algorithms())]


def _require_same_code(expected: Sequence[str], recipe: Recipe) -> None:
    found = _code(recipe)
    if found != list(expected):
        raise TileError(
            f"the Dask worker on {socket.gethostname()} has another nLights ({found[0]}) than the machine that "
            f"asks ({expected[0]}), or another version of a plugin; install the same on all machines, and restart "
            "the workers"
        )


@contextmanager
def _mark(folder: Path) -> Iterator[Path]:
    """A file by which a worker knows that it sees the same folder."""
    mark = folder / f".mark-{uuid.uuid4().hex}"
    mark.touch()
    try:
        yield mark
    finally:
        mark.unlink(missing_ok=True)


def _require_shared(marks: Sequence[str]) -> None:
    """Refuse to compute into a folder of this machine's own, where nobody would look."""
    for mark in map(Path, marks):
        for _ in range(SEEN):
            if mark.exists():
                break
            time.sleep(1)
        else:
            raise TileError(
                f"{mark.parent}: on the Dask worker's machine {socket.gethostname()} this is not the folder that it "
                "is on the machine that asks; mount the same file system at the same place on both"
            )


def _first_line(fault: BaseException) -> str:
    return (str(fault).splitlines() or [type(fault).__name__])[0]
