"""Pictures of a comparison: the same view of every variant in the same colours, and difference maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlights_core.files.reduction import block_means
from nlights_core.files.tiffs import read_tiff
from nlights_core.frames import Array, PixelGrid
from nlights_core.report import pictures
from nlights_core.report.pictures import ColourBar, Tick
from nlights_core.simulation.evaluation import angles_between

LONGEST = 900
"""Longest side of a picture, px: there are many on a page."""


@dataclass(frozen=True)
class View:
    """One view of all variants: of a curtain, any two of them are shown.

    Attributes
    ----------
    title, caption : str
    images : tuple of str
        Data URIs, per variant.
    bar : ColourBar or None
    """

    title: str
    caption: str
    images: tuple[str, ...]
    bar: ColourBar | None = None


@dataclass(frozen=True)
class Map:
    """A map of one variant's difference from the first, or from the truth."""

    title: str
    image: str
    bar: ColourBar


@dataclass(frozen=True)
class TilePictures:
    """The pictures of a tile.

    Attributes
    ----------
    name : str
    views : tuple of View
        For the curtain.
    differences : tuple of Map
        From the first variant, of those that are not the same.
    same : tuple of str
        Variants whose maps are those of the first.
    errors : tuple of Map
        From the truth; none without one.
    scale : (float, str)
        Scale bar: percent of the width, and length.
    factor : int
        Edge of the blocks of pixels that one pixel of a picture is the mean of.
    """

    name: str
    views: tuple[View, ...]
    differences: tuple[Map, ...]
    same: tuple[str, ...]
    errors: tuple[Map, ...]
    scale: Tick
    factor: int


def tile_pictures(
    name: str, variants: Sequence[str], folders: Sequence[Path], truth: Path | None, grid: PixelGrid
) -> TilePictures:
    """Draw a tile.

    Parameters
    ----------
    name : str
        The tile's.
    variants : sequence of str
        Their names.
    folders : sequence of Path
        Their products.
    truth : Path or None
        Folder of the true normals.tif and height.tif, of the same size.
    grid : PixelGrid
        Of the tile.

    Returns
    -------
    TilePictures
        From reduced views of `LONGEST` pixels at most.
    """
    factor = max(1, min(-(-max(grid.shape) // LONGEST), *grid.shape))
    normals = [block_means(read_tiff(folder / "normals.tif"), factor) for folder in folders]
    heights = _levelled([block_means(read_tiff(folder / "height.tif"), factor) for folder in folders])
    scale, unit = _height_unit(heights, grid)
    errors: tuple[Map, ...] = ()
    if truth is not None:
        right = [block_means(_tiff(truth / file), factor) for file in ("normals.tif", "height.tif")]
        errors = _against(variants, normals, heights, right[0], right[1], "the truth", scale, unit)
    same = [_equal(n, normals[0]) and _equal(z, heights[0]) for n, z in zip(normals, heights, strict=True)]
    other = [k for k in range(len(variants)) if not same[k]]
    first = _against(
        [variants[k] for k in other],
        [normals[k] for k in other],
        [heights[k] for k in other],
        normals[0],
        heights[0],
        variants[0],
        scale,
        unit,
    )
    columns = grid.columns // factor
    return TilePictures(
        name,
        _views(normals, heights, scale, unit),
        first,
        tuple(name for name, equal in zip(variants[1:], same[1:], strict=True) if equal),
        errors,
        pictures.scale_bar(columns * factor * grid.pixel_size, grid.unit),
        factor,
    )


def _equal(one: Array, other: Array) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def _tiff(path: Path) -> Array:
    import tifffile

    return np.asarray(tifffile.imread(path))


def _levelled(heights: Sequence[Array]) -> list[Array]:
    """Heights with the free constant such that each is, on average, as high as the first."""
    levelled = [heights[0]]
    for height in heights[1:]:
        away = (height - heights[0])[np.isfinite(height) & np.isfinite(heights[0])]
        levelled.append(height - np.float32(away.mean()) if away.size else height)
    return levelled


def _height_unit(heights: Sequence[Array], grid: PixelGrid) -> tuple[float, str]:
    """Factor that heights are multiplied by, and their unit then: µm where the relief is flat."""
    if grid.unit == "px":
        return 1.0, "px"
    low, high = pictures.robust_range(heights[0])
    return (1000.0, "µm") if high - low < 1 else (1.0, "mm")


def _views(normals: Sequence[Array], heights: Sequence[Array], scale: float, unit: str) -> tuple[View, ...]:
    """Normals, raking light and height of every variant, all in the same colours."""
    rows = len(normals[0])
    # One contrast for all: in one picture they are shaded alike.
    shade, gain = pictures.hillshade(np.concatenate(normals))
    shades = [shade[i * rows : (i + 1) * rows] for i in range(len(normals))]
    ends = pictures.robust_range(np.stack(heights))
    drawn = [pictures.coloured(height, ends, "cividis", f"Height in {unit}", scale) for height in heights]
    return (
        View(
            "Normals",
            "OpenGL colours: redder faces right, greener faces up, blue faces the camera.",
            tuple(pictures.encode(_normal_colours(n)) for n in normals),
        ),
        View(
            "Hillshade",
            f"Light from the upper left, 25° above the surface; contrast \N{MULTIPLICATION SIGN} {gain:.2g} for "
            "every variant.",
            tuple(pictures.encode(pictures.grey(s)) for s in shades),
        ),
        View(
            "Height",
            "Each variant raised or lowered as a whole to the first one's mean: the constant is free.",
            tuple(image for image, _ in drawn),
            drawn[0][1],
        ),
    )


def _normal_colours(normals: Array) -> Array:
    colours = np.nan_to_num(normals * 127.5 + 128, nan=0.0).clip(0, 255).astype(np.uint8)
    return pictures.hatch(colours, np.isfinite(normals.sum(axis=2)))


def _against(
    variants: Sequence[str],
    normals: Sequence[Array],
    heights: Sequence[Array],
    normal: Array,
    height: Array,
    other: str,
    scale: float,
    unit: str,
) -> tuple[Map, ...]:
    """Signed height differences and angles of some variants from another or the truth, in one scale each."""
    if not variants:
        return ()
    away = [_centred(z - height) for z in heights]
    angles = [angles_between(n, normal) for n in normals]
    ends = pictures.robust_range(np.stack(away), symmetric=True)
    if unit == "mm" and ends[1] < 1:
        scale, unit = 1000.0, "µm"
    turned = pictures.robust_range(np.stack(angles), from_zero=True)
    maps = []
    for name, difference, angle in zip(variants, away, angles, strict=True):
        image, bar = pictures.coloured(
            difference, ends, "RdBu_r", f"Height minus that of {other}, {unit}", scale
        )
        maps.append(Map(name, image, bar))
        image, bar = pictures.coloured(angle, turned, "magma", f"Angle to the normals of {other}, degrees")
        maps.append(Map(name, image, bar))
    return tuple(maps)


def _centred(values: Array) -> Array:
    known = values[np.isfinite(values)]
    return values - known.mean(dtype=np.float64) if known.size else values
