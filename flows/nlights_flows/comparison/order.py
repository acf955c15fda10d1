"""Orders: what is to be compared, checked before anything runs, and carried out to the last file."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlights_core.errors import CaptureError, RecipeError
from nlights_core.recipe import Recipe, RecipeLike
from nlights_core.store import write_whole
from nlights_flows.comparison.comparing import compare_runs
from nlights_flows.comparison.page import write_page
from nlights_flows.comparison.runs import Case, Run, Workshop, load_cases
from nlights_flows.comparison.variants import folder_of, variants_of
from nlights_flows.tiles import console
from nlights_flows.tiles.preparing import make_folders
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import ensure_here


@dataclass(frozen=True)
class Order:
    """Order of a comparison; see `nlights_flows.commands.compare.compare`."""

    artworks: Sequence[Path]
    recipes: Sequence[RecipeLike]
    grid: Sequence[str]
    options: RunOptions
    """Its recipe is the one that the grid varies, unless there is a `base`."""
    base: RecipeLike | None = None


RunAll = Callable[[Workshop, Recipe, Sequence[Case]], list[Run]]
"""How to run a variant on all tiles: `run_directly` here, or as Prefect tasks."""


def run_comparison(order: Order, run_all: RunAll) -> dict[str, Any]:
    """Run all variants, measure them, and write ``compare.html`` and ``compare.json``.

    Parameters
    ----------
    order : Order
    run_all : callable
        See `RunAll`.

    Returns
    -------
    dict
        What ``compare.json`` holds.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What the user has to mend; nothing was written.
    """
    started, options = time.monotonic(), order.options
    recipes, cases = check_comparison(order)
    with options.in_force():
        make_folders(options)
        workshop = Workshop(options)
        runs = [run for recipe in recipes for run in run_all(workshop, recipe, cases)]
        comparison = compare_runs(recipes, cases, runs, options.artefacts)
        write_page(options.out / "compare.html", comparison)
    spent = {"stages": workshop.seconds, "all": time.monotonic() - started}
    record = {**comparison.record, "seconds": {name: round(value, 3) for name, value in spent.items()}}
    write_whole(options.out / "compare.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
    return record


def check_comparison(order: Order) -> tuple[list[Recipe], list[Case]]:
    """The variants and tiles of an order; runs and writes nothing.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What the user has to mend.
    """
    options = order.options
    options.check()
    base = options.recipe if order.base is None else order.base
    recipes = variants_of(order.recipes, order.grid, base)
    folders = Counter(folder_of(recipe).casefold() for recipe in recipes)
    for recipe in recipes:
        if folders[folder_of(recipe).casefold()] > 1:
            raise RecipeError(
                f"--recipes: '{recipe.name}' would share its folder '{folder_of(recipe)}' with another variant; "
                "rename one of the files"
            )
    cases = load_cases(order.artworks, stand=options.stand, root=options.root, names=options.tiles)
    if all(recipe.lacking(case.tile) for recipe in recipes for case in cases):
        case, recipe = cases[0], recipes[0]
        raise CaptureError("\n".join(f"{case.name}: {said}" for said in recipe.lacking(case.tile)))
    return recipes, cases


def run_directly(workshop: Workshop, recipe: Recipe, cases: Sequence[Case], shown: bool = True) -> list[Run]:
    """Run a variant by calling its stages, with a progress bar where it is to be shown."""
    runs = []
    with console.TileProgress(recipe, [case.tile for case in cases], shown) as watch:
        for case in cases:
            place = f"{recipe.name}: {case.name}"
            ensure = ensure_here(workshop.options, place, watch)
            runs.append(workshop.run(case, recipe, ensure))
            watch.tile_done(runs[-1].outcome)
    return runs
