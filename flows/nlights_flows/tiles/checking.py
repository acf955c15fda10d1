"""Checking a tile before it is digitised: every photograph read once, nothing written."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nlights_core.agreement.file_headers import header_warnings
from nlights_core.agreement.number_ranges import range_warnings
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.errors import NlightsError
from nlights_core.fields import LightField
from nlights_core.photographs.development import Exposure, bands_of_grid, darkroom
from nlights_core.recipe import Recipe
from nlights_flows.tiles.running import require_memory


@dataclass
class Finding:
    """Findings of a check about a tile.

    Attributes
    ----------
    tile : str
    size : str
        Size and depth of the photographs.
    exposures : dict
        By lamp, for the frames.
    warnings : list of CaptureWarning
        What is allowed but seldom meant.
    problems : list of str
        Sentences; empty when the tile can be digitised.
    """

    tile: str
    size: str = ""
    exposures: dict[str, Exposure] = field(default_factory=dict)
    warnings: list[CaptureWarning] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def check_tiles(tiles: Sequence[Tile], recipe: Recipe, progress: Callable[[float], None]) -> list[Finding]:
    """Check tile after tile; see `check_tile`."""
    findings = []
    for i, tile in enumerate(tiles):

        def share(part: float, i: int = i) -> None:
            progress((i + part) / len(tiles))

        findings.append(check_tile(tile, recipe, share))
    return findings


def check_tile(tile: Tile, recipe: Recipe, progress: Callable[[float], None]) -> Finding:
    """Read every photograph of a tile and see whether a recipe can use it.

    Parameters
    ----------
    tile, recipe : Tile, Recipe
        What would be digitised, and how.
    progress : callable
        Told the share done.

    Returns
    -------
    Finding
    """
    finding = Finding(tile.name)
    finding.problems += recipe.lacking(tile)
    with suppress(NlightsError, OSError):  # of a file that cannot be read, a problem tells
        finding.warnings += header_warnings(tile)
    sets = [False, True] if tile.flats else [False]
    for i, flats in enumerate(sets):

        def share(part: float, i: int = i) -> None:
            progress((i + part) / len(sets))

        try:
            _read(tile, recipe, flats, finding, share)
        except (NlightsError, OSError) as fault:
            if str(fault) not in finding.problems:
                finding.problems.append(str(fault))
    return finding


def _read(
    tile: Tile, recipe: Recipe, flats: bool, finding: Finding, progress: Callable[[float], None]
) -> None:
    lamps = tile.lamps
    neutral = LightField(lamps, directions=np.tile([0.0, 0.0, 1.0], (len(lamps), 1)))
    with tempfile.TemporaryDirectory() as scratch, darkroom(tile, Path(scratch), flats=flats) as room:
        info, grid = room.info, room.grid
        finding.size = f"{info.columns} x {info.rows} px, {info.channels} x {info.dtype}"
        for start, stop in bands_of_grid(grid, len(lamps) * info.channels * 8):
            room.raw(start, stop, neutral)
            progress(stop / grid.rows)
        finding.warnings += range_warnings(room)
        if not flats:
            finding.exposures = room.exposures
            require_memory(tile, recipe)
        room.check()
