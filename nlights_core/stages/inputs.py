"""Inputs of several stages: photographs, as facts of a key, and lights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.machine.band_threads import in_order
from nlights_core.photographs.headers import survey
from nlights_core.photographs.shifted import Shift, shifts_by_lamp
from nlights_core.store import ArtefactRef, Store

FLATS = "_flats"
"""Where artefacts go that belong to a flat set, not to a tile; no tile can have this name."""


def facts_of_photographs(store: Store, tile: Tile, which: str) -> dict[str, Any]:
    """Digests and settings of the photographs that a stage reads."""
    paths = tile.flats if which == "flats" else tile.frames
    if paths is None:
        raise TileError(
            f"{tile.artwork}/{tile.name}: flats: the recipe needs photographs of a flat (a flat white board); add "
            "flats to artwork.yaml, or choose another detrend.images (inverse-square)"
        )
    stand = tile.stand
    digests = dict(zip(paths, in_order(store.digest, paths.values()), strict=True))
    seen: dict[str, str] = {}
    for lamp, digest in digests.items():
        if digest in seen:
            raise TileError(
                f"{paths[lamp]}: {which}.{lamp}: is the very photograph of {seen[digest]} "
                f"({paths[seen[digest]].name}); name the one that was taken under {lamp}"
            )
        seen[digest] = lamp
    stated = {"flats_averaged": tile.flats_averaged} if which == "flats" else {}
    return stated | {
        which: digests,
        "dark": store.digest(tile.dark) if tile.dark else None,
        "mask": _mask(store, tile) if which == "frames" else None,
        "encoding": tile.encoding.model_dump(mode="json"),
        "sensor": tile.sensor.model_dump(mode="json") if tile.sensor else None,
        "field_mm": stand.field_mm if stand else None,
        "camera": stand.camera_position.tolist() if stand else None,
        "pixel_size_mm": tile.pixel_size_mm,
    }


def with_mask(store: Store, tile: Tile) -> Tile:
    """The same tile, the path of its mask whole: one that was found here lies in the store."""
    if tile.mask is None or tile.mask.is_absolute():
        return tile
    return tile.model_copy(update={"mask": store.root.absolute() / tile.mask})


def _mask(store: Store, tile: Tile) -> str | None:
    """Name of a mask for a key: its digest, or of one that was found here the name of its artefact."""
    if tile.mask is None:
        return None
    return tile.mask.parent.name if tile.auto_mask else store.digest(tile.mask)


def size(tile: Tile) -> list[int]:
    """Rows and columns of a tile's photographs."""
    info = survey(tile)
    return [info.rows, info.columns]


def read_lights(store: Store, ref: ArtefactRef) -> LightField:
    """Open the artefact of `lights`."""
    return LightField.from_record(json.loads((store.path(ref) / "lights.json").read_text()))


def write_json(path: Path, value: Any) -> None:
    """Write a small JSON file."""
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def shifts_of(store: Store, alignment: ArtefactRef | None) -> dict[str, Shift]:
    """Shifts to take out of photographs, by lamp; none where nobody asked."""
    if alignment is None:
        return {}
    return shifts_by_lamp(store.path(alignment))
