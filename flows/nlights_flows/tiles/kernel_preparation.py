"""Compiled loops prepared: beforehand, or by a second process beside the first painting.

The compiler works on one loop at a time in a process, so a second process halves the wait.  Both keep what they
compile in the same folder (`nlights_core.machine.kernel_cache`), and each finds there what the other was faster
with.  The second process measures a tiny simulated painting, without the overview, and so comes first to the
loops that the first one needs later.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np

from nlights_core.capture import Tile
from nlights_core.configurations import load_stand
from nlights_core.errors import NlightsError
from nlights_core.frames import PixelGrid
from nlights_core.machine import compilation
from nlights_core.machine.band_threads import cores
from nlights_core.machine.compilation import Compilation, call_on_compiling
from nlights_core.machine.kernel_cache import install, is_prepared, set_prepared
from nlights_core.machine.kernel_switch import available
from nlights_core.machine.targets import NATIVE, Target, supported_targets
from nlights_core.manifest import load_capture
from nlights_core.products.meshes import write_glb
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.registry import is_bundled
from nlights_core.store import ArtefactRef, Store, Work
from nlights_flows.tiles import children
from nlights_flows.tiles.chain import digitise_tile

WIDTH = 160
"""Of the simulated painting, px."""

FEW_FACES = 500
"""Of the mesh of some bumps of that width and height."""

OTHER_SOLVERS = ("rank-trim", "median-of-triplets")
"""Bundled solvers that no shipped recipe uses."""


@contextmanager
def compiled_beside(recipe: Recipe) -> Iterator[None]:
    """Let a second process compile what a run needs later, where it was never compiled before.

    Parameters
    ----------
    recipe : Recipe
        Of the run.  Where somebody else's plugin takes part, nothing is compiled beside: it is not run for that.
    """
    if not available() or cores() < 2 or not all(is_bundled(type(a)) for a in recipe.algorithms()):
        yield
        return
    begun = Lock()
    with ExitStack() as stack:

        def begin(so_far: Compilation) -> None:
            if begun.acquire(blocking=False):  # at the first loop that is compiled, and never again
                with suppress(OSError):  # a process that cannot be started is no reason to stop
                    scratch = Path(stack.enter_context(TemporaryDirectory()))
                    job = {"runs": [{"recipe": {**recipe.record(), "passes": 1}}]}
                    stack.enter_context(children.child(__name__, job, scratch))

        stack.enter_context(call_on_compiling(begin))
        yield


def prepare_kernels(
    progress: Callable[[float, int], None], portable: bool = False
) -> tuple[int, Path | None]:
    """Compile all loops of the bundled algorithms, on all cores, and put them into the installation.

    Parameters
    ----------
    progress : callable
        Told the share done, and how many loops were compiled so far.
    portable : bool
        Compile for every kind of processors that this one can run, and not only for the fastest: for a container
        that other machines run.

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
    able: list[Target | None] = [*supported_targets()] or [None]
    targets = [target for target in (able if portable else able[:1]) if not is_prepared(_name(target))]
    jobs = [(job, target) for target in targets for job in _jobs()]
    compiled, ended, lock = [0] * len(jobs), [0], Lock()

    def tell(number: int, count: int) -> None:
        compiled[number] = count
        progress(ended[0] / len(jobs), sum(compiled))

    def run(number: int) -> None:
        _compile_in_child(*jobs[number], partial(tell, number))
        with lock:
            ended[0] += 1

    with ThreadPoolExecutor(cores()) as pool:
        for _ in pool.map(run, range(len(jobs))):
            pass
    for target in targets:
        set_prepared(_name(target))
    return sum(compiled), install()


def _name(target: Target | None) -> str:
    return target.name if target else NATIVE


def _compile_in_child(job: dict[str, Any], target: Target | None, tell: Callable[[int], None]) -> None:
    """Do a job in a process that compiles for a target, and tell how many loops it compiled so far."""
    chosen = {"NUMBA_CPU_NAME": target.name, "NUMBA_CPU_FEATURES": target.features} if target else {}
    with (
        TemporaryDirectory() as scratch,
        children.child(__name__, job, Path(scratch), environment=chosen) as child,
    ):
        for said in child.words():
            tell(said["compiled"])
            if "done" in said:
                return
    raise NlightsError(
        "doctor --warm: a process that compiles ended before it was done; it said above why. Nothing is lost: loops "
        "are compiled when they are first needed"
    )


def _jobs() -> list[dict[str, Any]]:
    """List what two processes run: one the whole chain, the other what other solvers and photographs need."""
    default, paper, psbox = (load_recipe(name).record() for name in ("default", "paper", "psbox"))
    single = {**default, "passes": 1}
    others = [{"recipe": {**single, "normals": {"use": use}}, "until": "normals"} for use in OTHER_SOLVERS]
    strips = {"recipe": single, "until": "normals"}
    return [
        {"runs": [{"recipe": default}, {"recipe": paper}, {**strips, "varnish": True}]},
        {"runs": [strips, *others, {**strips, "bits": 8}, {"recipe": psbox}]},
    ]


def measure_tiny(runs: Sequence[Mapping[str, Any]]) -> None:
    """Run recipes on a tiny simulated painting, for the sake of what is compiled.

    Parameters
    ----------
    runs : sequence of mapping
        "recipe": a recipe's content; "bits": of the photographs, 16 if not given; "varnish": whether there is some;
        "until": the last stage, all if not given.
    """
    from nlights_core.simulation.captures import simulate

    with TemporaryDirectory() as folder:
        place = Path(folder)
        stand = load_stand("horizontal")
        simulate(place / "16", stand, scene="painting", width=WIDTH, seed=1)
        for run in runs:
            bits = run.get("bits", 16)
            if bits == 8:
                _write_8_bit(place / "16", place / "8")
            name = "varnished" if run.get("varnish") else str(bits)
            if run.get("varnish"):
                simulate(place / name, stand, scene="painting", width=WIDTH, varnish=True, seed=1)
            (tile,) = load_capture(place / name)
            _measure(tile, load_recipe(run["recipe"]), Store(place / "store"), run.get("until"))


def _measure(tile: Tile, recipe: Recipe, store: Store, until: str | None) -> None:
    def call(stage: Callable[..., Work], *arguments: Any) -> ArtefactRef:
        work = stage(store, *arguments)
        store.ensure(work)
        if work.ref.stage == until:
            raise _EnoughError
        return work.ref

    with suppress(_EnoughError):
        digitise_tile(tile, recipe, call)
        # The height of a larger painting has more faces than its mesh may have, and is refined by other loops.
        x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(WIDTH, dtype=np.float32))
        with store.scratch() as folder:
            bumps = np.sin(x / 9) * np.cos(y / 7)
            write_glb(folder / "mesh.glb", bumps, bumps, PixelGrid(WIDTH, WIDTH, 1.0), faces=FEW_FACES)


class _EnoughError(Exception):
    """The last stage that is wanted has been run."""


def _write_8_bit(capture: Path, target: Path) -> None:
    import tifffile

    shutil.copytree(capture, target, ignore=shutil.ignore_patterns("truth"))
    for path in target.rglob("*.tif"):
        tifffile.imwrite(path, (tifffile.imread(path) >> 8).astype(np.uint8), photometric="rgb")


def _answer(job: dict[str, Any], say: Callable[..., None]) -> None:
    with call_on_compiling(lambda so_far: say(compiled=len(so_far.names))):
        measure_tiny(job["runs"])
    say(done=True, compiled=len(compilation.so_far().names))


if __name__ == "__main__":
    children.answer(_answer)
