"""Checking a tile before it is digitised: every photograph read once, the chain's own refusals, nothing kept."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.agreement.examination import examine_photographs
from nlights_core.capture import Encoding, Tile
from nlights_core.capture_warnings import CaptureWarning, read_warnings
from nlights_core.errors import NlightsError, TileError
from nlights_core.fields import LightField
from nlights_core.integration.known_heights import read_known_heights
from nlights_core.photographs.development import Darkroom, bands_of_grid, darkroom
from nlights_core.photographs.exposures import Exposure
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.images import Photograph, probe
from nlights_core.photographs.masks import mask_size
from nlights_core.recipe import Recipe
from nlights_core.reduced_light.borders import read_proposal
from nlights_core.store import ArtefactRef, Store, Work
from nlights_flows.tiles import isolation
from nlights_flows.tiles.chain import digitise_tile
from nlights_flows.tiles.explaining import explain_fault
from nlights_flows.tiles.running import require_memory

MADE = ("lights", "flat_field", "mask", "agreement")
"""Stages that a check really makes: they say whether the lamps are known, the flats can be used and the photographs
agree, and cost little.
All others are named only, which reads what their names are made of: the digests of the photographs."""

NOT_MADE = "0" * 64
"""Key that stands for an artefact which could not even be named."""

ROWS = 256
"""Of a photograph, that are read at a time where it is read alone."""


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
        What the photographs show that nobody meant.
    proposal : str
        What seems to be no part of the artwork, in a sentence; empty where nothing does.
    problems : list of str
        Sentences, each once; empty when the tile can be digitised.
    """

    tile: str
    size: str = ""
    exposures: dict[str, Exposure] = field(default_factory=dict)
    warnings: list[CaptureWarning] = field(default_factory=list)
    proposal: str = ""
    problems: list[str] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Plain values, as `nlights check --json` prints them."""
        return {
            "tile": self.tile,
            "problems": self.problems,
            "warnings": [warning.record() for warning in self.warnings],
            "proposal": self.proposal,
        }


def of_the_whole(fault: NlightsError) -> Finding:
    """Make a finding of a fault that stops every tile: of the manifest, the recipe or the stand's file.

    Its tile is called "", which no tile can be.
    """
    return Finding(
        "", problems=re.split(r"\n(?! )", str(fault))
    )  # what is indented belongs to the line before


def check_tiles(tiles: Sequence[Tile], recipe: Recipe, progress: Callable[[float], None]) -> list[Finding]:
    """Check tile after tile; see `check_tile`."""
    findings = []
    for i, tile in enumerate(tiles):

        def share(part: float, i: int = i) -> None:
            progress((i + part) / len(tiles))

        findings.append(check_tile(tile, recipe, share))
    return findings


def check_tile(tile: Tile, recipe: Recipe, progress: Callable[[float], None]) -> Finding:
    """Read every photograph of a tile, and let the chain say what it would refuse.

    Each question is asked by itself, so that one problem does not hide another.

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
    lacking = recipe.lacking(tile)
    finding.problems += lacking
    with tempfile.TemporaryDirectory(prefix="nlights-check-") as scratch:
        store = Store(Path(scratch))
        fit = _headers_fit(tile, recipe, store, finding)
        flats = bool(tile.flats) and recipe.needs("flats")
        if fit:
            for i, which in enumerate((False, True) if flats else (False,)):

                def share(part: float, i: int = i) -> None:
                    progress(0.9 * (i + part) / (1 + flats))

                _read(tile, which, store, finding, share)
        if tile.known_heights and recipe.needs("known_heights"):
            _answered(finding, store, partial(read_known_heights, tile.known_heights))
        made = {} if lacking else _ask_chain(tile, recipe, store, finding, MADE if fit else ("lights",))
        _warn(tile, fit, flats, store, made, finding)
        progress(1.0)
    return finding


def _warn(
    tile: Tile, fit: bool, flats: bool, store: Store, made: dict[str, ArtefactRef], finding: Finding
) -> None:
    """Take down the warnings of the stages that were made, those of the photographs first."""
    if not fit:
        finding.warnings += tile.warnings
    elif "agreement" not in made:  # the lamps are not known: what can be said without is

        def examined() -> None:
            with store.scratch() as place:
                finding.warnings += examine_photographs(tile, None, flats, place)

        _answered(finding, store, examined)
    if "agreement" in made:
        finding.proposal = read_proposal(store.path(made["agreement"]))
    for stage in sorted(made):  # agreement before all others
        finding.warnings += read_warnings(store.path(made[stage]))


def _answered(finding: Finding, store: Store, ask: Callable[[], object]) -> bool:
    """Ask, and take down a fault as a problem, each sentence once; tells whether there was none."""
    try:
        ask()
    except (Exception, SystemExit) as fault:  # a plugin may even call sys.exit
        sentence = explain_fault(fault, store)
        if sentence not in finding.problems:
            finding.problems.append(sentence)
        return False
    return True


def _headers_fit(tile: Tile, recipe: Recipe, store: Store, finding: Finding) -> bool:
    """Read the headers; tells whether the photographs can be read together."""
    files = [(path, tile.encoding) for path in (*tile.frames.values(), *(tile.flats or {}).values())]
    files += [(tile.dark, tile.encoding)] if tile.dark else []
    # One by one first: a survey ends at the first that it cannot read.
    asked = [_answered(finding, store, partial(_look_into, store, *file)) for file in dict.fromkeys(files)]
    if tile.mask:
        asked.append(_answered(finding, store, partial(mask_size, tile.mask)))
    if not all(asked) or not _answered(finding, store, partial(survey, tile)):
        return False
    info = survey(tile)
    finding.size = f"{info.columns} x {info.rows} px, {info.channels} x {info.dtype}"
    _answered(finding, store, partial(require_memory, tile, recipe))
    return _answered(finding, store, partial(grid_of, tile, info))


def _look_into(store: Store, path: Path, encoding: Encoding) -> None:
    if path.exists():
        probe(path, encoding)
    else:
        store.digest(path)  # which is what ends a tile that lacks a file, in its own words


def _read(tile: Tile, flats: bool, store: Store, finding: Finding, progress: Callable[[float], None]) -> None:
    """Read all frames, or all flats, together as a stage does; where that fails, one by one."""
    faults: list[TileError] = []

    def together() -> None:
        with store.scratch() as scratch, darkroom(tile, scratch, flats=flats) as room:
            _read_together(room, progress)
            if not flats:
                finding.exposures = room.exposures
            faults.extend(room.faults())

    if not _answered(finding, store, together):  # the first bad one hides the others
        paths = (tile.flats or {}) if flats else tile.frames
        for path in (*paths.values(), *([tile.dark] if tile.dark else [])):
            _answered(finding, store, partial(_read_alone, tile, path, store))
    for fault in faults:
        if str(fault) not in finding.problems:
            finding.problems.append(str(fault))


def _read_together(room: Darkroom, progress: Callable[[float], None]) -> None:
    lamps = tuple(room.photographs)
    neutral = LightField(lamps, directions=np.tile([0.0, 0.0, 1.0], (len(lamps), 1)))
    for start, stop in bands_of_grid(room.grid, len(lamps) * room.info.channels * 8):
        room.raw(start, stop, neutral)
        progress(stop / room.grid.rows)


def _read_alone(tile: Tile, path: Path, store: Store) -> None:
    with store.scratch() as scratch, Photograph(path, tile.encoding, scratch) as photograph:
        rows = photograph.info.rows
        for start in range(0, rows, ROWS):
            photograph.band(start, min(start + ROWS, rows))


def _ask_chain(
    tile: Tile, recipe: Recipe, store: Store, finding: Finding, made: Sequence[str]
) -> dict[str, ArtefactRef]:
    """Go through the chain as `nlights digitise` does, past every fault; only these stages are ``made``.

    Returns what was made, by stage.
    """
    there: dict[str, ArtefactRef] = {}

    def call(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> ArtefactRef:
        ref = ArtefactRef(stage.__name__, tile.artwork, tile.name, NOT_MADE)

        def named() -> None:
            nonlocal ref
            work = stage(store, tile, *arguments)
            ref = work.ref
            inputs = [argument for argument in arguments if isinstance(argument, ArtefactRef)]
            masked = tile.mask is None or not tile.auto_mask or (store.root / tile.mask).exists()
            if stage.__name__ in made and masked and all(store.has(one) for one in inputs):
                isolation.ensure(store, work, tile, arguments)
                there[ref.stage] = ref

        _answered(finding, store, named)
        return ref

    digitise_tile(tile, recipe, call)
    return there
