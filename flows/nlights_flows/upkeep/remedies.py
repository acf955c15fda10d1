"""Remedies: the commands that make again what was damaged and cannot be restored."""

from __future__ import annotations

import glob
import json
import shlex
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

from nlights_core.configurations import shipped_names
from nlights_core.errors import NlightsError
from nlights_core.products.writing import PROVENANCE
from nlights_core.recipe import load_recipe
from nlights_core.stages.inputs import FLATS
from nlights_core.store import RECORD
from nlights_core.store.records import read_sealed
from nlights_flows.upkeep.repair import report_of

MANIFEST = "artwork.yaml"


class Remedies:
    """Finder of commands, for an output folder and its store."""

    def __init__(self, out: Path, store: Path) -> None:
        self.out, self.store = out, store

    def command(self, artwork: str, tile: str) -> str:
        """Command that makes a tile again, by the names of its artwork's folder and of the tile.

        What nobody can tell any more stands in capitals, and is explained behind the command.
        """
        recipe, stages = self._made(artwork, tile)
        capture = self._capture(artwork, tile, stages)
        words = ["nlights", "digitise", str(capture) if capture else "CAPTURE"]
        notes = [] if capture else [f"CAPTURE: the folder of the artwork {artwork}"]
        if tile != FLATS:
            words += ["--tile", tile]
        name, note = _recipe(recipe)
        words += ["--recipe", name] if name != "default" else []
        notes += [note] if note else []
        words += ["--out", str(self.out)]
        if self.store.absolute() != (self.out / ".store").absolute():
            words += ["--store", str(self.store)]
        if any(stage["facts"].get("compression") == "zstd" for stage in stages):
            words += ["--compression", "zstd"]
        return shlex.join(words) + (f"   # {'; '.join(notes)}" if notes else "")

    def _made(self, artwork: str, tile: str) -> tuple[dict[str, Any] | None, list[dict[str, Any]]]:
        """Recipe and stages that made a tile's products, as far as it can still be read."""
        name = "*" if tile == FLATS else tile
        for products in sorted(self.out.glob(f"**/{glob.escape(artwork)}/{name}")):
            report = report_of(products, self.store)
            for folder in (products, *([report] if report else ())):
                with suppress(OSError, ValueError):
                    made = read_sealed(folder / PROVENANCE)
                    return made["recipe"], made["stages"]
            if report:
                with suppress(OSError, ValueError):
                    return read_sealed(report / RECORD)["facts"]["recipe"], []
        reports = list(self.store.glob(f"{glob.escape(artwork)}/{name}/report-*/{RECORD}"))
        if len(reports) == 1:
            with suppress(OSError, ValueError):
                return read_sealed(reports[0])["facts"]["recipe"], []
        return None, []

    def _capture(self, artwork: str, tile: str, stages: Iterable[dict[str, Any]]) -> Path | None:
        """Folder of the capture that a tile was made of, if it is where it was."""
        for stage in (*stages, *self._stages(artwork, tile)):
            for which in ("frames", "flats"):
                for digest in (stage["facts"].get(which) or {}).values():
                    for folder in self._photographs.get(digest, Path()).parents:
                        if (folder / MANIFEST).is_file():
                            return folder
        return None

    def _stages(self, artwork: str, tile: str) -> Iterator[dict[str, Any]]:
        """Records of a tile's artefacts that can be read."""
        for path in self.store.glob(f"{glob.escape(artwork)}/{tile}/*/{RECORD}"):
            with suppress(OSError, ValueError):
                yield read_sealed(path)

    @cached_property
    def _photographs(self) -> dict[str, Path]:
        """Files whose digests the store remembers."""
        found = {}
        for memory in (self.store / ".digests").glob("*"):
            with suppress(OSError, ValueError):
                _, digest, path = memory.read_text(encoding="utf-8").split("\n", 2)
                found[digest] = Path(path)
        return found


def _recipe(said: dict[str, Any] | None) -> tuple[str, str]:
    """Words for a recipe in a command, and an explanation where the recipe is no shipped one."""
    if said is None:
        return "RECIPE", "RECIPE: the one that the tile was made with"
    name = said["name"]
    with suppress(NlightsError):
        # Through JSON, as the record went.
        if name in shipped_names("recipes") and said == {"name": name} | json.loads(
            json.dumps(load_recipe(name).record())
        ):
            return str(name), ""
    return f"{name}.yaml", f"{name}.yaml: the recipe that the tile was made with, in {PROVENANCE} too"
