"""Digitising without Prefect: what the command line does alone, and Python."""

from __future__ import annotations

from pathlib import Path

from nlights_core.recipe import RecipeLike
from nlights_flows.tiles import console, dask_runner, preparing
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Outcome, run_directly


def digitise(
    artwork: str | Path, options: RunOptions, recipe: RecipeLike | None = None, *, shown: bool = True
) -> list[Outcome]:
    """Digitise the tiles of an artwork, in this process or on Dask's workers.

    Parameters
    ----------
    artwork : str or Path
        The manifest, or its folder.
    options : RunOptions
        How.
    recipe : RecipeLike, optional
        Instead of the options'.
    shown : bool
        Whether progress is told to the standard error.

    Returns
    -------
    list of Outcome
        Of every tile, in the order of the manifest.

    Raises
    ------
    NlightsError
        What the user has to mend; nothing was computed.
    """
    with options.in_force():
        chosen, tiles = preparing.prepare_run(artwork, options, recipe)
        preparing.make_folders(options)
        if options.runner == "dask":
            return dask_runner.run_everywhere(tiles, chosen, options)
        outcomes = []
        with console.TileProgress(chosen, tiles, shown) as watch:
            for tile in tiles:
                outcomes.append(run_directly(tile, chosen, options, watch))
                watch.tile_done(outcomes[-1])
        return outcomes
