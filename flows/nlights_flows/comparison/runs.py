"""Running variants: every recipe on every tile, over one store, and what each stage cost."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.recipe import Recipe
from nlights_core.store import RECORD, ArtefactRef, Store, Work
from nlights_flows.comparison.variants import folder_of
from nlights_flows.tiles import isolation
from nlights_flows.tiles.preparing import require_named
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Ensure, Outcome, attempt


@dataclass(frozen=True)
class Case:
    """A tile to compare on.

    Attributes
    ----------
    tile : Tile
    truth : Path or None
        Folder with its true normals.tif and height.tif.
    """

    tile: Tile
    truth: Path | None

    @property
    def name(self) -> str:
        """The tile's name, with its artwork's."""
        return f"{self.tile.artwork}/{self.tile.name}"


@dataclass(frozen=True)
class Made:
    """One stage of a variant on a tile.

    Attributes
    ----------
    ref : ArtefactRef
    origin : {"made", "shared", "kept"}
        Made for this variant; made for an earlier variant of this comparison; in the store before.
    seconds : float
        What it took when it was made, as the store remembers.
    peak_bytes : int or None
        Most resident memory while it was made; None where that was not in this comparison, or in a
        child process.
    """

    ref: ArtefactRef
    origin: str
    seconds: float
    peak_bytes: int | None


@dataclass(frozen=True)
class Run:
    """Outcome of a variant on a tile; ``stages`` are in the chain's order, as far as it came."""

    variant: str
    outcome: Outcome
    stages: tuple[Made, ...]

    @property
    def case(self) -> str:
        """The `Case.name` it belongs to."""
        return f"{self.outcome.artwork}/{self.outcome.tile}"


def load_cases(
    artworks: Sequence[Path], *, stand: str | None, root: Path | None, names: Sequence[str] | None = None
) -> list[Case]:
    """Tiles of some captures, each with its truth where the capture has one.

    The truth is in ``truth/<tile>/`` beside the manifest, or in ``truth/`` where there is but one
    tile.

    Parameters
    ----------
    artworks : sequence of Path
        The captures' manifests.
    stand, root
        As for `nlights_core.manifest.load_capture`.
    names : sequence of str, optional
        Only the tiles that are called so, of all captures.

    Raises
    ------
    CaptureError
        When two captures have a tile of the same name, or none has one of ``names``.
    """
    cases: dict[str, Case] = {}
    for path in artworks:
        tiles = load_capture(path, stand=stand, root=root)
        folder = (path if path.is_dir() else path.parent) / "truth"
        for tile in tiles:
            places = [folder / tile.name] + ([folder] if len(tiles) == 1 else [])
            case = Case(tile, next(filter(_is_truth, places), None))
            if case.name in cases:
                raise CaptureError(
                    f"{path}: the tile '{case.name}' was given already; give each capture once, and captures of "
                    "their own ids"
                )
            cases[case.name] = case
    require_named((case.tile for case in cases.values()), names, ", ".join(map(str, artworks)))
    return [case for case in cases.values() if not names or case.tile.name in names]


def _is_truth(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("normals.tif", "height.tif"))


class Workshop:
    """Runs variants, and remembers what was made for which and what it cost.

    Parameters
    ----------
    options : RunOptions
        Products go to ``out/<variant>/<artwork>/<tile>/``; variants share what they have in common in the store.
    """

    def __init__(self, options: RunOptions) -> None:
        self.options, self.store = options, options.artefacts
        self.seconds = 0.0
        self._peaks: dict[str, int | None] = {}

    def run(self, case: Case, recipe: Recipe, ensure: Ensure) -> Run:
        """Run a variant on a tile; never raises for what concerns these two only."""
        made: list[Made] = []

        def noted(stage: Callable[..., Work], tile: Tile, *arguments: Any) -> tuple[ArtefactRef, bool]:
            here = not isolation.needs_child(arguments, self.options.timeout)
            measured = here and _forget_peak()
            ref, there = ensure(stage, tile, *arguments)
            origin = "shared" if ref.key in self._peaks else "kept" if there else "made"
            if origin == "made":
                self._peaks[ref.key] = _peak() if measured else None
            seconds = _seconds(self.store, ref)
            self.seconds += seconds if origin == "made" else 0.0
            made.append(Made(ref, origin, seconds, self._peaks.get(ref.key)))
            return ref, there

        own = replace(self.options, out=self.options.out / folder_of(recipe), store=self.store.root)
        outcome = attempt(case.tile, recipe, own, noted)
        return Run(recipe.name, outcome, tuple(made))


def _seconds(store: Store, ref: ArtefactRef) -> float:
    record = json.loads((store.path(ref) / RECORD).read_text(encoding="utf-8"))
    return float(record.get("seconds", 0.0))


def _forget_peak() -> bool:
    """Let the system count the peak of this process's memory anew; False where it cannot."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak() -> int | None:
    """Most resident memory of this process since `_forget_peak`, bytes."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    kib = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    return 1024 * int(kib[0]) if kib else None
