"""Notebooks: results as small pieces of HTML that need nothing else."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlights_core.files.reduction import block_means
from nlights_core.files.tiffs import read_tiff
from nlights_core.frames import Array
from nlights_core.report import pictures
from nlights_core.report.figures import figure_of
from nlights_flows.comparison import page
from nlights_flows.tiles.pages import template

if TYPE_CHECKING:
    from nlights.comparisons import ComparisonResult
    from nlights.tiles import Numbers, TileResult

HERE = Path(__file__).parent

LONGEST = 360
"""Longest side of a picture, px."""

CHIEF = (
    "Known share",
    "Uncertainty of the normals, mean",
    "Residual, mean",
    "Height range",
    "Height, rms",
    "Mean slope",
)
"""Which numbers are shown; the report has them all."""


def tile_html(tile: TileResult) -> str:
    """A tile for a notebook: albedo, raking light, a sentence, the chief numbers; or why it failed."""
    page_of = template(HERE / "tile.html.j2")
    if tile.failed:
        return page_of.render(tile=tile, title=tile.artwork)
    quality = tile.quality
    chief = [quality[name] for name in CHIEF if name in quality]
    albedo = np.asarray(_small(read_tiff(tile.report.with_name("albedo_view.tif"))) / 257, np.uint8)
    shade, _ = pictures.hillshade(_small(tile.normals))
    return page_of.render(
        tile=tile,
        title=tile.provenance["title"] or tile.artwork,
        sentence=_sentence(quality),
        warnings=tile.warnings,
        pictures=[("Albedo", _picture(albedo)), ("Raking light", _picture(pictures.grey(shade)))],
        numbers=[
            (n.name, figure_of(n.value, n.unit) if n.value is not None else n.missing, n.unit) for n in chief
        ],
    )


def _sentence(quality: Numbers) -> str:
    """Sentence on how much was measured, and how well."""
    known, trust = quality["Known share"], quality["Uncertainty of the normals, mean"]
    share = figure_of(known.value, known.unit).replace("> ", "more than ").replace("< ", "less than ")
    angle = figure_of(trust.value, trust.unit)
    return f"Measured at {share} % of the pixels; 68 % of the normals are off by no more than {angle}°."


def _small(array: Array) -> Array:
    """A map of at most `LONGEST` pixels: block means of some of its pixels, so that a large one is not read whole."""
    factor = max(1, min(-(-max(array.shape[:2]) // LONGEST), *array.shape[:2]))
    step = max(1, factor // 4)
    return block_means(np.ascontiguousarray(array[::step, ::step]), factor // step)


def _picture(colours: Array) -> str:
    """Colours (h, w, 3) uint8 as the address of a small JPEG."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(colours))
    image.thumbnail((LONGEST, LONGEST))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=80)
    return pictures.data_uri("jpeg", stream.getvalue())


def comparison_html(found: ComparisonResult) -> str:
    """A comparison for a notebook: the answer, and a table of every metric with its error bars."""
    metrics = [metric for metric in found.record["metrics"] if metric["over"]]
    return template(HERE / "comparison.html.j2").render(
        found=found,
        metrics=[(metric, page.over(metric), page.table_rows(metric)) for metric in metrics],
        notes=[*found.failures, *found.record["notes"]],
    )
