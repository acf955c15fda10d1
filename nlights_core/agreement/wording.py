"""Wording: how warnings name files."""

from __future__ import annotations

from collections.abc import Sequence

from nlights_core.capture import Tile


def frame_name(tile: Tile, lamp: str) -> str:
    """Name of the photograph of the artwork under a lamp."""
    return tile.frames[lamp].name


def flat_name(tile: Tile, lamp: str) -> str:
    """Name of the photograph of the flat under a lamp, with its folder: the files are often named alike."""
    if tile.flats is None:
        return f"flat of {lamp}"
    path = tile.flats[lamp]
    return f"{path.parent.name}/{path.name}"


def listed(words: Sequence[str]) -> str:
    """Words as people list them: a, b and c."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
