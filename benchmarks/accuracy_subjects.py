"""What is measured, and on what: the bundled algorithms of a kind, and the real data beside the repository."""

from __future__ import annotations

from pathlib import Path

from nlights_core.algorithms import Algorithm, Integrator, NormalSolver
from nlights_core.registry import installed

DATA = Path(__file__).parents[1].parent / "shared" / "data"


def solvers() -> dict[str, type[NormalSolver]]:
    """The normal solvers that come with nLights, by name."""
    return {a.name: a for a in _bundled("normals") if issubclass(a, NormalSolver)}


def integrators() -> dict[str, type[Integrator]]:
    """The integrators that come with nLights, by name."""
    return {a.name: a for a in _bundled("integrator") if issubclass(a, Integrator)}


def _bundled(slot: str) -> list[type[Algorithm]]:
    """The algorithms of a slot; other people's plugins are left out."""
    return [offer.algorithm for offer in installed().offers(slot) if offer.distribution == "nlights"]


def present(*names: str) -> Path | None:
    """A folder or file of the real data, or None and a line that says so."""
    path = DATA.joinpath(*names)
    if path.exists():
        return path
    print(f"  skipped: {'/'.join(names)} is not beside the repository")
    return None
