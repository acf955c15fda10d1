"""Compiled loops prepared: beforehand, or by a second process beside the first painting.

The compiler works on one loop at a time in a process, so a second process halves the wait.  Both keep what they
compile in the same folder (`nlights_core.machine.kernel_cache`), and each finds there what the other was faster
with.  The second process measures a tiny simulated painting, without the overview, and so comes first to the
loops that the first one needs later.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np

from nlights_core.configurations import load_stand
from nlights_core.errors import NlightsError
from nlights_core.machine import compilation
from nlights_core.machine.band_threads import cores
from nlights_core.machine.kernel_cache import install, is_complete, set_complete
from nlights_core.machine.kernel_switch import available
from nlights_core.manifest import load_capture
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.registry import is_bundled
from nlights_core.store import ArtefactRef, Store, Work
from nlights_flows.tiles import children
from nlights_flows.tiles.chain import digitise_tile

WIDTH = 160
"""Of the simulated painting, px."""

OTHER_SOLVERS = ("rank-trim", "median-of-triplets")
"""Bundled solvers that no shipped recipe uses."""

ALL = "all"
"""Mark of loops that were prepared beforehand: those of all bundled solvers."""


@contextmanager
def compiled_beside(recipe: Recipe) -> Iterator[None]:
    """Let a second process compile what a run needs later, where it was never compiled before.

    Parameters
    ----------
    recipe : Recipe
        Of the run.  Where somebody else's plugin takes part, nothing is compiled beside: it is not run for that.
    """
    mark = recipe.normals.name
    if not available() or is_complete(mark) or not all(is_bundled(type(a)) for a in recipe.algorithms()):
        yield
        return
    with ExitStack() as stack:
        if cores() > 1:
            with suppress(OSError):  # a process that cannot be started is no reason to stop
                job = {"recipe": {**recipe.record(), "passes": 1}}
                scratch = Path(stack.enter_context(TemporaryDirectory()))
                stack.enter_context(children.child(__name__, job, scratch))
        yield
    set_complete(mark)


def prepare_kernels(progress: Callable[[float, int], None]) -> tuple[int, Path | None]:
    """Compile all loops of the bundled algorithms, on all cores, and put them into the installation.

    Parameters
    ----------
    progress : callable
        Told the share done, and how many loops were compiled so far.

    Returns
    -------
    count : int
        How many loops were compiled; 0 where all were there.
    folder : Path or None
        Where they are; None where no folder can be written.

    Raises
    ------
    NlightsError
        When a process that compiles fails, with what it said.
    """
    if is_complete(ALL):
        return 0, install()
    jobs = _jobs()
    compiled, ended, lock = [0] * len(jobs), [0], Lock()

    def run(number: int) -> None:
        with TemporaryDirectory() as scratch, children.child(__name__, jobs[number], Path(scratch)) as child:
            done = False
            for said in child.words():
                done = done or "done" in said
                with lock:
                    compiled[number] = said.get("compiled", compiled[number])
                    progress(ended[0] / len(jobs), sum(compiled))
                if done:
                    break
            if not done:
                raise NlightsError(
                    "doctor --warm: a process that compiles ended before it was done; it said above why. Nothing "
                    "is lost: loops are compiled when they are first needed"
                )
        with lock:
            ended[0] += 1

    with ThreadPoolExecutor(min(cores(), len(jobs))) as pool:
        for _ in pool.map(run, range(len(jobs))):
            pass
    for job in jobs:
        set_complete(job["recipe"]["normals"]["use"])
    set_complete(ALL)
    return sum(compiled), install()


def _jobs() -> list[dict[str, Any]]:
    """Recipes to be run, the long ones first."""
    default, paper, psbox = (load_recipe(name).record() for name in ("default", "paper", "psbox"))
    jobs = [{"recipe": default}, {"recipe": {**default, "passes": 1}}, {"recipe": paper}]
    jobs += [{"recipe": {**default, "normals": {"use": use}, "passes": 1}} for use in OTHER_SOLVERS]
    return [*jobs, {"recipe": psbox}, {"recipe": {**default, "passes": 1}, "bits": 8}]


def measure_tiny(job: Mapping[str, Any]) -> None:
    """Run a recipe on a tiny simulated painting, for the sake of what is compiled.

    Parameters
    ----------
    job : mapping
        "recipe": a recipe's content; "bits": of the photographs, 16 if not given.
    """
    from nlights_core.simulation.captures import simulate

    with TemporaryDirectory() as folder:
        place = Path(folder)
        text = place / "recipe.yaml"
        text.write_text(json.dumps(job["recipe"]), encoding="utf-8")  # JSON is YAML
        simulate(place / "capture", load_stand("horizontal"), scene="painting", width=WIDTH, seed=1)
        if job.get("bits", 16) == 8:
            _make_8_bit(place / "capture")
        (tile,) = load_capture(place / "capture")
        store = Store(place / "store")

        def call(stage: Callable[..., Work], *arguments: Any) -> ArtefactRef:
            work = stage(store, *arguments)
            store.ensure(work)
            return work.ref

        digitise_tile(tile, load_recipe(str(text)), call)


def _make_8_bit(capture: Path) -> None:
    import tifffile

    for path in (*capture.glob("*.tif"), *capture.glob("flat/*.tif")):
        tifffile.imwrite(path, (tifffile.imread(path) >> 8).astype(np.uint8), photometric="rgb")


def _answer(job: dict[str, Any], say: Callable[..., None]) -> None:
    with compilation.call_on_compiling(lambda so_far: say(compiled=len(so_far.names))):
        measure_tiny(job)
    say(done=True, compiled=len(compilation.so_far().names))


if __name__ == "__main__":
    children.answer(_answer)
