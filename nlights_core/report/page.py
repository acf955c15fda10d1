"""The report of a tile: one self-contained HTML page of pictures and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array, PixelGrid
from nlights_core.names.control_characters import shown_escaped
from nlights_core.report.chapters import Chapter, chapters
from nlights_core.report.figures import Number, figure_of
from nlights_core.report.views import Views


def _length(value: float) -> str:
    """A length or a coordinate with five significant digits at most."""
    return f"{value:.5g}".replace("-", "\N{MINUS SIGN}")


def _facts(record: Mapping[str, Any], grid: PixelGrid) -> list[tuple[str, str]]:
    """The header of the report: what was measured, where, how finely."""
    unit, size = grid.unit, grid.pixel_size
    facts = [("Artwork", str(record.get("artwork") or "not stated"))]
    tile = str(record.get("tile") or "not stated")
    if origin := record.get("origin_mm"):
        tile += f", its centre at x {_length(origin[0])}, y {_length(origin[1])} mm on the artwork"
    facts.append(("Tile", tile))
    pixels = f"{grid.columns} \N{MULTIPLICATION SIGN} {grid.rows} pixels"
    if unit == "mm":
        width, tall = _length(grid.columns * size), _length(grid.rows * size)
        facts.append(("Field", f"{width} \N{MULTIPLICATION SIGN} {tall} mm, {pixels}"))
        facts.append(("Pixel size", f"{_length(size)} mm on the artwork"))
    else:
        facts.append(("Field", pixels))
        facts.append(("Pixel size", "scale not known: heights in pixels"))
    stand = str(record.get("stand") or "not stated")
    if uncertainty := record.get("uncertainty_mm"):
        stand += f", positions known to \N{PLUS-MINUS SIGN} {_length(uncertainty)} mm"
    camera = "seen straight on everywhere (orthographic)"
    if grid.camera is not None:
        camera = f"{_length(grid.camera[2])} {unit} from the plane of the artwork"
    facts += [
        ("Stand", stand),
        ("Camera", camera),
        ("Lamps", str(len(record.get("lamps") or ())) if record.get("lamps") else "not stated"),
        (
            "Frame and unit",
            f"x right, y up, z from the artwork to the camera; origin at the centre of the field; lengths in "
            f"{'millimetres' if unit == 'mm' else 'pixels'}",
        ),
    ]
    return facts


def _bytes(count: int) -> str:
    """A file's size as a person writes it."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{figure_of(count / size)} {unit}"
    return f"{count} bytes"


class Drawing(NamedTuple):
    """The pictures of a report, and the scale that they are drawn to."""

    views: Views
    chapters: list[Chapter]


def draw(record: Mapping[str, Any], maps: Mapping[str, Array], grid: PixelGrid) -> Drawing:
    """Draw the pictures of a tile's report.

    Parameters
    ----------
    record : mapping
        As `write_report` takes it.
    maps : mapping of str to array
        What is there of "albedo" (H, W, C), "normals" (H, W, 3), "height", "confidence", "residual"
        (H, W), "used" (H, W) integers, "reflection" (H, W, C), "flat_field" (L, h, w, C), "trend" (H, W),
        "bias" (H, W, 3) and "frames" (L, h, w[, C]).  NaN where not known.
    grid : PixelGrid
        Where the pixels are; its unit is that of every length.

    Notes
    -----
    The pictures are means over blocks of pixels, at most `pictures.LONGEST` pixels long.
    """
    views = Views(maps, grid)
    return Drawing(views, chapters(views, record))


def write_report(
    path: str | Path,
    record: Mapping[str, Any],
    drawing: Drawing,
    numbers: Sequence[Number],
    warnings: Sequence[CaptureWarning] = (),
) -> None:
    """Write the report of a tile: one HTML file that needs nothing else, neither network nor script.

    Parameters
    ----------
    path : str or Path
        File to write.
    record : mapping
        What is known of the tile, every key optional: "artwork", "title", "tile", "origin_mm" (x, y),
        "stand", "uncertainty_mm" (of a position, per axis), "white" (reflectance of the flat that makes
        the albedo absolute; None: relative), "recipe" (nested mapping), "lamps" (names),
        "lights" (`LightField.record`), "version", "files" (each "name", "bytes", "what"), "mesh"
        ("glb": what `meshes.write_glb` returned) and "key".
    drawing : Drawing
        Of the same record.
    numbers : sequence of Number
        What `nlights_core.report.quality.measure` found.
    warnings : sequence of CaptureWarning
        In the order in which they should be read.

    Raises
    ------
    OSError
        When the file cannot be written.

    Notes
    -----
    The same input gives the same bytes.
    """
    import jinja2
    import yaml

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        finalize=shown_escaped,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    views, grid = drawing.views, drawing.views.grid
    rows = [(number, *_shown(number, views)) for number in numbers]
    groups = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row[0].group)]
    recipe = record.get("recipe")
    page = environment.get_template("report.html.j2").render(
        title=record.get("title") or record.get("artwork") or "Artwork",
        glb=(record.get("mesh") or {}).get("glb"),
        record={"artwork": "", "tile": "", "version": "", "key": "", "files": (), **record},
        uncertainty=_length(record["uncertainty_mm"]) if record.get("uncertainty_mm") else "",
        facts=_facts(record, grid),
        chapters=drawing.chapters,
        groups=groups,
        warnings=warnings,
        lamps=_lamp_rows(record.get("lights") or {}),
        near=bool((record.get("lights") or {}).get("positions")),
        recipe=yaml.safe_dump(recipe, sort_keys=False, allow_unicode=True) if recipe else "",
        unit=grid.unit,
        factor=views.factor,
        figure_of=figure_of,
        height_unit=views.height_unit,
        size_of=_bytes,
    )
    Path(path).write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n")


def _shown(number: Number, views: Views) -> tuple[str, str]:
    """A number and its unit as the table shows them: heights in the unit of the pictures."""
    if number.value is None:
        return number.missing, number.unit
    factor, unit = views.height_unit if number.unit == "mm" else (1.0, number.unit)
    return figure_of(number.value * factor, unit), unit


def _lamp_rows(lights: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Name and x, y, z of every lamp."""
    digits = 1 if lights.get("positions") else 4
    places = lights.get("positions") or lights.get("directions") or ()
    return [
        (str(name), [f"{v:.{digits}f}".replace("-", "\N{MINUS SIGN}") for v in place])
        for name, place in zip(lights.get("lamps", ()), places, strict=False)
    ]
