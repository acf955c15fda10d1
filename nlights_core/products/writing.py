"""Products: what leaves the system for a tile, written from its artefacts."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from nlights_core.errors import TileError
from nlights_core.files import reduction, tiffs
from nlights_core.files.arrays import read_array
from nlights_core.files.reduction import sampled
from nlights_core.files.tiffs import Compression
from nlights_core.frames import Array, PixelGrid
from nlights_core.machine.band_threads import in_order
from nlights_core.machine.progress import Progress
from nlights_core.products.height_uncertainty import Stretched, height_noise
from nlights_core.products.integrability import integrable_normals, integrable_uncertainty
from nlights_core.products.meshes import write_glb
from nlights_core.products.pixel_meshes import write_ply
from nlights_core.products.viewing import NormalsView, write_albedo_view
from nlights_core.solving.least_squares import COVERING
from nlights_core.store import RECORD, ArtefactRef, Store
from nlights_core.store.whole_files import link_or_copy

COLOURED = ("albedo", "reflection")
"""Maps that the normal stage writes as they leave the system."""

FRAME = "plane frame: x right, y up, z from the artwork to the camera; NaN where not known"

PROVENANCE = "provenance.json"

WHAT = {
    "normals.tif": "unit normals x, y, z in the plane frame, float32",
    "normals_opengl.png": "the normals as colours for viewing, 8 bit, OpenGL convention (+Y up)",
    "albedo.tif": "albedo, float32, linear; absolute with a flat, else relative",
    "albedo_view.tif": "the albedo for viewing, 16 bit, sRGB",
    "reflection.tif": "reflection map: apparent colour (mean over the lamps) minus albedo, float32, linear, signed",
    "height.tif": "height towards the camera, float32",
    "height_uncertainty.tif": "standard uncertainty of the height after the best constant, float32",
    "confidence.tif": "standard uncertainty of each normal, degrees, float32",
    "trend.tif": "what detrending removed from the height, float32",
    "known_heights.csv": "the heights that somebody measured, and the differences before and after, mm",
    "mesh.ply": "mesh with a vertex per pixel",
    "mesh.glb": "decimated mesh with the albedo as its texture, metres",
    "report.html": "pictures and numbers",
    "quality.json": "the numbers of the report",
    "warnings.json": "what is wrong with the capture, or may be",
    PROVENANCE: "what made these files, in full, and a digest of each",
}


def open_maps(
    store: Store, normals: ArtefactRef, height: ArtefactRef, trend: ArtefactRef | None
) -> dict[str, Array]:
    """Open the maps of a tile as memory maps, by name."""
    source = store.path(normals)
    names = (
        "normals",
        "confidence",
        "residual",
        "used",
        "saturated",
        "shadow",
        "frames",
    )
    maps = {name: read_array(source / f"{name}.npy") for name in names}
    maps |= {name: tiffs.read_tiff(source / f"{name}.tif") for name in COLOURED}
    maps["height"] = read_array(store.path(height) / "height.npy")
    if trend is not None:
        maps["trend"] = read_array(store.path(trend) / "trend.npy")
    return maps


def white_reflectance(store: Store, normals: ArtefactRef) -> float | None:
    """Albedo of the photographed flat that made this one's albedo absolute; None where it is relative."""
    record = json.loads((store.path(normals) / RECORD).read_text(encoding="utf-8"))
    return record["facts"]["white_reflectance"]  # type: ignore[no-any-return]


def write_maps(
    folder: Path,
    maps: Mapping[str, Array],
    grid: PixelGrid,
    *,
    coloured: Path,
    absolute: bool,
    progress: Progress,
    integrated: Array | None = None,
    perspective: bool = False,
    compression: Compression = "none",
    shared: Array | None = None,
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
    coloured : Path
        Where the albedo and the reflection map are, as they leave the system.
    absolute : bool
        Whether the albedo is; a relative one is made brighter for its view.
    progress : callable
        Told the share done.
    integrated : (H, W) array, optional
        The height that was integrated from the normals, which then are made integrable.
    perspective : bool
        Whether that height was integrated along the rays of the camera.
    compression : {"none", "zstd"}
        Of the TIFFs, without loss.
    shared : (3, h, w) float32 array, optional
        Uncertainty of height (mm) and slope that neighbours share, and a factor of the noise of each normal, on
        coarse blocks over the whole field.

    Raises
    ------
    TileError
        When not a single normal could be solved.
    OSError
        When the disk is full.
    """
    places = list(reduction.bands_of_bytes(grid.rows, maps["normals"][:1].nbytes))
    if not any(np.isfinite(maps["albedo"][band]).any() for band in places):
        raise TileError(
            "normals: not a single pixel has three usable lights; see the mask, the saturation level and "
            "the frames themselves"
        )
    tiff = partial(tiffs.write_bands, dtype=np.float32, grid=grid, compression=compression)
    with NormalsView(folder / "normals_opengl.png", *grid.shape) as view:
        tiff(
            folder / "normals.tif",
            _normals(maps["normals"], grid, integrated, perspective, places, view),
            (*grid.shape, 3),
            description=f"Unit normals x, y, z; {FRAME}",
            read_soon=True,
        )
    progress(0.4)
    tiff(
        folder / "confidence.tif",
        _uncertainty(maps["confidence"], integrated, places, shared),
        grid.shape,
        description="Standard uncertainty of the normal, degrees: 68 % of all normals are off by no more; NaN "
        "where not known",
        read_soon=True,
    )
    for name in COLOURED:
        _pass_on(coloured / f"{name}.tif", folder / f"{name}.tif", grid, compression)
    exposure = 1.0 if absolute else _exposure(maps["albedo"])
    write_albedo_view(folder / "albedo_view.tif", maps["albedo"], grid, exposure, compression)
    progress(0.9)
    for name, rows, description in _heights(maps, grid, places, shared):
        tiff(folder / f"{name}.tif", rows, grid.shape, description=description)
    progress(1.0)


def _exposure(albedo: Array) -> float:
    """Factor that makes the brightest parts of a relative albedo nearly white."""
    values = sampled(albedo)
    bright = float(np.percentile(values, 99.5)) if values.size else 0.0
    return 0.9 / bright if bright > 0 else 1.0


def _pass_on(source: Path, target: Path, grid: PixelGrid, compression: Compression) -> None:
    """Write a map that is finished: as a link where nothing is to be changed, it takes no second place."""
    if compression == "none":
        link_or_copy(source, target)
    else:
        tiffs.write_again(source, target, grid, compression)


def _normals(
    normals: Array,
    grid: PixelGrid,
    integrated: Array | None,
    perspective: bool,
    places: Sequence[slice],
    view: NormalsView,
) -> Iterator[Array]:
    """The normals to be written, band by band; each is added to the view on its way."""

    def made(band: slice) -> tuple[Array, tuple[Array, bytes]]:
        part = np.asarray(normals[band])
        if integrated is not None:
            part = integrable_normals(
                normals, integrated, grid, band.start, band.stop, perspective=perspective
            )
        return part, view.part(part)

    for part, picture in in_order(made, places):
        view.write(picture)
        yield part


def _uncertainty(
    confidence: Array, integrated: Array | None, places: Sequence[slice], shared: Array | None
) -> Iterator[Array]:
    """The uncertainty of the normals to be written, band by band; ``shared`` as for `write_maps`."""
    wide = None if shared is None else Stretched(np.degrees(COVERING * shared[1]), confidence.shape)
    noisier = None
    if shared is not None and (shared[2] != 1).any():
        noisier = Stretched(shared[2], confidence.shape)

    def made(band: slice) -> Array:
        own = np.asarray(confidence[band])
        if integrated is not None:
            own = integrable_uncertainty(confidence, band.start, band.stop)
        if noisier is not None:
            own = own * noisier[band]
        return own if wide is None else np.hypot(own, wide[band])

    return in_order(made, places)


def _heights(
    maps: Mapping[str, Array], grid: PixelGrid, places: Sequence[slice], shared: Array | None
) -> Iterator[tuple[str, Iterator[Array], str]]:
    """The maps of heights to be written: name, rows band by band, and description."""
    said = {"height": f"Height in {grid.unit}, its constant free; {FRAME}"}
    if "trend" in maps:
        said["trend"] = f"Trend removed from the height, {grid.unit}"
    for name, description in said.items():
        yield name, (np.asarray(maps[name][band]) for band in places), description
    if shared is not None:
        description = (
            f"Standard uncertainty of the height after the best constant, {grid.unit}; NaN where not known"
        )
        yield "height_uncertainty", _height_uncertainty(maps, grid, shared, places), description


def _height_uncertainty(
    maps: Mapping[str, Array], grid: PixelGrid, shared: Array, places: Sequence[slice]
) -> Iterator[Array]:
    """The uncertainty of the height, band by band: what neighbours share, and noise through the integrator."""
    values = sampled(maps["confidence"])
    noise = height_noise(float(np.median(values)), grid) if values.size else 0.0
    wide = Stretched(np.hypot(shared[0], noise * float(np.median(shared[2]))), grid.shape)
    return (np.where(np.isnan(maps["height"][band]), np.float32(np.nan), wide[band]) for band in places)


def write_meshes(folder: Path, height: Array, maps: Path, grid: PixelGrid, progress: Progress) -> None:
    """Write ``mesh.ply``, ``mesh.glb`` and what is to be said of them, ``mesh.json``.

    Raises
    ------
    TileError
        When no pixels lie together, so that there is no surface.
    """
    albedo = tiffs.read_tiff(maps / "albedo.tif")
    # The light mesh keeps one core busy and the other file mostly the disk, so they are made together.
    with ThreadPoolExecutor(1) as beside:
        decimated = beside.submit(write_glb, folder / "mesh.glb", height, albedo, grid)
        vertices, faces = write_ply(
            folder / "mesh.ply", height, albedo, grid, lambda share: progress(0.9 * share)
        )
        try:
            light = decimated.result()
        except ValueError:
            raise TileError(
                "mesh: no 2 x 2 pixels of the height are known, so there is no surface; see the mask, and the "
                "lights used in the store's normals"
            ) from None
    summary = {"ply": {"vertices": vertices, "faces": faces}, "glb": light}
    (folder / "mesh.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
