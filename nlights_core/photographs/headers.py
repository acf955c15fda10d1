"""Surveys: whether a tile's photographs fit together, and where their pixels are on the plane."""

from __future__ import annotations

from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.frames import PixelGrid
from nlights_core.photographs.images import ImageInfo, probe
from nlights_core.photographs.masks import mask_size
from nlights_core.photographs.tone_curves import ToneCurve


def survey(tile: Tile) -> ImageInfo:
    """Read the headers of all photographs of a tile and see that they fit together.

    Returns
    -------
    ImageInfo
        Of the frames, which are all alike.

    Raises
    ------
    TileError
        Naming the photograph that is missing or unreadable, or that is not of the size, type and tone curve that
        most have.
    """
    frames = {f"frames.{lamp}": path for lamp, path in tile.frames.items()}
    flats = {f"flats.{lamp}": path for lamp, path in (tile.flats or {}).items()}
    dark = {"dark": tile.dark} if tile.dark else {}
    paths = {**frames, **flats, **dark}
    infos = {name: probe(path, tile.encoding) for name, path in paths.items()}
    first = infos[next(iter(frames))]
    for what, kinds in (
        ("size", {name: f"{info.columns} x {info.rows} px" for name, info in infos.items()}),
        ("depth", {name: f"{info.channels} x {info.dtype}" for name, info in infos.items()}),
        ("tone curve", _curves(infos)),
    ):
        if len(set(kinds.values())) > 1:
            raise TileError(_difference(what, kinds, paths))
    if tile.mask:
        rows, columns = mask_size(tile.mask)
        if (rows, columns) != (first.rows, first.columns):
            raise TileError(
                f"{tile.mask}: mask: size {columns} x {rows} px, but the frames have "
                f"{first.columns} x {first.rows} px; draw the mask on a frame"
            )
    return first


def _curves(infos: dict[str, ImageInfo]) -> dict[str, str]:
    """Name of each photograph's tone curve; curves that mean the same are called by the name of the first."""
    seen: list[ToneCurve] = []
    names = {}
    for name, info in infos.items():
        if info.curve is None:
            names[name] = "none (linear light)"
            continue
        alike = next((curve for curve in seen if info.curve.same_as(curve)), None)
        if alike is None:
            alike = info.curve
            seen.append(alike)
        count = [curve.name for curve in seen].index(alike.name)
        # Programs give profiles that differ the same name.
        names[name] = alike.name if seen[count] is alike else f"another of the same name ({alike.name})"
    return names


def _difference(what: str, kinds: dict[str, str], paths: dict[str, Path]) -> str:
    """Sentence about photographs that are not all alike: who differs from the most, or that there are two camps.

    Parameters
    ----------
    what : str
        In what they differ.
    kinds : dict
        Of each photograph, by the field that names it.
    paths : dict
        Its file, by the same.
    """
    camps: dict[str, list[str]] = {}
    for name, kind in kinds.items():
        camps.setdefault(kind, []).append(name)
    most, *others = sorted(camps, key=lambda kind: -len(camps[kind]))
    remedy = "all photographs of a tile must be alike: photograph or export it again"
    if what == "tone curve":
        remedy = (
            "all photographs of a tile must mean the same: export it as the others, or state encoding.transfer for "
            "all of them"
        )
    if len(camps[most]) == len(camps[others[0]]):
        told = "; ".join(
            f"{len(names)} have {kind} ({_listed(names)}; {paths[names[0]].name})"
            for kind, names in camps.items()
        )
        return f"{paths[camps[most][0]].parent}: {what}: the photographs differ: {told}; {remedy}"
    odd, usual = camps[others[0]], camps[most]
    also = f" (so have {_listed(odd[1:])})" if len(odd) > 1 else ""
    return (
        f"{paths[odd[0]]}: {odd[0]}: {what} {others[0]}{also}, but {len(usual)} photographs, as {usual[0]} "
        f"({paths[usual[0]].name}), have {most}; {remedy}"
    )


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def grid_of(tile: Tile, info: ImageInfo) -> PixelGrid:
    """Pixel grid of a tile on the plane.

    The stand's framed field sets the scale; without a stand the capture's ``pixel_size_mm``
    does; without either the unit of length is the pixel.

    Raises
    ------
    TileError
        When the photographs are not of the shape of the stand's field: turned, or cropped.
    """
    if tile.stand is not None:
        camera = tile.stand.camera_position
        width, height = tile.stand.field_mm
        if abs(info.columns * height / (info.rows * width) - 1) > 0.02 + 1 / min(info.rows, info.columns):
            raise TileError(
                f"{tile.artwork}/{tile.name}: frames: {info.columns} x {info.rows} px are not of the shape of "
                f"the stand's field ({width:g} x {height:g} mm); turn or crop the photographs as the camera saw "
                "the field, or correct field_mm in the stand's file"
            )
        size = tile.stand.field_mm[0] / info.columns
        return PixelGrid(info.rows, info.columns, size, (camera[0], camera[1], camera[2]))
    if tile.pixel_size_mm is not None:
        return PixelGrid(info.rows, info.columns, tile.pixel_size_mm)
    return PixelGrid(info.rows, info.columns, 1.0, unit="px")
