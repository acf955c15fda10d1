"""The Prefect flow `digitise`: an artwork's tiles, one task per tile and stage."""

# No `from __future__ import annotations` here: Prefect resolves the parameters' types itself.
import errno
import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from prefect import flow, get_run_logger, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.exceptions import MissingContextError
from prefect.states import Completed, Failed

from nlights_core import stages
from nlights_core.capture import Tile
from nlights_core.manifest import load_capture
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.store import ArtefactRef, Store
from nlights_flows.tiles import dask_runner, isolation
from nlights_flows.tiles.environment import outlive_reader
from nlights_flows.tiles.preparing import make_folders, require_named
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Around, Ensure, Outcome, attempt, exit_code
from nlights_flows.tiles.streams import faults_escaped

LASTING = {errno.ENOSPC, errno.EDQUOT, errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS}
"""Faults of the operating system that stay until somebody acts."""

_around: ContextVar[Around] = ContextVar("around", default=lambda tile, run: run())


@contextmanager
def each_tile_through(around: Around) -> Iterator[None]:
    """Let a night decide, tile by tile, whether the flow inside this block runs it.

    A parameter of a flow must be plain JSON, and this is a function.
    """
    token = _around.set(around)
    try:
        yield
    finally:
        _around.reset(token)


def _may_pass(task: Any, task_run: TaskRun, state: State[Any]) -> bool:
    """Retry only what a retry can mend: a hiccup of the file system."""
    fault = state.data if isinstance(state.data, BaseException) else None
    if fault is None:
        try:
            state.result()
        except BaseException as raised:
            fault = raised
    return isinstance(fault, OSError) and fault.errno not in LASTING


@task(
    persist_result=False,
    cache_policy=NO_CACHE,
    retries=2,
    retry_delay_seconds=[5, 30],
    retry_condition_fn=_may_pass,
)
def run_stage(name: str, store_root: str, tile: Tile, *arguments: Any, timeout: float | None = None) -> Any:
    """Run one stage of one tile; only references come in and go out.

    ``timeout`` and child processes: see `nlights_flows.tiles.isolation`.

    Returns
    -------
    ArtefactRef
        In a state named "Cached" when the store had it.
    """
    store = Store(Path(store_root))
    work = getattr(stages, name)(store, tile, *arguments)
    with faults_escaped():
        there = isolation.ensure(store, work, tile, arguments, timeout=timeout)
    return Completed(name="Cached", data=work.ref) if there else work.ref


@task(name="tile", persist_result=False, cache_policy=NO_CACHE)
def run_tile_elsewhere(job: dict[str, Any]) -> Any:
    """Run a whole tile in a Dask worker; only JSON comes in and goes out.

    Returns
    -------
    dict
        What `nlights_flows.tiles.dask_runner.run_job` answers, in a state that says the same.
    """
    answer = dask_runner.run_job(job)
    if answer["state"] == "failed":
        return Failed(message=answer["message"], data=answer)
    return Completed(name="Cached" if answer["state"] == "unchanged" else None, data=answer)


@flow(name="digitise", persist_result=False, validate_parameters=True)
def digitise(
    artwork: str,
    recipe: str = "default",
    out: str = "products",
    store: str | None = None,
    stand: str | None = None,
    root: str | None = None,
    tiles: list[str] | None = None,
    compression: str = "none",
    copies: bool = False,
    memory: str | None = None,
    timeout: float | None = None,
    runner: str = "here",
    address: str | None = None,
) -> Any:
    """Digitise the tiles of an artwork.

    Parameters
    ----------
    artwork : str
        Path of the ``artwork.yaml``.
    recipe : str
        Name of a shipped recipe, or a path.
    out : str
        Folder of the products.
    store : str, optional
        Folder of the artefacts; ``<out>/.store`` by default.
    stand : str, optional
        Name or path of a stand, instead of the manifest's.
    root : str, optional
        Capture root; the manifest's folder by default.
    tiles : list of str, optional
        Only these tiles.
    compression : str
        Of the TIFFs among the products, "none" or "zstd".
    copies : bool
        Copy the products out of the store, instead of sharing their place on the disk.
    memory : str, optional
        Memory that a tile may take, as 6GiB.
    timeout : float, optional
        Seconds that a stage may take; then it is stopped, and its tile has failed.
    runner : {"here", "dask"}
        Where tiles run: here, a task per stage; or on Dask's workers, a task per tile.
    address : str, optional
        Of the Dask scheduler, as ``tcp://10.0.0.5:8786``; without one, workers are started on this machine.

    Returns
    -------
    State
        Completed, or Failed when a tile failed; both carry the list of outcomes as their data.
    """
    options = RunOptions.of(locals())
    with faults_escaped():
        return _digitise(Path(artwork), options)


def _digitise(artwork: Path, options: RunOptions) -> State[Any]:
    """Run the tiles of an artwork as tasks, here or on Dask's workers."""
    outlive_reader()
    recipe = load_recipe(options.recipe)
    found = load_capture(artwork, stand=options.stand, root=options.root)
    require_named(found, options.tiles, str(artwork))
    with options.in_force(), dask_runner.reachable(options) as scheduler:
        make_folders(options)
        wanted = [tile for tile in found if not options.tiles or tile.name in options.tiles]
        if scheduler:
            there = replace(options, address=scheduler)
            return _ended(dask_runner.run_tiles(wanted, recipe, there, _told_around(), run_tile_elsewhere))
        return _ended(_run_tiles_as_tasks(wanted, recipe, options, _told_around()))


def _run_tiles_as_tasks(
    tiles: Iterable[Tile], recipe: Recipe, options: RunOptions, around: Around
) -> Iterator[Outcome | None]:
    """Run tiles one after the other, each stage as a task; None for what ``around`` declined."""
    for tile in tiles:
        ensure = ensure_as_task(options, tile.name)
        yield around(tile, partial(attempt, tile, recipe, options, ensure))


def ensure_as_task(options: RunOptions, place: str) -> Ensure:
    """Make a function that runs stages as tasks; ``place`` begins the names of their runs."""
    store = str(options.artefacts.root)

    def ensure(stage: Callable[..., Any], tile: Tile, *arguments: Any) -> tuple[ArtefactRef, bool]:
        named = run_stage.with_options(name=stage.__name__, task_run_name=f"{place} {stage.__name__}")
        state = named(stage.__name__, store, tile, *arguments, timeout=options.timeout, return_state=True)
        return state.result(), state.name == "Cached"

    return ensure


def _ended(told: Iterable[Outcome | None]) -> State[Any]:
    """Return value of a flow for the outcomes of its tiles, which are logged as they become known."""
    logger = _logger()
    outcomes, put_off = [], 0
    for outcome in told:
        if outcome is None:
            put_off += 1
            continue
        outcomes.append(outcome)
        if outcome.state == "failed":
            logger.error("%s: %s", outcome.tile, outcome.message)
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    message = f"{len(outcomes) - len(failed)} of {len(outcomes)} tiles done"
    if put_off:
        message += f", {put_off} put off"
    if exit_code(outcomes) and (outcomes or not put_off):
        reasons = "".join(f"\n{o.tile}: {o.message}" for o in failed)
        return Failed(message=message + reasons, data=outcomes)
    return Completed(message=message, data=outcomes)


def _told_around() -> Around:
    """Setting of `each_tile_through`; apart, since a flow travels to Dask's workers and a ContextVar cannot."""
    return _around.get()


def _logger() -> Any:
    try:
        return get_run_logger()
    except MissingContextError:
        return logging.getLogger(__name__)
