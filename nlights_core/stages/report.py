"""The stage that writes what people read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.machine.progress import Progress
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.report.writing import write_report
from nlights_core.stages.inputs import with_mask
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = (
    "calibration",
    "capture_warnings",
    "integration",
    "lamps",
    "movement",
    "near_light",
    "photographs",
    "products",
    "reduced_light",
    "report",
    "solving",
)
"""Departments whose code decides the result, beside what all results rest on."""


def report(
    store: Store,
    tile: Tile,
    recipe: dict[str, Any],
    lights: ArtefactRef,
    flat_field: ArtefactRef | None,
    agreement: ArtefactRef,
    bias: ArtefactRef | None,
    normals: ArtefactRef,
    height: ArtefactRef,
    trend: ArtefactRef | None,
    maps: ArtefactRef,
    mesh: ArtefactRef,
    calibration: ArtefactRef | None = None,
    alignment: ArtefactRef | None = None,
) -> Work:
    """Products for people: ``report.html``, ``quality.json``, ``warnings.json``, ``provenance.json``."""
    tile = with_mask(store, tile)
    inputs = {
        "lights": lights,
        "flat_field": flat_field,
        "agreement": agreement,
        "bias": bias,
        "normals": normals,
        "height": height,
        "trend": trend,
        "maps": maps,
        "mesh": mesh,
        "calibration": calibration,
    }
    if alignment:
        inputs["alignment"] = alignment
    facts = {
        "recipe": recipe,
        "title": tile.title,
        "origin_mm": tile.origin_mm,
        "stand": tile.stand.model_dump(mode="json") if tile.stand else None,
    }
    ref, record = describe("report", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        write_report(folder, store, tile, record, inputs, grid_of(tile, survey(tile)))

    return Work(ref, record, make)
