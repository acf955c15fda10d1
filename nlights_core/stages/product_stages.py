"""Stages whose artefacts hold products; the others, and what a stage is, are in `nlights_core.stages`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.files.arrays import read_array
from nlights_core.files.tiffs import Compression
from nlights_core.machine.progress import Progress
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.products.writing import open_maps, white_reflectance, write_maps, write_meshes
from nlights_core.report.writing import write_report
from nlights_core.store import ArtefactRef, Store, Work, describe


def maps(
    store: Store,
    tile: Tile,
    normals: ArtefactRef,
    height: ArtefactRef,
    trend: ArtefactRef | None,
    integrated: ArtefactRef | None = None,
    perspective: bool = False,
    compression: Compression = "none",
) -> Work:
    """Products that are images: normals, albedo, reflection, height, confidence, trend.

    ``integrated`` is the height of these normals before anything was done to it, where they shall
    be made integrable with it, and ``perspective`` says whether its integrator followed the rays
    of the camera.  ``compression`` is that of the TIFFs, "none" or "zstd".
    """
    inputs = {"normals": normals, "height": height, "trend": trend, "integrated": integrated}
    facts: dict[str, Any] = {"perspective": perspective}
    if compression != "none":
        facts["compression"] = compression
    ref, record = describe("maps", tile.artwork, tile.name, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        write_maps(
            folder,
            open_maps(store, normals, height, trend),
            grid_of(tile, survey(tile)),
            coloured=store.path(normals),
            absolute=white_reflectance(store, normals) is not None,
            progress=progress,
            integrated=read_array(store.path(integrated) / "height.npy") if integrated else None,
            perspective=perspective,
            compression=compression,
        )

    return Work(ref, record, make)


def mesh(store: Store, tile: Tile, maps: ArtefactRef, height: ArtefactRef) -> Work:
    """Products that are meshes: a vertex per pixel, and a decimated one."""
    ref, record = describe("mesh", tile.artwork, tile.name, inputs={"maps": maps, "height": height})

    def make(folder: Path, progress: Progress) -> None:
        grid = grid_of(tile, survey(tile))
        surface = read_array(store.path(height) / "height.npy")
        write_meshes(folder, surface, store.path(maps), grid, progress)

    return Work(ref, record, make)


def report(
    store: Store,
    tile: Tile,
    recipe: dict[str, Any],
    lights: ArtefactRef,
    plate: ArtefactRef | None,
    bias: ArtefactRef | None,
    normals: ArtefactRef,
    height: ArtefactRef,
    trend: ArtefactRef | None,
    maps: ArtefactRef,
    mesh: ArtefactRef,
) -> Work:
    """Products for people: ``report.html``, ``quality.json``, ``provenance.json``."""
    inputs = {
        "lights": lights,
        "plate": plate,
        "bias": bias,
        "normals": normals,
        "height": height,
        "trend": trend,
        "maps": maps,
        "mesh": mesh,
    }
    facts = {
        "recipe": recipe,
        "title": tile.title,
        "origin_mm": tile.origin_mm,
        "stand": tile.stand.model_dump(mode="json") if tile.stand else None,
    }
    ref, record = describe("report", tile.artwork, tile.name, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        write_report(folder, store, tile, record, inputs, grid_of(tile, survey(tile)))

    return Work(ref, record, make)
