"""Surveys: whether a tile's photographs fit together, and where their pixels are on the plane."""

from __future__ import annotations

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.frames import PixelGrid
from nlights_core.photographs.images import ImageInfo, probe


def survey(tile: Tile) -> ImageInfo:
    """Read the headers of all photographs of a tile and see that they fit together.

    Returns
    -------
    ImageInfo
        Of the frames, which are all alike.

    Raises
    ------
    TileError
        Naming the photograph that is missing, unreadable, or of another size or type.
    """
    frames = {f"frames.{lamp}": path for lamp, path in tile.frames.items()}
    first_field, first_path = next(iter(frames.items()))
    first = probe(first_path, tile.encoding)
    flats = {f"flats.{lamp}": path for lamp, path in (tile.flats or {}).items()}
    dark = {"dark": tile.dark} if tile.dark else {}
    for name, path in {**frames, **flats, **dark}.items():
        info = probe(path, tile.encoding)
        for what, found, expected in (
            ("size", f"{info.columns} x {info.rows} px", f"{first.columns} x {first.rows} px"),
            ("depth", f"{info.channels} x {info.dtype}", f"{first.channels} x {first.dtype}"),
        ):
            if found != expected:
                raise TileError(
                    f"{path}: {name}: {what} {found}, but {first_field} ({first_path.name}) has {expected}; "
                    "all photographs of a tile must be alike: photograph or export it again"
                )
    if tile.mask:
        info = probe(tile.mask)
        if (info.rows, info.columns) != (first.rows, first.columns):
            raise TileError(
                f"{tile.mask}: mask: size {info.columns} x {info.rows} px, but the frames have "
                f"{first.columns} x {first.rows} px; draw the mask on a frame"
            )
    return first


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
