"""File headers: what photographs say of themselves, where somebody should know how it is taken."""

from __future__ import annotations

from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.photographs.images import ImageInfo, probe


def header_warnings(tile: Tile) -> list[CaptureWarning]:
    """Warn of what the headers of a tile's photographs say, and how it is taken; no pixel is read.

    Parameters
    ----------
    tile : Tile
        Its frames, flats and dark frame are asked.

    Returns
    -------
    list of CaptureWarning
        Code ``profile``: the tone curve of the embedded profile is undone, and the manifest does not say so.
        Code ``jpeg``: JPEGs without a profile are taken as linear light.  Code ``pages``: a TIFF has several full
        pages; the value is their number.

    Raises
    ------
    TileError
        When a photograph is missing or unreadable.
    """
    paths = [(lamp, path) for lamps in (tile.frames, tile.flats or {}) for lamp, path in lamps.items()]
    files = [
        (lamp, path, probe(path, tile.encoding))
        for lamp, path in (*paths, *([("", tile.dark)] if tile.dark else []))
    ]
    return [*_of_curves(tile, files), *_of_pages(files)]


def _of_curves(tile: Tile, files: list[tuple[str, Path, ImageInfo]]) -> list[CaptureWarning]:
    """Warn of tone curves that are undone, or of which nothing is known, where the manifest is silent."""
    if tile.encoding.transfer is not None:
        return []
    frames = files[: len(tile.frames)]
    warnings = []
    if curves := list(dict.fromkeys(info.curve.name for _, _, info in frames if info.curve)):
        warnings.append(
            CaptureWarning(
                "profile",
                f"the tone curve of {curves[0]} is undone, the profile of {frames[0][1].name} and the others; "
                "state encoding: {transfer: icc} if that is meant, or {transfer: linear} if their numbers are light",
            )
        )
    bare = [
        (lamp, path)
        for lamp, path, info in frames
        if path.suffix.lower() in (".jpg", ".jpeg") and not info.curve and not info.icc
    ]
    if bare:
        warnings.append(
            CaptureWarning(
                "jpeg",
                f"{bare[0][1].name}: a JPEG without a profile is taken as linear light, which few are; state "
                "encoding: {transfer: srgb} (or linear) in the manifest",
                tuple(lamp for lamp, _ in bare) if len(bare) < len(frames) else (),
            )
        )
    return warnings


def _of_pages(files: list[tuple[str, Path, ImageInfo]]) -> list[CaptureWarning]:
    """Warn of TIFFs with several full pages, once for those with the same."""
    found: dict[tuple[str, ...], list[tuple[str, Path]]] = {}
    for lamp, path, info in files:
        if info.pages:
            found.setdefault(info.pages, []).append((lamp, path))
    warnings = []
    for pages, alike in found.items():
        more = f" and {len(alike) - 1} more" if len(alike) > 1 else ""
        names = f"{', '.join(pages[1:4])}{' and more' if len(pages) > 4 else ''}"
        warnings.append(
            CaptureWarning(
                "pages",
                f"{alike[0][1]}{more}: holds {len(pages)} full pages, of which {pages[0]} is read, the first of "
                f"the largest; not read: {names}; export each photograph as a file of one page if another is meant",
                tuple(dict.fromkeys(lamp for lamp, _ in alike if lamp)),
                len(pages),
                "pages",
            )
        )
    return warnings
