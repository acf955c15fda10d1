"""The Prefect flow `compare`: variants on the same captures, one task per variant, tile and stage."""

# No `from __future__ import annotations` here: Prefect resolves the parameters' types itself.
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.states import Completed, Failed

from nlights_core.recipe import Recipe
from nlights_flows.comparison.order import Order, run_comparison
from nlights_flows.comparison.runs import Case, Run, Workshop
from nlights_flows.tiles.digitise import ensure_as_task
from nlights_flows.tiles.environment import outlive_reader
from nlights_flows.tiles.run_options import RunOptions


@flow(name="compare", persist_result=False, validate_parameters=True)
def compare(
    artworks: list[str],
    recipes: list[str] | None = None,
    grid: list[str] | None = None,
    recipe: str = "default",
    out: str = "comparison",
    store: str | None = None,
    stand: str | None = None,
    root: str | None = None,
    tiles: list[str] | None = None,
    compression: str = "none",
    timeout: float | None = None,
    memory: str | None = None,
) -> Any:
    """Compare variants on the tiles of some captures.

    Parameters
    ----------
    artworks : list of str
        Paths of the ``artwork.yaml`` files.
    recipes : list of str, optional
        Names of shipped recipes, or paths.
    grid : list of str, optional
        ``field=value,value``: every combination becomes a variant.
    recipe : str
        The recipe that the grid varies.
    out : str
        Folder of the page and of the variants' products.
    store : str, optional
        Folder of the artefacts; ``<out>/.store`` by default.
    stand : str, optional
        Name or path of a stand, instead of the manifests'.
    root : str, optional
        Capture root; each manifest's folder by default.
    tiles : list of str, optional
        Only tiles of these names.
    compression : str
        Of the TIFFs among the products, "none" or "zstd".
    timeout : float, optional
        Seconds that a stage may take; then it is stopped, and its variant has failed on its tile.
    memory : str, optional
        Memory that a tile may take, as 6GiB.

    Returns
    -------
    State
        Completed, or Failed when a variant failed on a tile; both carry what ``compare.json``
        holds as their data.
    """
    options = RunOptions.of(locals())
    order = Order([Path(path) for path in artworks], recipes or [], grid or [], options)
    outlive_reader()
    record = run_comparison(order, run_as_tasks)
    failed = [run for run in record["runs"] if run["state"] == "failed"]
    done = f"{len(record['runs']) - len(failed)} of {len(record['runs'])} runs done"
    message = f"{done}: {options.out / 'compare.html'}"
    if failed:
        reasons = "".join(f"\n{run['variant']}: {run['tile']}: {run['message']}" for run in failed)
        return Failed(message=message + reasons, data=record)
    return Completed(message=message, data=record)


def run_as_tasks(workshop: Workshop, recipe: Recipe, cases: Sequence[Case]) -> list[Run]:
    """Run a variant on all tiles, each stage as a task."""
    return [
        workshop.run(case, recipe, ensure_as_task(workshop.options, f"{recipe.name}: {case.name}"))
        for case in cases
    ]
