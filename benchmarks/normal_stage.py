"""Megapixels a second of the normal stage alone: photographs read and solved, nothing written.

Run: python benchmarks/normal_stage.py CAPTURE STORE [--rounds N]
The store is that of a run that digitised the capture with the default recipe.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections import deque
from functools import partial
from pathlib import Path

from nlights_core.agreement import AgreementMeter
from nlights_core.arrays import read_array
from nlights_core.development import darkroom
from nlights_core.fields import LightField
from nlights_core.fused_solving import FusedSolver
from nlights_core.kernels import kernel_of
from nlights_core.least_squares import UsableLights
from nlights_core.levelling import read_level
from nlights_core.manifest import load_capture
from nlights_core.noise import read_noise
from nlights_core.overview import Enlarged, block_edge
from nlights_core.plates import read_plate
from nlights_core.registry import installed
from nlights_core.solving import SHADOW, solved
from nlights_core.stages import FLATS
from nlights_core.surveys import grid_of, survey

SOLVERS = ("least-squares", "robust")


def main() -> None:
    """Print the median of some rounds for both bundled solvers that have a kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    wanted = parser.parse_args()
    for name in SOLVERS:
        found = rates(wanted.capture, wanted.store, name, wanted.rounds)
        print(f"{name}: {statistics.median(found):.1f} Mpx/s (" + ", ".join(f"{r:.1f}" for r in found) + ")")


def rates(capture: Path, store: Path, name: str, rounds: int) -> list[float]:
    """Megapixels a second of so many rounds, after one that is not counted (it may have to compile)."""
    tile = load_capture(capture)[0]
    offer = installed().get("normals", name)
    assert offer is not None
    solver = offer.algorithm()
    own, flats = store / tile.artwork / tile.name, store / tile.artwork / FLATS
    plate, overview = (
        next(folder.glob(f"{stage}-*")) for folder, stage in ((flats, "plate"), (own, "overview"))
    )
    lights = next(own.glob("lights-*")) / "lights.json"
    field = LightField.from_record(json.loads(lights.read_text())).stronger(read_level(overview).strengths)
    shape = grid_of(tile, survey(tile)).shape
    height = Enlarged(read_array(overview / "height.npy"), block_edge(shape[1]), shape)
    found = []
    for _ in range(rounds + 1):
        with tempfile.TemporaryDirectory() as scratch, darkroom(tile, Path(scratch)) as room:
            room.noise = read_noise(plate) or room.noise
            kernel = kernel_of(solver)
            assert kernel, f"{name} has no kernel"
            assert isinstance(solver, UsableLights)
            fused = FusedSolver(room, solver, kernel, field, read_plate(plate), height, SHADOW, 1.0)
            started = time.monotonic()
            deque(fused.strips(AgreementMeter(room.grid, partial(solved, solver))), 0)
            found.append(shape[0] * shape[1] / 1e6 / (time.monotonic() - started))
    return found[1:]


if __name__ == "__main__":
    main()
