"""Pages that people read of a tile: the report, its numbers, and what made them."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from nlights_core import __version__
from nlights_core.calibration.record import read_calibration, read_uncertainty
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning, read_warnings, write_warnings
from nlights_core.fields import LightField
from nlights_core.files import tiffs
from nlights_core.files.arrays import read_array
from nlights_core.frames import Array, PixelGrid
from nlights_core.integration.known_heights import DIFFERENCES, read_differences
from nlights_core.lamps.emission import read_stand_check
from nlights_core.movement.shifts import read_shifts
from nlights_core.near_light.position_uncertainty import position_uncertainty
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.masks import Mask
from nlights_core.photographs.noise import read_noise
from nlights_core.products.writing import PROVENANCE, WHAT, open_maps, white_reflectance
from nlights_core.reduced_light.borders import PICTURE, read_proposal
from nlights_core.report import quality
from nlights_core.report.agreement_quality import of_agreement
from nlights_core.report.alignment_quality import of_shifts
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.report.figures import NOT_IN_RECIPE, NOT_MEASURED, Number
from nlights_core.report.flat_quality import of_flat_levels
from nlights_core.solving.agreement import read_agreement
from nlights_core.store import RECORD, ArtefactRef, Store
from nlights_core.store.records import described_files, read_sealed, sealed


def write_report(
    folder: Path,
    store: Store,
    tile: Tile,
    record: Mapping[str, Any],
    refs: Mapping[str, ArtefactRef | None],
    grid: PixelGrid,
) -> None:
    """Write ``report.html``, ``quality.json``, ``warnings.json`` and ``provenance.json``."""
    from nlights_core.report.page import draw
    from nlights_core.report.page import write_report as write_html

    made = {name: store.path(ref) for name, ref in refs.items() if ref is not None}
    records = _records(store, refs)
    maps = _open_maps(store, refs, made, grid)
    assert refs["normals"] is not None
    assert refs["agreement"] is not None
    white = white_reflectance(store, refs["normals"])
    said = _facts(tile, record, made, white)
    others = [
        warning
        for place in records
        if place != refs["agreement"].folder
        for warning in read_warnings(store.root / place)
    ]
    # Drawing keeps mostly Python busy and measuring mostly compiled loops, so they go on together.
    with ThreadPoolExecutor(1) as beside:
        drawing = beside.submit(draw, said, maps, grid)
        numbers = _numbers(maps, grid, tile, made, said, white)
        photographs = read_warnings(made["agreement"])
        if "alignment" in made:
            shifts = read_shifts(made["alignment"])
            numbers += of_shifts(shifts)
            if shifts.believed:
                # What was taken out is said once, by those who took it out.
                photographs = [warning for warning in photographs if warning.code != "moved"]
        numbers = quality.grouped(doubting_only_unexplained(numbers, photographs))
        warnings = _warnings(photographs, others, numbers)
        write_html(folder / "report.html", said, drawing.result(), numbers, warnings)
    if "trend" in made and (made["trend"] / DIFFERENCES).is_file():
        shutil.copyfile(made["trend"] / DIFFERENCES, folder / DIFFERENCES)
    write_warnings(folder, warnings)
    _write_json(folder / "quality.json", [asdict(number) for number in numbers])
    products = {
        **described_files(folder.iterdir()),
        **_files(store, refs["maps"]),
        **_files(store, refs["mesh"]),
    }
    provenance = _provenance(tile, record, list(records.values()), products)
    (folder / PROVENANCE).write_text(sealed(provenance), encoding="utf-8")


def _open_maps(
    store: Store, refs: Mapping[str, ArtefactRef | None], made: Mapping[str, Path], grid: PixelGrid
) -> dict[str, Array]:
    """Open the maps that the report shows or measures, by name."""
    normals, height = refs["normals"], refs["height"]
    assert normals is not None
    assert height is not None
    maps = open_maps(store, normals, height, refs["trend"])
    maps["measured"] = maps["normals"]
    for name in ("albedo", "reflection", "normals", "confidence"):
        maps[name] = tiffs.read_tiff(made["maps"] / f"{name}.tif")
    if (made["maps"] / "height_uncertainty.tif").is_file():
        maps["height_uncertainty"] = tiffs.read_tiff(made["maps"] / "height_uncertainty.tif")
    if "flat_field" in made:
        maps["flat_field"] = read_flat_field(made["flat_field"]).inside(grid)
    if "bias" in made:
        maps["bias"] = read_array(made["bias"] / "bias.npy")
    return maps


def _facts(
    tile: Tile, record: Mapping[str, Any], made: Mapping[str, Path], white: float | None
) -> dict[str, Any]:
    """Facts of a tile, its capture and its products, as the page shows them."""
    files = [*made["maps"].iterdir(), *made["mesh"].iterdir()]
    border = tile.mask.parent if tile.auto_mask and tile.mask else made["agreement"]
    return {
        "artwork": tile.artwork,
        "title": tile.title,
        "tile": tile.name,
        "origin_mm": list(tile.origin_mm),
        "stand": tile.stand.name if tile.stand else None,
        "uncertainty_mm": tile.stand.uncertainty_mm if tile.stand else None,
        "white": white,
        "recipe": record["facts"]["recipe"],
        "lamps": list(tile.lamps),
        "lights": json.loads((made["lights"] / "lights.json").read_text()),
        "mesh": json.loads((made["mesh"] / "mesh.json").read_text()),
        "border": _border(border, tile.auto_mask),
        "version": __version__,
        "key": record["key"],
        "files": [
            {"name": path.name, "bytes": path.stat().st_size, "what": WHAT[path.name]}
            for path in sorted(files)
            if path.name in WHAT
        ],
    }


def _files(store: Store, ref: ArtefactRef | None) -> dict[str, Any]:
    """Size and digest of each file of an artefact, by its record."""
    assert ref is not None
    return read_sealed(store.path(ref) / RECORD)["files"]  # type: ignore[no-any-return]


def _provenance(
    tile: Tile,
    record: Mapping[str, Any],
    stages: Sequence[Mapping[str, Any]],
    products: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Record of what made the products, in full, and size and digest of each."""
    return {
        "nlights": __version__,
        "artwork": tile.artwork,
        "title": tile.title,
        "tile": tile.name,
        "origin_mm": list(tile.origin_mm),
        "key": record["key"],
        "recipe": record["facts"]["recipe"],
        "stand": record["facts"]["stand"],
        "photographs": {lamp: path.name for lamp, path in tile.frames.items()},
        "files": {name: said for name, said in sorted(products.items()) if name in WHAT},
        "stages": stages,
    }


def _border(folder: Path, used: bool) -> dict[str, str] | None:
    """Words and picture of what is, or may be, no part of the artwork; None where nothing was found."""
    sentence = read_proposal(folder)
    if not sentence:
        return None
    if used:
        sentence = (
            "What is red is no part of the artwork as far as the photographs tell: left out (mask: auto)."
        )
    image = base64.b64encode((folder / PICTURE).read_bytes()).decode()
    return {"sentence": sentence, "image": f"data:image/png;base64,{image}"}


def _numbers(
    maps: Mapping[str, Array],
    grid: PixelGrid,
    tile: Tile,
    made: Mapping[str, Path],
    said: Mapping[str, Any],
    white: float | None,
) -> list[Number]:
    """The numbers of the report, but for those of the shifts."""
    stand, uncertainty = tile.stand, tile.stand.uncertainty_mm if tile.stand else None
    field = LightField.from_record(said["lights"])
    numbers = quality.measure(maps, grid, tile.lamps, Mask(tile.mask).pixels if tile.mask else None)
    refined = bool(said["recipe"]["light_model"].get("refine"))
    numbers += of_agreement(read_agreement(made["normals"]), tile.lamps, refined)
    wrong = uncertainty and position_uncertainty(
        maps["normals"], grid, field, uncertainty, photographed=white is not None
    )
    numbers += quality.of_positions(wrong or None, uncertainty)
    check = read_stand_check(made["flat_field"]) if "flat_field" in made else None
    absent = NOT_MEASURED if white is not None else NOT_IN_RECIPE
    numbers += quality.of_flat(check, stand.name if stand else None, absent)
    photographed = made["flat_field"] if white is not None else None
    numbers += of_flat_levels(
        maps["flat_field"] if photographed else None,
        field.power,
        read_noise(photographed) if photographed else None,
        tile.lamps,
        absent,
    )
    if "calibration" in made:
        numbers += of_calibration(
            read_calibration(made["calibration"]), read_uncertainty(made["calibration"])
        )
    if "trend" in made:
        source = tile.known_heights.file.name if tile.known_heights else ""
        numbers += quality.of_known_heights(read_differences(made["trend"]), source)
    return numbers


EXPLAINS_STAND = {
    "additive-light", "dark-lit", "drift", "exchanged", "flat-gloss", "not-fired", "tone-curve", "truncated", "turned"
}  # fmt: skip
"""Codes of what makes flats differ from the lamps of a stand that is as its file says.  Nobody should measure a stand
again before these are mended: if it is the stand as well, the next capture says so."""


def doubting_only_unexplained(
    numbers: Sequence[Number], photographs: Sequence[CaptureWarning]
) -> list[Number]:
    """Numbers of which those that doubt the stand warn only where nothing else explains it."""
    seen = {warning.code for warning in photographs} & EXPLAINS_STAND
    found = {number.code for number in numbers if number.warning} & EXPLAINS_STAND
    # The calibration finds the lamps' positions together with all that it corrects.
    explained = {"stand"} if seen or found else set()
    explained |= {"lamp-positions"} if seen else set()
    return [replace(number, warning="") if number.code in explained else number for number in numbers]


FIRST = "Mend what stands above first; if this stays: "
"""Beginning of what numbers warn of where photographs do not agree: most of it has the same cause."""


def _warnings(
    photographs: list[CaptureWarning], algorithms: list[CaptureWarning], numbers: Sequence[Number]
) -> list[CaptureWarning]:
    """Warnings of the photographs about themselves, then of algorithms, then of the numbers that were made."""
    before = FIRST if photographs else ""
    return (
        photographs
        + algorithms
        + [
            CaptureWarning(number.code, before + number.warning, (), number.value, number.unit)
            for number in numbers
            if number.warning
        ]
    )


def _records(store: Store, refs: Mapping[str, ArtefactRef | None]) -> dict[str, dict[str, Any]]:
    """Records of all artefacts behind some by their folders, each once, causes first, without times and places."""
    found: dict[str, dict[str, Any]] = {}

    def visit(folder: str) -> None:
        record = read_sealed(store.root / folder / RECORD)
        for cause in record.pop("input_folders").values():
            visit(cause)
        for name in ("seconds", "files"):
            record.pop(name)
        found.setdefault(folder, record)

    for ref in refs.values():
        if ref is not None:
            visit(ref.folder)
    return found


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
