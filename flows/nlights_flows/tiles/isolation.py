"""Isolation: a stage in a child process of its own, which may hang, crash or fill the memory alone.

A stage runs so where a time-out is set, and where a plugin that nLights does not ship takes part.
The child is told references and options (`nlights_flows.tiles.children`); artefacts go through the store,
as always.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nlights_core import stages
from nlights_core.algorithms import KINDS, Algorithm
from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.machine.progress import Progress, note, noting
from nlights_core.registry import installed
from nlights_core.store import ArtefactRef, Store, Work, sweep
from nlights_flows.tiles import children
from nlights_flows.tiles.explaining import explain_fault


def ensure(
    store: Store,
    work: Work,
    tile: Tile,
    arguments: Sequence[Any],
    progress: Progress = lambda share: None,
    timeout: float | None = None,
) -> bool:
    """Make an artefact unless it is there, as `nlights_core.store.Store.ensure`, in a child where need be.

    Parameters
    ----------
    store : Store
        Where the artefact goes.
    work : Work
        What ``stages.<work.ref.stage>(store, tile, *arguments)`` returned.
    tile, arguments : Tile, sequence
        What the stage was called with.
    progress : callable
        Told the share done.
    timeout : float, optional
        Seconds after which the stage is stopped.  None: never; the stage then runs in this process
        unless a plugin that nLights does not ship takes part.

    Returns
    -------
    bool
        Whether it was there already.

    Raises
    ------
    TileError
        As the stage raises it; or when it was stopped or crashed, naming the stage, the algorithm
        and what to do.
    OSError
        As the stage raises it.
    """
    if store.has(work.ref) or not needs_child(arguments, timeout):
        return store.ensure(work, progress)
    store.require_whole_inputs(work)
    answer = None
    try:
        with store.scratch() as scratch:
            with children.child(__name__, _job(store, work, tile, arguments), scratch, timeout) as child:
                child.start_clock()
                for said in child.words():
                    if "share" in said:
                        progress(said["share"])
                    elif "sentence" in said:
                        note(said["sentence"])
                    else:
                        answer = said
                        break
            if answer is None:
                raise TileError(_ended(work.ref.stage, arguments, child))
    finally:
        if answer is None:
            # A killed child's drafts would go when their folders are next written to; they may be large.
            sweep(store.path(work.ref).parent)
            sweep(store.root / ".scratch")
    cached = _take_answer(answer)
    if not cached:
        store.trust(work.ref)
    return cached


def needs_child(arguments: Sequence[Any], timeout: float | None) -> bool:
    """Test whether a stage that is called with these arguments and a time-out runs in a child."""
    return timeout is not None or any(is_foreign(a) for a in arguments if isinstance(a, Algorithm))


def is_foreign(algorithm: Algorithm) -> bool:
    """Test whether an installed plugin offers an algorithm that nLights does not ship."""
    offer = installed().get(algorithm.slot, algorithm.name)
    return offer is not None and offer.algorithm is type(algorithm) and offer.distribution != "nlights"


def _take_answer(answer: dict[str, Any]) -> bool:
    """Take a child's answer, as if the stage had run here."""
    if "fault" in answer:
        raise TileError(answer["fault"])
    if "errno" in answer:
        raise OSError(answer["errno"], answer["strerror"], answer["filename"])
    return bool(answer["cached"])


def _ended(stage: str, arguments: Sequence[Any], child: children.Child) -> str:
    """A sentence for a child that gave no answer: which algorithm, where, how long, what to do."""
    at_work, place = _suspect([a for a in arguments if isinstance(a, Algorithm)], child)
    subject = f"{_named(at_work)}: the stage '{stage}'" if at_work else f"the stage '{stage}'"
    other = "choose another algorithm, or report it to its author" if at_work else "or report it"
    return f"{subject} {child.ending(place, other)}"


def _named(algorithms: Sequence[Algorithm]) -> str:
    return "; ".join(f"{a.slot}: {a.name} ({installed().origin(a)})" for a in algorithms)


def _suspect(algorithms: Sequence[Algorithm], child: children.Child) -> tuple[list[Algorithm], str]:
    """Algorithm whose verb a child was in, and where; all that took part when that cannot be told."""
    frames = child.frames()
    for algorithm in algorithms:
        own = inspect.getsourcefile(type(algorithm))
        kind = next(k for k in KINDS if isinstance(algorithm, k))
        if any(f["file"] == own and f["function"] in kind.__abstractmethods__ for f in frames):
            frame = next(f for f in frames if f["file"] == own)
            return [algorithm], f" in {Path(frame['file']).name}:{frame['line']}"
    return list(algorithms), ""


def _job(store: Store, work: Work, tile: Tile, arguments: Sequence[Any]) -> dict[str, Any]:
    """A stage's call as JSON."""
    return {
        "store": str(store.root),
        "stage": work.ref.stage,
        "key": work.ref.key,
        "tile": tile.model_dump(mode="json"),
        "arguments": [_encoded(argument) for argument in arguments],
    }


def _encoded(argument: Any) -> dict[str, Any]:
    if isinstance(argument, Algorithm):
        options = argument.model_dump_json()
        return {"slot": argument.slot, "use": argument.name, "options": options}
    if isinstance(argument, ArtefactRef):
        return {"artefact": asdict(argument)}
    return {"value": argument}


def _decoded(argument: dict[str, Any]) -> Any:
    if "use" in argument:
        offer = installed().get(argument["slot"], argument["use"])
        if offer is None:
            raise TileError(f"{argument['slot']}: {argument['use']} is not installed any more; run again")
        return offer.algorithm.model_validate_json(argument["options"])
    if "artefact" in argument:
        return ArtefactRef(**argument["artefact"])
    return argument["value"]


def _done(job: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Run a job's stage and say what came of it."""
    store = Store(Path(job["store"]))
    arguments: list[Any] = []
    try:
        children.limit_memory(job["memory"])
        tile = Tile.model_validate(job["tile"])
        arguments = [_decoded(argument) for argument in job["arguments"]]
        work = getattr(stages, job["stage"])(store, tile, *arguments)
        if work.ref.key != job["key"]:
            raise TileError(
                f"the stage '{job['stage']}': its photographs or the code of its algorithm were changed while it "
                "ran; run again"
            )
        return {"cached": store.ensure(work, progress, inputs_are_whole=True)}
    except OSError as fault:
        return {"errno": fault.errno, "strerror": fault.strerror or str(fault), "filename": fault.filename}
    except MemoryError as fault:
        who = _named([a for a in arguments if isinstance(a, Algorithm)]) or f"the stage '{job['stage']}'"
        return {
            "fault": f"{who}: wanted more memory than a tile may take ({fault}); allow more with --memory, or "
            "choose another algorithm"
        }
    except (Exception, SystemExit) as fault:
        return {"fault": explain_fault(fault, store)}


def _answer(job: dict[str, Any], say: Callable[..., None]) -> None:
    with noting(lambda sentence: say(sentence=sentence)):
        say(**_done(job, lambda share: say(share=share)))


if __name__ == "__main__":
    children.answer(_answer)
