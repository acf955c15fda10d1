"""Accuracy on simulated captures: the whole chain, every recipe and every normal solver."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy_subjects import solvers
from tables import Cell, Table, kept

from nlights_core.configurations import load_stand
from nlights_core.manifest import load_capture
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.simulation.evaluation import evaluate
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly


class Case(NamedTuple):
    """A simulated scene and what issue 3 asks of it: mean angle in degrees, height rms in mm."""

    title: str
    scene: str
    stand: str
    varnish: bool
    degrees: float
    millimetres: float


CASES = (
    Case("plane, horizontal", "plane", "horizontal", False, 0.13, 0.005),
    Case("plane, vertical", "plane", "vertical-dark", False, 0.17, 0.005),
    Case("painting, matt, horizontal", "painting", "horizontal", False, 0.13, 0.008),
    Case("drawing, vertical", "drawing", "vertical-dark", False, 0.17, 0.012),
    Case("relief of 8 mm, vertical", "relief", "vertical-dark", False, 0.185, 0.012),
    Case("painting, varnished, horizontal", "painting", "horizontal", True, 0.16, 0.11),
)
SCENE_COLUMNS = (
    "scene, stand",
    "normals mean, degrees",
    "at most, degrees",
    "normals",
    "height rms, mm",
    "at most, mm",
    "height",
    "seeds",
)
OTHER_RECIPES = ("paper", "paper-compensated", "psbox")

Error = tuple[float, float]
"""Mean angle between the normals, degrees; rms of the height, mm."""


def simulations(quick: bool) -> list[Table]:
    """Tables ``scenes``, ``recipes`` and ``solvers``.

    The recipes other than the default and the solvers other than its own see seed 1 only.
    """
    width, seeds = (300, (1,)) if quick else (800, (1, 2, 3))
    found: dict[tuple[str, str], list[Error]] = {}
    for case in CASES:
        for seed in seeds:
            print(f"  {case.title}, seed {seed}:", end="", flush=True)
            for name, error in _errors(case, width, seed, first=seed == seeds[0]):
                print(f" {name} {error[0]:.3f}/{error[1]:.4f}", end="", flush=True)
                found.setdefault((case.title, name), []).append(error)
            print(flush=True)
    return [
        Table(
            "scenes",
            SCENE_COLUMNS,
            [_judged(case, found[case.title, "default"]) for case in CASES],
        ),
        _side_by_side("recipes", ("default", *OTHER_RECIPES), found),
        _side_by_side("solvers", tuple(solvers()), found),
    ]


def _judged(case: Case, errors: list[Error]) -> tuple[Cell, ...]:
    degrees, millimetres = (float(mean) for mean in np.mean(errors, axis=0))
    return (
        case.title,
        degrees,
        case.degrees,
        kept(degrees <= case.degrees),
        millimetres,
        case.millimetres,
        kept(millimetres <= case.millimetres),
        str(len(errors)),
    )


def _side_by_side(name: str, columns: tuple[str, ...], found: dict[tuple[str, str], list[Error]]) -> Table:
    """Errors of the first seed, a column per recipe or solver."""
    rows: list[tuple[Cell, ...]] = []
    for k, what in ((0, "normals, degrees"), (1, "height, mm")):
        rows += [(f"{case.title}: {what}", *(found[case.title, c][0][k] for c in columns)) for case in CASES]
    return Table(name, ("scene, stand", *(f"`{column}`" for column in columns)), rows)


def _errors(case: Case, width: int, seed: int, first: bool) -> Iterator[tuple[str, Error]]:
    """Simulate a capture and digitise it with the default recipe, the first seed with all others too."""
    recipes = [load_recipe("default")]
    if first:
        recipes += [load_recipe(name) for name in OTHER_RECIPES]
        recipes += _with_each_solver(recipes[0])
    with tempfile.TemporaryDirectory() as place:
        capture, out = Path(place) / "capture", Path(place) / "out"
        simulate(
            capture, load_stand(case.stand), scene=case.scene, width=width, varnish=case.varnish, seed=seed
        )
        tile, options = load_capture(capture)[0], RunOptions(store=Path(place) / "store")
        for recipe in recipes:
            outcome = run_directly(tile, recipe, replace(options, out=out / recipe.name), lambda *_: None)
            if outcome.folder is None:
                raise SystemExit(f"{case.title}, recipe {recipe.name}: {outcome.message}")
            error = evaluate(outcome.folder, capture / "truth")
            yield recipe.name, (error["angle_mean_deg"], error["height_rms_mm"])


def _with_each_solver(recipe: Recipe) -> list[Recipe]:
    """The recipe with every installed normal solver in turn, each at its standard options."""
    return [recipe.model_copy(update={"name": n, "normals": solver()}) for n, solver in solvers().items()]
