"""Comparing: what variants made of the same tiles, measured, analysed, and put on record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nlights_core import __version__
from nlights_core.errors import NlightsError
from nlights_core.frames import PixelGrid
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.recipe import Recipe
from nlights_core.store import Store
from nlights_flows.comparison import statistics as statistics
from nlights_flows.comparison.metrics import (
    DESCRIBED,
    METRICS,
    Metric,
    TileMeasures,
    measure,
    summary,
    unit_of,
)
from nlights_flows.comparison.runs import Case, Run
from nlights_flows.comparison.variants import folder_of


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found.

    Attributes
    ----------
    record : dict
        What ``compare.json`` holds.
    cases : list of (Case, PixelGrid)
        The tiles on which variants were compared.
    runs : dict
        By variant and `Case.name`, the runs that made something.
    """

    record: dict[str, Any]
    cases: list[tuple[Case, PixelGrid]]
    runs: dict[tuple[str, str], Run]


def compare_runs(
    recipes: Sequence[Recipe], cases: Sequence[Case], runs: Sequence[Run], store: Store
) -> Comparison:
    """Measure and analyse what the runs have made.

    Parameters
    ----------
    recipes : sequence of Recipe
        The variants.
    cases : sequence of Case
        The tiles.
    runs : sequence of Run
        Of every variant on every tile.
    store : Store
        Of their artefacts.

    Returns
    -------
    Comparison
    """
    done = {(run.variant, run.case): run for run in runs if run.outcome.folder is not None}
    names, common, notes = _compared([recipe.name for recipe in recipes], cases, done)
    measured: dict[str, TileMeasures] = {}
    placed: list[tuple[Case, PixelGrid]] = []
    for case in common:
        try:
            grid = grid_of(case.tile, survey(case.tile))
            measures = _measured(case, [done[name, case.name] for name in names], grid, store)
        except (NlightsError, OSError, ValueError) as fault:
            notes.append(f"{case.name}: could not be measured: {fault}")
            continue
        measured[case.name] = measures
        placed.append((case, grid))
        if not measures.pixels:
            notes.append(f"{case.name}: no pixel is known to all variants, so its maps were not compared")
        elif case.truth is not None and "angle_error" not in measures.values:
            notes.append(f"{case.name}: {case.truth} is of another size than the maps; it was not used")
    units = [grid.unit for _, grid in placed]
    record = {
        "nlights": __version__,
        "confidence": statistics.CONFIDENCE,
        "draws": statistics.DRAWS,
        "seed": statistics.SEED,
        "variants": [
            {"name": r.name, "folder": folder_of(r), "compared": r.name in names, "recipe": r.record()}
            for r in recipes
        ],
        "compared": names,
        "metrics": [analyse_metric(metric, names, measured, units) for metric in METRICS],
        "described": [
            {
                "key": key,
                "title": title,
                "unit": _unit(unit, units),
                "values": dict(zip(names, summary(measured, key, len(names)), strict=True)),
            }
            for key, (title, unit) in DESCRIBED.items()
        ],
        "tiles": [
            _tile(
                case, measured.get(case.name), names, dict(zip(measured, units, strict=True)).get(case.name)
            )
            for case in cases
        ],
        "runs": [_run(run) for run in runs],
        "notes": notes,
    }
    return Comparison(record, placed, done)


def _compared(
    names: list[str], cases: Sequence[Case], done: Mapping[tuple[str, str], Run]
) -> tuple[list[str], list[Case], list[str]]:
    """Variants and tiles such that every variant has every tile, and what was left out."""
    tiles = {name: sum((name, case.name) in done for case in cases) for name in names}
    most = max(tiles.values(), default=0)
    # A variant that fails nearly everywhere shall not cost the others their tiles.
    kept = [name for name in names if most and 2 * tiles[name] >= most]
    notes = [
        f"{name}: has {tiles[name]} of {len(cases)} tiles and is not compared"
        for name in names
        if name not in kept
    ]
    common = [case for case in cases if kept and all((name, case.name) in done for name in kept)]
    lost = [case.name for case in cases if case not in common]
    if lost:
        notes.append(f"left out of the comparison, because a variant failed there: {', '.join(lost)}")
    return kept, common, notes


def _measured(case: Case, runs: Sequence[Run], grid: PixelGrid, store: Store) -> TileMeasures:
    folders = [run.outcome.folder for run in runs if run.outcome.folder is not None]
    normals = [store.path(next(m.ref for m in run.stages if m.ref.stage == "normals")) for run in runs]
    found = measure(folders, normals, case.truth, grid)
    found.values["seconds"] = [sum(made.seconds for made in run.stages) for run in runs]
    found.values["peak_memory"] = [_peak_of(run) for run in runs]
    return found


def _peak_of(run: Run) -> float | None:
    """Peak memory of a run's stages, MiB; None unless every one was made in this comparison."""
    peaks = [made.peak_bytes for made in run.stages]
    return None if None in peaks else max(peak for peak in peaks if peak is not None) / (1 << 20)


def _unit(unit: str, grid_units: Sequence[str]) -> str:
    return unit_of(Metric("", "", unit, ""), grid_units)


def analyse_metric(
    metric: Metric, names: Sequence[str], measured: Mapping[str, TileMeasures], units: Sequence[str]
) -> dict[str, Any]:
    """Analyse one metric over all tiles.

    Parameters
    ----------
    metric : Metric
    names : sequence of str
        The variants.
    measured : mapping
        By tile.
    units : sequence of {"mm", "px"}
        Of the tiles' lengths.

    Returns
    -------
    dict
        Plain values for ``compare.json``.  A variant without the number on any of the tiles is
        "not measured" and takes no part.
    """
    record: dict[str, Any] = {
        **asdict(metric),
        "unit": unit_of(metric, units),
        "over": None,
        "winners": [],
        "variants": [],
    }
    tiles = [one for one in measured.values() if metric.key in one.places]
    known = [k for k in range(len(names)) if tiles and all(_has(one, metric.key, k) for one in tiles)]
    if len(set(units)) > 1 and metric.unit in ("mm", "µm"):
        known = []  # lengths of tiles with and without a scale are not of one kind
    tiles = [one for one in tiles if np.isfinite(one.places[metric.key][..., known]).all(axis=-1).any()]
    if known and tiles:
        analysis = statistics.analyse(_sample(metric, tiles, known))
        record["over"] = {"kind": analysis.kind, "places": analysis.places, "tiles": len(tiles)}
        record["winners"] = [names[known[i]] for i in analysis.winners]
    for k, name in enumerate(names):
        row: dict[str, Any] = {"name": name, "value": None, "interval": None, "rank": None}
        if k in known and tiles:
            i = known.index(k)
            row |= {
                "value": analysis.values[i],
                "interval": analysis.intervals[i],
                "rank": analysis.ranks[i] if analysis.ranks else None,
                "to_best": asdict(analysis.differences[i][analysis.best]),
                "to_first": asdict(analysis.differences[i][known.index(0)]) if 0 in known else None,
                "best": i == analysis.best,
            }
        record["variants"].append(row)
    return record


def _has(one: TileMeasures, key: str, k: int) -> bool:
    """Test whether a variant has a metric somewhere on a tile."""
    return bool(np.isfinite(one.places[key][..., k]).any())


def _sample(metric: Metric, tiles: Sequence[TileMeasures], known: Sequence[int]) -> statistics.Sample:
    """The places over which a metric is analysed: tiles where there are enough, else parts of them."""
    places = [one.places[metric.key][..., known] for one in tiles]
    weights = [one.weights[metric.key] for one in tiles]
    if len(tiles) >= statistics.FEWEST:
        whole = [_mean(place, weight) for place, weight in zip(places, weights, strict=True)]
        counts = np.array([[[max(one.pixels, 1)]] for one in tiles], float)
        return statistics.Sample(np.stack([[[row]] for row in whole]), counts, metric.root, "tiles")
    if metric.key == "held_out":
        lamps = np.concatenate(places)[:, None]
        return statistics.Sample(lamps, np.ones(lamps.shape[:3]), metric.root, "lamps")
    rows, columns = (max(place.shape[i] for place in places) for i in (0, 1))
    values = np.full((len(tiles), rows, columns, len(known)), np.nan)
    counted = np.zeros(values.shape[:3])
    for i, (place, weight) in enumerate(zip(places, weights, strict=True)):
        values[i, : place.shape[0], : place.shape[1]] = place
        counted[i, : place.shape[0], : place.shape[1]] = weight
    return statistics.Sample(values, counted, metric.root, "blocks")


def _mean(place: Any, weight: Any) -> Any:
    """Weighted mean over the places of a tile that every variant knows, (K,)."""
    known = np.isfinite(place).all(axis=-1) & (weight > 0)
    return weight[known] @ place[known] / weight[known].sum()


def _tile(case: Case, found: TileMeasures | None, names: Sequence[str], unit: str | None) -> dict[str, Any]:
    record: dict[str, Any] = {
        "name": case.name,
        "title": case.tile.title,
        "truth": case.truth is not None,
        "compared": found is not None,
    }
    if found is None:
        return record
    return {
        **record,
        "unit": unit,
        "pixels": found.pixels,
        "share": found.share,
        "values": {key: dict(zip(names, row, strict=True)) for key, row in found.values.items()},
        "differences_from_first": dict(zip(names, found.differences, strict=False)),
    }


def _run(run: Run) -> dict[str, Any]:
    return {
        "variant": run.variant,
        "tile": run.case,
        "state": run.outcome.state,
        "message": run.outcome.message,
        "seconds": round(run.outcome.seconds, 3),
        "stages": [
            {
                "stage": made.ref.stage,
                "key": made.ref.key,
                "origin": made.origin,
                "seconds": made.seconds,
                "peak_bytes": made.peak_bytes,
            }
            for made in run.stages
        ],
    }
