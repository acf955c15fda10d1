"""Products: what leaves the system for a tile, written from its artefacts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core import __version__, export, meshes, quality
from nlights_core.agreement import read_agreement
from nlights_core.arrays import BandWriter, read_array
from nlights_core.capture import Tile
from nlights_core.emission import read_flat_check
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.figures import NOT_IN_RECIPE, NOT_MEASURED
from nlights_core.frames import Array, PixelGrid
from nlights_core.integrability import integrable_normals, integrable_uncertainty
from nlights_core.levelling import read_level
from nlights_core.map_statistics import sampled
from nlights_core.plates import read_plate
from nlights_core.position_uncertainty import position_uncertainty
from nlights_core.store import RECORD, ArtefactRef, Progress, Store

FRAME = "plane frame: x right, y up, z from the artwork to the camera; NaN where not known"

WHAT = {
    "normals.tif": "unit normals x, y, z in the plane frame, float32",
    "normals_opengl.png": "the normals as colours for viewing, 8 bit, OpenGL convention (+Y up)",
    "albedo.tif": "albedo, float32, linear; absolute with a white reference, else relative",
    "albedo_view.tif": "the albedo for viewing, 16 bit, sRGB",
    "reflection.tif": "reflection map: apparent colour (mean over the lamps) minus albedo, float32, linear, signed",
    "height.tif": "height towards the camera, float32",
    "confidence.tif": "standard uncertainty of each normal, degrees, float32",
    "trend.tif": "what detrending removed from the height, float32",
    "mesh.ply": "mesh with a vertex per pixel",
    "mesh.glb": "decimated mesh with the albedo as its texture, metres",
    "report.html": "pictures and numbers",
    "quality.json": "the numbers of the report",
    "provenance.json": "what made these files, in full",
}


def open_maps(
    store: Store, normals: ArtefactRef, height: ArtefactRef, trend: ArtefactRef | None
) -> dict[str, Array]:
    """Open the maps of a tile as memory maps, by name."""
    source = store.path(normals)
    names = (
        "normals",
        "albedo",
        "apparent",
        "confidence",
        "residual",
        "used",
        "saturated",
        "shadow",
        "frames",
    )
    maps = {name: read_array(source / f"{name}.npy") for name in names}
    maps["height"] = read_array(store.path(height) / "height.npy")
    if trend is not None:
        maps["trend"] = read_array(store.path(trend) / "trend.npy")
    return maps


def write_maps(
    folder: Path,
    maps: Mapping[str, Array],
    grid: PixelGrid,
    *,
    white: float | None,
    icc: bytes | None,
    progress: Progress,
    integrated: Array | None = None,
    perspective: bool = False,
) -> None:
    """Write every product that is an image.

    Parameters
    ----------
    folder : Path
        Where they go.
    maps : mapping
        Of `open_maps`.
    grid : PixelGrid
        Where the pixels are.
    white : float or None
        Albedo of the white plate, which makes the albedo absolute; None without a plate.
    icc : bytes or None
        Colour profile of the photographs, kept in the albedo and the reflection map.
    progress : callable
        Told the share done.
    integrated : (H, W) array, optional
        The height that was integrated from the normals, which then are made integrable.
    perspective : bool
        Whether that height was integrated along the rays of the camera.

    Raises
    ------
    TileError
        When not a single normal could be solved.
    OSError
        When the disk is full.
    """
    scale = np.float32(1.0 if white is None else white)
    said = (
        f"linear, 1 is a perfect diffuser (white reference of reflectance {white:g})"
        if white is not None
        else "linear, relative (there was no white reference)"
    )
    bytes_per_row = maps["albedo"][:1].nbytes
    with (
        BandWriter(folder / ".albedo.npy", maps["albedo"].shape) as albedo,
        BandWriter(folder / ".reflection.npy", maps["albedo"].shape) as reflection,
    ):
        known = False
        for band in export.bands(grid.rows, bytes_per_row):
            part = scale * maps["albedo"][band]
            known = known or bool(np.isfinite(part).any())
            albedo.write(part)
            reflection.write(scale * maps["apparent"][band] - part)
    if not known:
        raise TileError(
            "normals: not a single pixel has three usable lights; see the mask, the saturation level and "
            "the frames themselves"
        )
    progress(0.3)
    albedo_map, reflection_map = (read_array(folder / f".{n}.npy") for n in ("albedo", "reflection"))

    def tiff(name: str, array: Array, what: str, profile: bytes | None = None) -> None:
        export.write_tiff(folder / name, array, grid, description=what, icc=profile)

    _write_normals(folder, maps, grid, integrated, perspective)
    tiff("albedo.tif", albedo_map, f"Albedo; {said}; NaN where not known", icc)
    export.write_albedo_view(folder / "albedo_view.tif", _viewable(albedo_map, white), grid)
    tiff(
        "reflection.tif",
        reflection_map,
        f"Apparent colour (mean over the lamps) minus albedo; {said}; signed",
        icc,
    )
    progress(0.7)
    tiff("height.tif", maps["height"], f"Height in {grid.unit}, its constant free; {FRAME}")
    if "trend" in maps:
        tiff("trend.tif", maps["trend"], f"Trend removed from the height, {grid.unit}")
    for name in ("albedo", "reflection"):
        (folder / f".{name}.npy").unlink()
    progress(1.0)


def _write_normals(
    folder: Path, maps: Mapping[str, Array], grid: PixelGrid, integrated: Array | None, perspective: bool
) -> None:
    """Write the normals, a view of them, and their uncertainty."""
    import tifffile

    normals, confidence = maps["normals"], maps["confidence"]
    what = (
        f"Unit normals x, y, z; {FRAME}",
        "Standard uncertainty of the normal, degrees: 68 % of all normals are off by no more; NaN where not "
        "known",
    )
    path = folder / "normals.tif"
    with (
        export.BandTiff(path, normals.shape, "float32", grid=grid, description=what[0]) as vectors,
        export.BandTiff(
            folder / "confidence.tif", grid.shape, "float32", grid=grid, description=what[1]
        ) as angles,
    ):
        for band in export.bands(grid.rows, 4 * normals[:1].nbytes):
            if integrated is None:
                vectors.write(normals[band])
                angles.write(confidence[band])
                continue
            rows = (band.start, min(band.stop, grid.rows))
            vectors.write(integrable_normals(normals, integrated, grid, *rows, perspective=perspective))
            angles.write(integrable_uncertainty(confidence, *rows))
    export.write_normals_view(folder / "normals_opengl.png", tifffile.memmap(path, mode="r"))


def _viewable(albedo: Array, white: float | None) -> Array:
    """Albedo for viewing: as it is where it is absolute, else its brightest set to 0.9."""
    if white is not None:
        return albedo
    bright = float(np.nanpercentile(sampled(albedo), 99.5))
    return np.asarray(albedo * np.float32(0.9 / bright)) if bright > 0 else albedo


def write_meshes(folder: Path, height: Array, maps: Path, grid: PixelGrid, progress: Progress) -> None:
    """Write ``mesh.ply``, ``mesh.glb`` and what is to be said of them, ``mesh.json``.

    Raises
    ------
    TileError
        When no pixels lie together, so that there is no surface.
    """
    import tifffile

    albedo = tifffile.memmap(maps / "albedo.tif", mode="r")
    vertices, faces = meshes.write_ply(
        folder / "mesh.ply", height, albedo, grid, lambda share: progress(0.6 * share)
    )
    try:
        light = meshes.write_glb(folder / "mesh.glb", height, albedo, grid)
    except ValueError:
        raise TileError(
            "mesh: no 2 x 2 pixels of the height are known, so there is no surface; see the mask, and the "
            "lights used in the store's normals"
        ) from None
    summary = {"ply": {"vertices": vertices, "faces": faces}, "glb": light}
    (folder / "mesh.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")


def write_report(
    folder: Path,
    store: Store,
    tile: Tile,
    record: Mapping[str, Any],
    refs: Mapping[str, ArtefactRef | None],
    grid: PixelGrid,
) -> None:
    """Write ``report.html``, ``quality.json`` and ``provenance.json``."""
    import tifffile

    from nlights_core.report import write_report as write_html

    made = {name: store.path(ref) for name, ref in refs.items() if ref is not None}
    normals, height = refs["normals"], refs["height"]
    assert normals is not None
    assert height is not None
    maps = open_maps(store, normals, height, refs["trend"])
    maps["measured"] = maps["normals"]
    for name in ("albedo", "reflection", "normals", "confidence"):
        maps[name] = tifffile.memmap(made["maps"] / f"{name}.tif", mode="r")
    if "plate" in made:
        maps["plate"] = read_plate(made["plate"]).inside(grid)
    if "bias" in made:
        maps["bias"] = read_array(made["bias"] / "bias.npy")
    numbers = quality.measure(maps, grid, tile.lamps)
    numbers += quality.of_agreement(read_agreement(store.path(normals)), tile.lamps)
    lights = json.loads((made["lights"] / "lights.json").read_text())
    white = json.loads((made["maps"] / RECORD).read_text())["facts"]["white_reflectance"]
    uncertainty = tile.stand.uncertainty_mm if tile.stand else None
    field = LightField.from_record(lights)
    wrong = uncertainty and position_uncertainty(
        maps["normals"], grid, field, uncertainty, photographed=white is not None
    )
    numbers += quality.of_positions(wrong or None, uncertainty)
    check = read_flat_check(made["plate"]) if "plate" in made else None
    absent = NOT_MEASURED if white is not None else NOT_IN_RECIPE
    numbers += quality.of_flat(check, tile.stand.name if tile.stand else None, absent)
    if height.stage == "level":
        numbers += quality.of_level(read_level(store.path(height)))
    numbers = quality.grouped(numbers)
    provenance = {
        "nlights": __version__,
        "artwork": tile.artwork,
        "title": tile.title,
        "tile": tile.name,
        "origin_mm": list(tile.origin_mm),
        "key": record["key"],
        "recipe": record["facts"]["recipe"],
        "stand": record["facts"]["stand"],
        "photographs": {lamp: path.name for lamp, path in tile.frames.items()},
        "stages": _lineage(store, refs),
    }
    files = [*made["maps"].iterdir(), *made["mesh"].iterdir()]
    write_html(
        folder / "report.html",
        {
            "artwork": tile.artwork,
            "title": tile.title,
            "tile": tile.name,
            "origin_mm": list(tile.origin_mm),
            "stand": tile.stand.name if tile.stand else None,
            "uncertainty_mm": uncertainty,
            "white": white,
            "recipe": record["facts"]["recipe"],
            "lamps": list(tile.lamps),
            "lights": lights,
            "mesh": json.loads((made["mesh"] / "mesh.json").read_text()),
            "version": __version__,
            "key": record["key"],
            "files": [
                {"name": path.name, "bytes": path.stat().st_size, "what": WHAT[path.name]}
                for path in sorted(files)
                if path.name in WHAT
            ],
        },
        maps,
        grid,
        numbers,
    )
    _write_json(folder / "quality.json", [asdict(number) for number in numbers])
    _write_json(folder / "provenance.json", provenance)


def _lineage(store: Store, refs: Mapping[str, ArtefactRef | None]) -> list[dict[str, Any]]:
    """Records of all artefacts behind some, each once, causes first, without times and places."""
    found: dict[str, dict[str, Any]] = {}

    def visit(folder: str) -> None:
        record = json.loads((store.root / folder / RECORD).read_text(encoding="utf-8"))
        for cause in record.pop("input_folders").values():
            visit(cause)
        for name in ("seconds", "files"):
            record.pop(name)
        found.setdefault(record["key"], record)

    for ref in refs.values():
        if ref is not None:
            visit(ref.folder)
    return list(found.values())


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
