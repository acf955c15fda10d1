"""Isolation: a stage in a child process of its own, which may hang, crash or fill the memory alone.

A stage runs so where a time-out is set, and where a plugin that nLights does not ship takes part.
The child (``python -m nlights_flows.isolation``) reads one job, a line of JSON, and answers with
lines of JSON; artefacts go through the store, as always.
"""

from __future__ import annotations

import contextlib
import faulthandler
import inspect
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nlights_core import stages
from nlights_core.algorithms import KINDS, Algorithm
from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.memory import GIB, budget
from nlights_core.registry import installed
from nlights_core.store import ArtefactRef, Progress, Store, Work, sweep

ROOM = 2 * GIB
"""What a child may take above the memory budget: Python, its libraries, the stacks of threads."""

LAST_WORDS = 0.5
"""Seconds in which a child that is stopped writes down where it was."""

HERE = re.compile(r'File "(?P<file>.*)", line (?P<line>\d+) in (?P<function>\S+)')


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
    if store.has(work.ref):
        return True
    algorithms = [a for a in arguments if isinstance(a, Algorithm)]
    if timeout is None and not any(is_foreign(a) for a in algorithms):
        return store.ensure(work, progress)
    answer = None
    try:
        with store.scratch() as scratch:
            trace = scratch / "trace.txt"
            with _child(_job(store, work, tile, arguments, trace), timeout) as (process, stopped):
                assert process.stdout is not None
                answer = _answer(process.stdout, progress)
            if answer is None:
                seen = trace.read_text(encoding="utf-8", errors="replace") if trace.exists() else ""
                limit = timeout if stopped.is_set() else None
                raise TileError(_ended(work.ref.stage, algorithms, seen, limit, process.returncode))
    finally:
        if answer is None:
            # A killed child's drafts would go when their folders are next written to; they may be large.
            sweep(store.path(work.ref).parent)
            sweep(store.root / ".scratch")
    return _taken(answer)


def is_foreign(algorithm: Algorithm) -> bool:
    """Whether an installed plugin offers an algorithm that nLights does not ship."""
    offer = installed().get(algorithm.slot, algorithm.name)
    return offer is not None and offer.algorithm is type(algorithm) and offer.distribution != "nlights"


@contextlib.contextmanager
def _child(job: str, timeout: float | None) -> Iterator[tuple[subprocess.Popen[str], threading.Event]]:
    """A child at work; it has ended, by itself or not, when the block ends."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "nlights_flows.isolation"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        start_new_session=True,  # so that what it starts is stopped along with it
    )
    stopped = threading.Event()

    def stop() -> None:
        stopped.set()
        _signal(process, signal.SIGUSR1)
        time.sleep(LAST_WORDS)
        _signal(process, signal.SIGKILL)

    clock = threading.Timer(timeout, stop) if timeout is not None else None
    try:
        if clock:
            clock.daemon = True
            clock.start()
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it may have died already
            process.stdin.write(job + "\n")
            process.stdin.flush()
        yield process, stopped
    finally:
        if clock:
            clock.cancel()
        _finish(process)


def _finish(process: subprocess.Popen[str]) -> None:
    """End a child: one that has answered goes when its input closes, any other is killed."""
    for pipe in (process.stdin, process.stdout):
        if pipe:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
    try:
        process.wait(LAST_WORDS)
    except subprocess.TimeoutExpired:
        pass
    finally:
        _signal(process, signal.SIGKILL)
        process.wait()


def _signal(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal to a child and to all that it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def _answer(lines: Iterable[str], progress: Progress) -> dict[str, Any] | None:
    """The child's last word; None when it ended without one."""
    for line in lines:
        said = json.loads(line)
        if "share" not in said:
            return said  # type: ignore[no-any-return]
        progress(said["share"])
    return None


def _taken(answer: dict[str, Any]) -> bool:
    """What a child answered, as if the stage had run here."""
    if "fault" in answer:
        raise TileError(answer["fault"])
    if "errno" in answer:
        raise OSError(answer["errno"], answer["strerror"], answer["filename"])
    return bool(answer["cached"])


def _ended(
    stage: str, algorithms: Sequence[Algorithm], trace: str, limit: float | None, code: int | None
) -> str:
    """A sentence for a child that gave no answer: which algorithm, where, how long, what to do."""
    at_work, place = _suspect(algorithms, trace)
    subject = f"{_named(at_work)}: the stage '{stage}'" if at_work else f"the stage '{stage}'"
    other = "choose another algorithm, or report it to its author" if at_work else "or report it"
    if limit is not None:
        return f"{subject} was stopped after {limit:g} s{place}; allow more with --timeout, {other}"
    if code == -signal.SIGKILL:
        return (
            f"{subject} was killed by the system{place}, most often because the memory was full; close other "
            f"programs, {other}"
        )
    how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
    return f"{subject} crashed ({how}){place}; {other}"


def _named(algorithms: Sequence[Algorithm]) -> str:
    return "; ".join(f"{a.slot}: {a.name} ({installed().origin(a)})" for a in algorithms)


def _suspect(algorithms: Sequence[Algorithm], trace: str) -> tuple[list[Algorithm], str]:
    """Whose verb a child was in, and where; all who took part when that cannot be told."""
    frames = [match.groupdict() for match in HERE.finditer(trace)]
    for algorithm in algorithms:
        own = inspect.getsourcefile(type(algorithm))
        kind = next(k for k in KINDS if isinstance(algorithm, k))
        if any(f["file"] == own and f["function"] in kind.__abstractmethods__ for f in frames):
            frame = next(f for f in frames if f["file"] == own)
            return [algorithm], f" in {Path(frame['file']).name}:{frame['line']}"
    return list(algorithms), ""


def _job(store: Store, work: Work, tile: Tile, arguments: Sequence[Any], trace: Path) -> str:
    """A stage's call as JSON."""
    return json.dumps(
        {
            "store": str(store.root),
            "stage": work.ref.stage,
            "key": work.ref.key,
            "tile": tile.model_dump(mode="json"),
            "arguments": [_encoded(argument) for argument in arguments],
            "memory": budget() + ROOM,
            "trace": str(trace),
        }
    )


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


def main() -> None:
    """Do the job that stands on the standard input; answer on the standard output."""
    # What a plugin prints must not be taken for an answer.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    job = json.loads(sys.stdin.readline())
    with Path(job["trace"]).open("w") as trace:
        faulthandler.enable(trace)
        faulthandler.register(signal.SIGUSR1, trace)
        threading.Thread(target=_end_with_parent, daemon=True).start()

        def say(**words: Any) -> None:
            answers.write(json.dumps(words) + "\n")
            answers.flush()

        say(**_done(job, lambda share: say(share=share)))
        faulthandler.disable()
        faulthandler.unregister(signal.SIGUSR1)
    os._exit(0)  # threads that a plugin left behind must not keep the process


def _end_with_parent() -> None:
    """Wait until whoever asked for the work is gone; nobody would stop this process then."""
    sys.stdin.read()
    os._exit(1)


def _done(job: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Run a job's stage and say what came of it."""
    from nlights_flows.running import explained

    store = Store(Path(job["store"]))
    arguments: list[Any] = []
    try:
        _limit_memory(job["memory"])
        tile = Tile.model_validate(job["tile"])
        arguments = [_decoded(argument) for argument in job["arguments"]]
        work = getattr(stages, job["stage"])(store, tile, *arguments)
        if work.ref.key != job["key"]:
            raise TileError(
                f"the stage '{job['stage']}': its photographs or the code of its algorithm were changed while it "
                "ran; run again"
            )
        return {"cached": store.ensure(work, progress)}
    except OSError as fault:
        return {"errno": fault.errno, "strerror": fault.strerror or str(fault), "filename": fault.filename}
    except MemoryError as fault:
        who = _named([a for a in arguments if isinstance(a, Algorithm)]) or f"the stage '{job['stage']}'"
        return {
            "fault": f"{who}: wanted more memory than a tile may take ({fault}); allow more with --memory, or "
            "choose another algorithm"
        }
    except (Exception, SystemExit) as fault:
        return {"fault": explained(fault, store)}


def _limit_memory(size: int) -> None:
    """Let an allocation fail in this process rather than exhaust the machine."""
    import resource

    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    limit = size if hard == resource.RLIM_INFINITY else min(size, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


if __name__ == "__main__":
    main()
