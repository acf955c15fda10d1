"""The chain of stages, once, in reading order."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from nlights_core import stages
from nlights_core.capture import Tile
from nlights_core.recipe import Recipe
from nlights_core.stages.mask import FILE as MASK
from nlights_core.store import ArtefactRef

Call = Callable[..., ArtefactRef]
"""How to call a stage: ``call(stage, tile, ...)``.  Planning, calling directly and running as a
Prefect task differ in nothing else."""


def digitise_tile(
    tile: Tile, recipe: Recipe, call: Call, compression: str = "none"
) -> dict[str, ArtefactRef]:
    """Photographs of a tile become albedo, normals, height, reflection map and mesh.

    Parameters
    ----------
    tile : Tile
        What to digitise.
    recipe : Recipe
        With which algorithms.
    call : callable
        How to call a stage.
    compression : str
        Of the TIFFs among the products, "none" or "zstd".

    Returns
    -------
    dict
        The artefacts that hold products: "maps", "mesh" and "report".
    """
    detrend = recipe.detrend
    lights = call(stages.lights, tile, recipe.light_model)
    flat_field = call(stages.flat_field, tile, detrend.images, lights) if detrend.images else None
    flats = any("flats" in algorithm.needs for algorithm in recipe.algorithms())
    seen = tile
    if tile.auto_mask:
        found = call(stages.mask, tile, flats)
        seen = tile.model_copy(update={"mask": Path(found.folder) / MASK})
    agreement = call(stages.agreement, seen, lights, flats)
    bias = overview = None
    if detrend.normals:
        bias = call(stages.bias, tile, detrend.normals, recipe.normals, lights, flat_field)
    calibration = alignment = None
    if _calibrates(recipe):
        alignment, calibration = _calibrate(seen, recipe, call, lights, flat_field, agreement)
    elif recipe.passes > 1:
        overview = call(stages.overview, seen, lights, flat_field, recipe.passes - 1)
    # Only a photographed flat knows what white is.
    white = detrend.images is not None and "flats" in detrend.images.needs
    before = calibration or overview
    normals = call(stages.normals, seen, recipe.normals, lights, flat_field, bias, before, white, alignment)
    height, trend, maps = _integrate(tile, recipe, call, compression, normals, calibration)
    mesh = call(stages.mesh, tile, maps, height)
    report = call(
        stages.report, seen, recipe_record(recipe), lights, flat_field, agreement, bias, normals, height, trend, maps,
        mesh, calibration, alignment,
    )  # fmt: skip
    return {"maps": maps, "mesh": mesh, "report": report}


def _calibrate(
    tile: Tile,
    recipe: Recipe,
    call: Call,
    lights: ArtefactRef,
    flat_field: ArtefactRef | None,
    agreement: ArtefactRef,
) -> tuple[ArtefactRef | None, ArtefactRef]:
    """Find how the photographs lie on each other, if that is asked for, and what all pixels share."""
    assert recipe.calibration
    alignment = None
    if recipe.calibration.align:
        alignment = call(stages.alignment, tile, lights, agreement)
    groups = recipe.calibration.groups()
    return alignment, call(stages.calibration, tile, lights, flat_field, groups, alignment)


def _integrate(
    tile: Tile,
    recipe: Recipe,
    call: Call,
    compression: str,
    normals: ArtefactRef,
    calibration: ArtefactRef | None,
) -> tuple[ArtefactRef, ArtefactRef | None, ArtefactRef]:
    """Integrate normals to a height; return it, the trend taken out of it, and the maps."""
    trend = None
    height = integrated = call(stages.height, tile, recipe.integrator, normals)
    if recipe.detrend.height:
        height = trend = call(stages.trend, tile, recipe.detrend.height, height)
    if calibration:
        height = call(stages.level, tile, height, calibration)
    perspective = recipe.integrable and getattr(recipe.integrator, "perspective", False)
    surface = integrated if recipe.integrable else None
    maps = call(stages.maps, tile, normals, height, trend, surface, perspective, compression, calibration)
    return height, trend, maps


def recipe_record(recipe: Recipe) -> dict[str, Any]:
    """The recipe as the report shows it, under its name."""
    return {"name": recipe.name, **recipe.record()}


def steps(recipe: Recipe, auto_mask: bool = False) -> int:
    """Number of stages that the chain calls for a tile, for a progress bar."""
    detrend = recipe.detrend
    optional = (detrend.images, detrend.normals, detrend.height)
    calibrates = _calibrates(recipe)
    aligns = recipe.calibration is not None and recipe.calibration.align
    beside = 2 + aligns if calibrates else recipe.passes > 1
    return 7 + auto_mask + sum(part is not None for part in optional) + beside


def _calibrates(recipe: Recipe) -> bool:
    """Test whether there is what a calibration needs: near lamps, and a photographed flat."""
    images = recipe.detrend.images
    return recipe.calibration is not None and images is not None and "flats" in images.needs
