"""Study of tolerance: how wrong a stand's measurement may be (the paper's Figure 2).

Simulated photographs are solved with lamps that are not quite where, or not quite as strong as,
they were when the photographs were taken; what comes out is compared with the known surface, and
with what the right lamps give.  See docs/tolerance.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile

from nlights_core.capture import Tile
from nlights_core.configurations import load_stand
from nlights_core.errors import NlightsError
from nlights_core.frames import Array, PixelGrid
from nlights_core.manifest import load_capture
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.recipe import Recipe
from nlights_core.registry import installed
from nlights_core.simulation.captures import simulate
from nlights_core.simulation.evaluation import angles_between
from nlights_core.store import ArtefactRef, Store
from nlights_flows.tiles.chain import digitise_tile
from nlights_flows.tolerance.stand_errors import Sweep

PROMISED_DEG = 0.5
PROMISED_MM = 1.0
PROMISED_POSITION_MM = 5.0
"""The paper, section 2.2 A: lamps known to 5 mm shall give normals within 0.5 degrees and a mesh
within 1 mm."""

WITHOUT, WITH = "without flat field", "with flat field"


@dataclass(frozen=True)
class Spread:
    """Mean and greatest magnitude, and standard deviation, of a quantity over all pixels."""

    mean: float
    std: float
    greatest: float


@dataclass(frozen=True)
class Measurement:
    """Errors of one solution.

    Attributes
    ----------
    recipe : str
        `WITHOUT` or `WITH`.
    error : float
        In the sweep's unit; 0 for the right lamps.
    draw : int
        Which draw of chance, from 0; of a summary by `worst`, how many there were.
    angle : Spread
        Angle between the normals and the true ones, degrees.
    distance : Spread
        Signed distance of the mesh from its fitted plane (of another scene's height from the true
        one), mm.
    added_angle, added_distance : Spread
        The same against the solution with the right lamps: what the error alone does.
    """

    recipe: str
    error: float
    draw: int
    angle: Spread
    distance: Spread
    added_angle: Spread
    added_distance: Spread


@dataclass(frozen=True)
class Study:
    """A whole study.

    Attributes
    ----------
    stand, scene : str
        Who took the photographs, and of what.
    what, unit : str
        Of the sweep.
    draws : int
        Of the sweep.
    measurements : list of Measurement
        The right lamps first, then by error, draw and recipe.
    notes : list of str
        Errors that were passed over, and why.
    """

    stand: str
    scene: str
    what: str
    unit: str
    draws: int
    measurements: list[Measurement]
    notes: list[str]


def compared_recipes(recipe: Recipe) -> dict[str, Recipe]:
    """A recipe with its flat field, and with one computed from the lamps in its stead.

    Parameters
    ----------
    recipe : Recipe
        Its light model and its detrend of images are replaced in the first.

    Returns
    -------
    dict of str to Recipe
        By `WITHOUT` (measured-poi with emission, inverse-square) and `WITH`.
    """

    def algorithm(slot: str, name: str, **options: Any) -> Any:
        offer = installed().get(slot, name)
        if offer is None:
            raise NlightsError(f"tolerance: needs the {slot} '{name}', which is not installed")
        return offer.algorithm.model_validate(options)

    computed = recipe.detrend.model_copy(update={"images": algorithm("detrend.images", "inverse-square")})
    lights = algorithm("light_model", "measured-poi", emission=True)
    return {WITHOUT: recipe.model_copy(update={"light_model": lights, "detrend": computed}), WITH: recipe}


def solve_maps(tile: Tile, recipe: Recipe, folder: Path) -> tuple[Array, Array]:
    """Run the chain as far as the maps; mesh and report are named but not made.

    Parameters
    ----------
    tile, recipe : Tile, Recipe
        What, and with which algorithms.
    folder : Path
        For the artefacts.

    Returns
    -------
    normals : (H, W, 3) float32 array
    height : (H, W) float32 array
        mm.
    """
    store = Store(folder)
    store.prepare()
    latest: dict[str, ArtefactRef] = {}

    def call(stage: Callable[..., Any], tile: Tile, *arguments: Any) -> ArtefactRef:
        work = stage(store, tile, *arguments)
        if stage.__name__ not in ("mesh", "report"):
            store.ensure(work)
            latest[stage.__name__] = work.ref
        return work.ref  # type: ignore[no-any-return]

    digitise_tile(tile, recipe, call)
    maps = store.path(latest["maps"])
    return tifffile.imread(maps / "normals.tif"), tifffile.imread(maps / "height.tif")


def plane_distances(height: Array, grid: PixelGrid) -> Array:
    """Signed distance of every vertex of the mesh from the plane that fits them best.

    Parameters
    ----------
    height : (H, W) array
        mm; NaN where not known.
    grid : PixelGrid
        Its camera says where the vertices are.

    Returns
    -------
    (H, W) float64 array
        mm, positive towards the camera; NaN where not known.
    """
    known = np.isfinite(height)
    vertices = grid.points(0, grid.rows, height)[:, known].astype(np.float64)
    vertices -= vertices.mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(vertices @ vertices.T)[1][:, 0]
    out = np.full(height.shape, np.nan)
    out[known] = np.copysign(1.0, normal[2]) * (normal @ vertices)
    return out


def spread(values: Array) -> Spread:
    """Summarise signed values over all pixels; NaN where none is known."""
    known = values[np.isfinite(values)].astype(np.float64)
    if not known.size:
        return Spread(np.nan, np.nan, np.nan)
    size = np.abs(known)
    return Spread(float(size.mean()), float(known.std()), float(size.max()))


def largest_within(errors: Sequence[float], values: Sequence[float], limit: float) -> float | None:
    """The largest error up to which a value keeps below a limit, interpolated between logarithms.

    Parameters
    ----------
    errors : sequence of float
        Ascending, positive.
    values : sequence of float
        Positive.
    limit : float
        For the values.

    Returns
    -------
    float or None
        Infinite when no value is above the limit; None when the first one is.

    Examples
    --------
    >>> round(largest_within([1, 10, 100], [0.01, 0.1, 1.0], 0.5), 6)
    50.0
    """
    for i, value in enumerate(values):
        if not value <= limit:
            if i == 0:
                return None
            before = max(values[i - 1], np.finfo(float).tiny)  # tiny errors may add nothing at all
            if not np.isfinite(value):
                return float(errors[i - 1])
            share = np.log(limit / before) / np.log(value / before)
            return float(errors[i - 1] * (errors[i] / errors[i - 1]) ** share)
    return float(np.inf)


def study(
    stand: str,
    sweep: Sweep,
    recipe: Recipe,
    *,
    scene: str = "plane",
    width: int = 240,
    seed: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Study:
    """Photograph a surface once, and solve it with ever wronger lamps.

    Parameters
    ----------
    stand : str
        Name or file of the stand that takes the photographs.
    sweep : Sweep
        What is wrong.
    recipe : Recipe
        With a flat field; see `compared_recipes`.
    scene, width, seed : str, int, int
        Of `nlights_core.simulation.captures.simulate`.
    progress : callable
        Told the share done.

    Returns
    -------
    Study

    Raises
    ------
    NlightsError
        When stand, scene, width or seed is out of range, or every error had to be passed over.
    """
    with TemporaryDirectory(prefix="nlights-tolerance-") as scratch:
        folder = Path(scratch)
        manifest = simulate(folder / "capture", load_stand(stand), scene=scene, width=width, seed=seed)
        (tile,) = load_capture(manifest, stand=stand)
        assert tile.stand is not None
        found, notes = _swept(tile, sweep, recipe, scene, manifest.parent / "truth", progress)
    if not any(one.error for one in found):
        raise NlightsError(f"no size of error is possible; {notes[0]}; try smaller ones")
    return Study(tile.stand.name, scene, sweep.what, sweep.unit, sweep.draws, found, notes)


def _swept(
    tile: Tile, sweep: Sweep, recipe: Recipe, scene: str, truth: Path, progress: Callable[[float], None]
) -> tuple[list[Measurement], list[str]]:
    """The measurements of a study, and a note on every error that was passed over."""
    highest = max(0.0, float(tifffile.imread(truth / "height.tif").max()))
    recipes = compared_recipes(recipe)
    right = {name: _deviations(tile, chosen, truth, scene) for name, chosen in recipes.items()}
    found = [_measurement(name, 0.0, 0, one, one) for name, one in right.items()]
    notes: list[str] = []
    cases = [(error, draw) for error in sweep.errors for draw in range(sweep.draws)]
    for done, (error, draw) in enumerate(cases, start=1):
        with TemporaryDirectory(dir=truth.parent) as own:
            wrong = sweep.disturb(tile, error, draw, Path(own))
            sunk = _sunk(wrong, highest)
            if sunk:
                which = f"{error:.4g} {sweep.unit}" + (f", draw {draw + 1}" if sweep.draws > 1 else "")
                notes.append(f"{which}: passed over, because {sunk}")
                continue
            for name, chosen in recipes.items():
                one = _deviations(wrong, chosen, truth, scene)
                found.append(_measurement(name, error, draw, one, right[name]))
        progress(done / len(cases))
    return found, notes


def _sunk(tile: Tile, highest: float) -> str:
    """Clause that names a lamp believed to be not above the artwork; empty when none is."""
    assert tile.stand is not None
    heights = tile.stand.lamp_positions(tile.lamps)[:, 2]
    lowest = int(heights.argmin())
    if heights[lowest] > highest:
        return ""
    return f"it puts {tile.lamps[lowest]} at z = {heights[lowest]:.1f} mm, not above the artwork"


@dataclass(frozen=True)
class _Deviations:
    """A solution: normals (H, W, 3), their angles to the truth, degrees, and distances, mm."""

    normals: Array
    angles: Array
    distances: Array


def _deviations(tile: Tile, recipe: Recipe, truth: Path, scene: str) -> _Deviations:
    with TemporaryDirectory() as folder:
        normals, height = solve_maps(tile, recipe, Path(folder))
    if scene == "plane":
        distances = plane_distances(height, grid_of(tile, survey(tile)))
    else:
        distances = height.astype(np.float64) - tifffile.imread(truth / "height.tif")
        distances -= np.nanmean(distances)
    return _Deviations(normals, angles_between(normals, tifffile.imread(truth / "normals.tif")), distances)


def _measurement(name: str, error: float, draw: int, found: _Deviations, right: _Deviations) -> Measurement:
    return Measurement(
        name,
        error,
        draw,
        spread(found.angles),
        spread(found.distances),
        spread(angles_between(found.normals, right.normals)),
        spread(found.distances - right.distances),
    )


def worst(study: Study, recipe: str) -> list[Measurement]:
    """Worst draw of every error in each figure.

    Parameters
    ----------
    study : Study
        With any number of draws.
    recipe : str
        `WITHOUT` or `WITH`.

    Returns
    -------
    list of Measurement
        One per error, ascending; the right lamps, with error 0, first.
    """

    def most(spreads: list[Spread]) -> Spread:
        return Spread(*(max(getattr(s, f) for s in spreads) for f in ("mean", "std", "greatest")))

    mine = [one for one in study.measurements if one.recipe == recipe]
    out = []
    for error in sorted({one.error for one in mine}):
        draws = [one for one in mine if one.error == error]
        names = ("angle", "distance", "added_angle", "added_distance")
        figures = {name: most([getattr(one, name) for one in draws]) for name in names}
        out.append(Measurement(recipe, error, len(draws), **figures))
    return out
