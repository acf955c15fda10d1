"""Output of the command line: progress bars and tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from nlights_core.capture import Tile
from nlights_core.capture_warnings import read_warnings
from nlights_core.errors import CaptureError, NlightsError
from nlights_core.machine import compilation
from nlights_core.machine.compilation import Compilation
from nlights_core.machine.progress import noting
from nlights_core.names.control_characters import escape_controls
from nlights_core.recipe import Recipe
from nlights_core.registry import Registry
from nlights_core.report.figures import NOT_MEASURED
from nlights_flows.tiles.chain import steps
from nlights_flows.tiles.checking import Finding
from nlights_flows.tiles.planning import Step
from nlights_flows.tiles.records import read_quality
from nlights_flows.tiles.running import Outcome
from nlights_flows.tiles.streams import complain as complain
from nlights_flows.tiles.streams import say as say
from nlights_flows.tiles.streams import say_json as say_json

COMPILING = "compiling loops, once per machine"


class _Console(Console):
    """Console that shows control characters as what they are; a name is no markup and no picture."""

    def __init__(self, **options: Any) -> None:
        super().__init__(highlight=False, emoji=False, markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(escape_controls(text), **options)


console = _Console(soft_wrap=False)


def _columns() -> tuple[Any, ...]:
    return (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )


def _bars() -> Progress:
    """Progress bars on the standard error."""
    return Progress(*_columns(), console=_Console(stderr=True), transient=True)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], None]]:
    """Show one long step; yields a function to tell the share done."""
    with _bars() as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda share: progress.update(task, completed=share)


@contextmanager
def compiling_bar() -> Iterator[Callable[[float, int], None]]:
    """Show how far compiling is; yields a function to tell the share done and how many loops were compiled."""
    with _bars() as progress:
        task = progress.add_task("compiling loops, once per machine", total=1.0)

        def tell(share: float, count: int) -> None:
            progress.update(task, completed=share, description=f"{COMPILING}: {count}")

        yield tell


def _has_bars(console: Console) -> bool:
    """Test whether bars can be drawn: on a terminal, and in a notebook that has what rich draws them with."""
    return sys.stderr.isatty() or (console.is_jupyter and find_spec("ipywidgets") is not None)


class TileProgress:
    """Progress over tiles and their stages: bars on a terminal or in a notebook, one line per stage elsewhere.

    ``shown`` as false: nothing at all.
    """

    def __init__(self, recipe: Recipe, tiles: Sequence[Tile], shown: bool = True) -> None:
        self._steps, self._tiles = steps(recipe, any(tile.auto_mask for tile in tiles)), len(tiles)
        self._progress = _bars()
        self._live = shown and _has_bars(self._progress.console)
        self._lines = shown and not self._live
        self._all = self._progress.add_task(f"tile 1 of {self._tiles}", total=self._steps * self._tiles)
        self._stage = self._progress.add_task("", total=1.0)
        self._compiling: TaskID | None = None
        self._lost = False
        self._done, self._started, self._ended = 0.0, 0.0, 0
        self._listening = ExitStack()

    def __enter__(self) -> TileProgress:
        if self._live:
            self._progress.start()
        self._listening.enter_context(compilation.call_on_compiling(self._compiles))
        self._listening.enter_context(noting(self._notes))
        return self

    def _notes(self, sentence: str) -> None:
        """Say what a stage says of itself."""
        if self._live:
            self._progress.console.print(sentence, markup=False, highlight=False)
        elif self._lines:
            complain(sentence)

    def _compiles(self, so_far: Compilation) -> None:
        """Say why the first painting takes longer, and once that the second will too."""
        if self._compiling is None:
            self._compiling = self._progress.add_task(COMPILING, total=None)
            if self._lines:
                complain(f"{COMPILING} (`nlights doctor --warm` does it beforehand)")
        self._progress.update(self._compiling, description=f"{COMPILING}: {len(so_far.names)}")
        if so_far.lost and not self._lost:
            self._lost = True
            complain(f"{so_far.lost}: cannot be written, so the loops are compiled again the next time")

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listening.close()
        if self._lines and self._compiling is not None:
            complain(f"compiled {len(compilation.so_far().names)} loops")
        if self._live:
            self._progress.stop()

    def __call__(self, tile: str, stage: str, share: float) -> None:
        """Take in how far a stage of a tile is."""
        if share == 0.0:
            self._started = time.monotonic()
        if share == 1.0:
            self._done += 1
            if self._lines:
                complain(f"{tile}: {stage}: {time.monotonic() - self._started:.1f} s")
        self._progress.update(self._stage, description=escape_controls(f"{tile}: {stage}"), completed=share)
        self._progress.update(self._all, completed=self._done + (share if share < 1 else 0))

    def tile_done(self, outcome: Outcome) -> None:
        """Go on to the next tile."""
        self._ended += 1
        self._done = float(self._steps * self._ended)
        number = min(self._ended + 1, self._tiles)
        self._progress.update(self._all, description=f"tile {number} of {self._tiles}", completed=self._done)


def show_outcomes(outcomes: Sequence[Outcome]) -> None:
    """Print where the products are, and every failure with its remedy."""
    for outcome in outcomes:
        name = f"{outcome.artwork}/{outcome.tile}"
        if outcome.state == "failed":
            complain(f"{name}: failed: {outcome.message}")
        else:
            said = "unchanged" if outcome.state == "unchanged" else f"done in {outcome.seconds:.1f} s"
            say(f"{name}: {said}: {outcome.folder}/report.html")
            for note in outcome.notes:
                complain(f"{name}: note: {note}")
            for warning in warnings_of(outcome):
                complain(f"{name}: warning: {warning}")
    failed = sum(outcome.state == "failed" for outcome in outcomes)
    if failed:
        complain(f"{len(outcomes) - failed} of {len(outcomes)} tiles done, {failed} failed")


def warnings_of(outcome: Outcome) -> list[str]:
    """Warnings about a tile's capture, as sentences."""
    try:
        return [warning.sentence for warning in read_warnings(outcome.folder)] if outcome.folder else []
    except NlightsError as fault:
        return [str(fault)]


def show_facts(facts: Sequence[tuple[str, str]]) -> None:
    """Print facts below each other."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, fact in facts:
        table.add_row(name, fact)
    _wide().print(table)


def show_plan(tile: Tile, plan: Sequence[Step]) -> None:
    """Print the stages of a tile."""
    table = Table(title=f"{tile.artwork}/{tile.name}", title_justify="left", box=None, pad_edge=False)
    for heading in ("stage", "artefact", "", "why"):
        table.add_column(heading, no_wrap=heading != "why")
    for step in plan:
        table.add_row(step.ref.stage, step.ref.key[:12], "exists" if step.exists else "to be made", step.why)
    missing = sum(not step.exists for step in plan)
    _wide().print(table)
    say(f"{missing} of {len(plan)} stages to be made")


def show_findings(findings: Sequence[Finding]) -> None:
    """Print what a check found."""
    for finding in findings:
        table = Table(title=f"{finding.tile}: {finding.size}", title_justify="left", box=None, pad_edge=False)
        for heading in ("lamp", "mean, % of saturation", "saturated pixels, %"):
            table.add_column(heading, justify="left" if heading == "lamp" else "right")
        for lamp, exposure in finding.exposures.items():
            count = max(exposure.pixels, 1)
            table.add_row(
                lamp, f"{100 * exposure.total / count:.2f}", f"{100 * exposure.saturated / count:.3f}"
            )
        _wide().print(table)
        for warning in finding.warnings:
            lamps = f" ({', '.join(warning.lamps)})" if warning.lamps else ""
            complain(f"{finding.tile}: warning: {warning.code}{lamps}: {warning.sentence}")
        for problem in finding.problems:
            complain(f"{finding.tile}: {problem}")
        if finding.proposal:
            say(f"{finding.tile}: {finding.proposal}")
        say(f"{finding.tile}: {'cannot be digitised' if finding.problems else 'can be digitised'}")


def print_findings(findings: Sequence[Finding]) -> None:
    """Print what a check found as JSON, for programs."""
    say_json({"tiles": [finding.record() for finding in findings]})


def show_plugins(registry: Registry) -> None:
    """Print every algorithm with its slot, origin and first sentence, and every plugin that is broken."""
    table = Table(box=None, pad_edge=False)
    for heading in ("slot", "use", "from", "what it does"):
        table.add_column(heading, no_wrap=heading != "what it does")
    for offer in registry.offers():
        sentence = (offer.algorithm.__doc__ or "").strip().split("\n")[0]
        table.add_row(offer.algorithm.slot, offer.algorithm.name, offer.origin, sentence)
    for plugin in registry.broken:
        table.add_row("broken", "", plugin.origin, plugin.why)
    _wide().print(table)


def show_evaluation(result: Mapping[str, float | None]) -> None:
    """Print an evaluation, a number a line; None is not measured."""
    for name, value in result.items():
        say(f"{name}: {NOT_MEASURED if value is None else format(value, '.6g')}")


def show_numbers(folders: Sequence[Path]) -> int:
    """Print the quality numbers of tiles side by side.

    Returns
    -------
    int
        How many tiles are left out since their numbers are damaged; each is told.

    Raises
    ------
    CaptureError
        When a folder holds no products, or all are damaged.
    """
    from nlights_flows.tiles.inventory import product_folders

    found: list[Path] = []
    for folder in folders:
        here = list(product_folders(folder))
        if not here:
            raise CaptureError(f"{folder}: holds no products; give an output folder of digitise")
        found += here
    tiles, numbers = [], []
    for tile in found:
        try:
            numbers.append(read_quality(tile))
        except NlightsError as fault:
            complain(fault)
        else:
            tiles.append(tile)
    if not tiles:
        raise CaptureError("no numbers can be shown")
    table = Table(box=None, pad_edge=False)
    for heading in ("group", "number", "unit"):
        table.add_column(heading)
    for tile in tiles:
        table.add_column(f"{tile.parent.name}/{tile.name}", justify="right")
    names = dict.fromkeys((row["group"], row["name"], row["unit"]) for rows in numbers for row in rows)
    by_name = [{(row["group"], row["name"], row["unit"]): row for row in rows} for rows in numbers]
    for name in names:
        table.add_row(*name, *(_value(rows.get(name)) for rows in by_name))
    _wide().print(table)
    for tile in tiles:
        say(tile / "report.html")
    return len(found) - len(tiles)


def _value(row: dict[str, Any] | None) -> str:
    if row is None:
        return "not in this recipe"
    return row.get("missing", "not measured") if row["value"] is None else f"{row['value']:.4g}"


def show_table(table: Table) -> None:
    """Print a table."""
    _wide().print(table)


def _wide() -> Console:
    """A console that does not cut tables when its output goes to a file."""
    return console if console.is_terminal else _Console(width=160)
