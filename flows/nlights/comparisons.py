"""Comparisons: several recipes over the same captures, answered with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from nlights.calling import in_python, run_options, told_in_python
from nlights_core.errors import TileError
from nlights_core.files.tiffs import Compression
from nlights_core.recipe import RecipeLike
from nlights_flows.comparison.order import Order, run_comparison, run_directly
from nlights_flows.comparison.page import overall


@dataclass(frozen=True)
class ComparisonResult:
    """Findings of a comparison.

    Attributes
    ----------
    record : dict
        What ``compare.json`` holds.
    page : Path
        ``compare.html``, for people.
    """

    record: dict[str, Any]
    page: Path

    @property
    def sentence(self) -> str:
        """The answer: who wins against the truth, or that there is none."""
        return overall(self.record["metrics"])

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """Metrics by key, as "angle_error": title, unit, winners, and each variant's value, interval and rank."""
        return {metric["key"]: metric for metric in self.record["metrics"]}

    @property
    def failures(self) -> list[str]:
        """Variants that failed, on which tile, and why."""
        failed = [run for run in self.record["runs"] if run["state"] == "failed"]
        return [f"{run['variant']}: {run['tile']}: {in_python(run['message'])}" for run in failed]

    def _repr_html_(self) -> str:
        from nlights.notebook import comparison_html

        return comparison_html(self)


def compare(
    artworks: str | Path | Sequence[str | Path],
    *,
    recipes: Sequence[RecipeLike] = (),
    grid: Sequence[str] = (),
    recipe: RecipeLike = "default",
    out: str | Path = "comparison",
    store: str | Path | None = None,
    stand: str | Path | None = None,
    root: str | Path | None = None,
    tiles: str | Sequence[str] | None = None,
    compression: Compression = "none",
    memory: str | None = None,
    timeout: float | None = None,
    progress: bool = True,
) -> ComparisonResult:
    """Compare recipes on the same photographs, as ``nlights compare`` does.

    Parameters
    ----------
    artworks : str, Path, or sequence of them
        Manifests of captures, or the folders that hold them.
    recipes : sequence of str, Path, mapping or Recipe
        To be compared; mappings need a ``name`` each.
    grid : sequence of str
        ``"field=value,value"``: every combination becomes a variant of ``recipe``.
    recipe : str, Path, mapping or Recipe
        What ``grid`` varies.
    out : str or Path
        Folder of the page and of the variants' products.
    store, stand, root, tiles, compression, memory, timeout, progress
        As for `nlights.digitise`.

    Returns
    -------
    ComparisonResult
        Variants that failed somewhere are among its ``failures``.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What is to be mended first; nothing was computed.
    TileError
        When no two variants can be compared on any tile, naming what failed.
    """
    options = run_options(locals())
    captures = [artworks] if isinstance(artworks, str | Path) else artworks
    order = Order([Path(path) for path in captures], recipes, grid, options, recipe)
    with told_in_python():
        found = ComparisonResult(
            run_comparison(order, partial(run_directly, shown=progress)), options.out / "compare.html"
        )
    if len(found.record["compared"]) < 2 or not any(tile["compared"] for tile in found.record["tiles"]):
        raise TileError("\n".join([*found.failures, *found.record["notes"]]))
    return found
