"""What is measured, and on what: the bundled algorithms of a kind, and the real data beside the repository."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from nlights_core.algorithms import Algorithm
from nlights_core.registry import installed

DATA = Path(__file__).parents[1].parent / "shared" / "data"

Kind = TypeVar("Kind", bound=Algorithm)


def bundled(kind: type[Kind]) -> dict[str, type[Kind]]:
    """Every algorithm of a kind that comes with nLights, by name; other people's plugins are left out."""
    return {
        offer.algorithm.name: offer.algorithm
        for offer in installed().offers(kind.slot)
        if offer.distribution == "nlights" and issubclass(offer.algorithm, kind)
    }


def present(*names: str) -> Path | None:
    """A folder or file of the real data, or None and a line that says so."""
    path = DATA.joinpath(*names)
    if path.exists():
        return path
    print(f"  skipped: {'/'.join(names)} is not beside the repository")
    return None
