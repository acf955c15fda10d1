"""Speed of the two stages that physics is in: the normal stage alone, and the integration.

Run: python benchmarks/stage_rates.py CAPTURE STORE [--rounds N]
The store is that of a run that digitised the capture with the default recipe.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy.fft

from nlights_core.calibration.correction import known_lights
from nlights_core.calibration.record import read_calibration
from nlights_core.calibration.sampling import flat_field_of
from nlights_core.fields import LightField, NormalField
from nlights_core.files.arrays import read_array
from nlights_core.manifest import load_capture
from nlights_core.near_light.overview import Enlarged, block_edge
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.photographs.noise import read_noise
from nlights_core.registry import installed
from nlights_core.solving.agreement import AgreementMeter
from nlights_core.solving.band_solving import SHADOW, solve_band
from nlights_core.solving.fused_solving import FusedSolver
from nlights_core.solving.kernels import rule_of
from nlights_core.stages.inputs import FLATS

SOLVERS = ("least-squares", "robust", "progressive", "rank-trim", "median-of-triplets")


def main() -> None:
    """Print medians of some rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    wanted = parser.parse_args()
    for name in SOLVERS:
        print(
            f"{name}: {normals_rate(wanted.capture, wanted.store, name, wanted.rounds):.1f} Mpx/s", flush=True
        )
    print(
        f"simchony: {integration_ratio(wanted.capture, wanted.store, wanted.rounds):.2f} x two raw transforms"
    )


def normals_rate(capture: Path, store: Path, name: str, rounds: int = 3) -> float:
    """Megapixels a second, photographs read and solved, nothing written: median after a round that may compile."""
    tile = load_capture(capture)[0]
    offer = installed().get("normals", name)
    assert offer is not None
    solver = offer.algorithm()
    own, flats = store / tile.folder / tile.name, store / tile.folder / FLATS
    flat_field, calibration = (
        next(folder.glob(f"{stage}-*")) for folder, stage in ((flats, "flat_field"), (own, "calibration"))
    )
    lights = next(own.glob("lights-*")) / "lights.json"
    shared, divisor = read_calibration(calibration).shared, read_flat_field(flat_field)
    given = LightField.from_record(json.loads(lights.read_text()))
    field, divisor = known_lights(given, divisor, shared), flat_field_of(divisor, given, shared)
    shape = grid_of(tile, survey(tile)).shape
    height = Enlarged(read_array(calibration / "height.npy"), block_edge(shape[1]), shape)
    found = []
    for _ in range(rounds + 1):
        with tempfile.TemporaryDirectory() as scratch, darkroom(tile, Path(scratch)) as room:
            room.noise = read_noise(flat_field) or room.noise
            assert rule_of(solver), f"{name} has no kernel"
            fused = FusedSolver(room, solver, field, divisor, height, SHADOW, 1.0)
            started = time.monotonic()
            deque(fused.strips(AgreementMeter(room.grid, partial(solve_band, solver))), 0)
            found.append(shape[0] * shape[1] / 1e6 / (time.monotonic() - started))
    return statistics.median(found[1:])


def integration_ratio(capture: Path, store: Path, rounds: int = 3) -> float:
    """Time of `simchony` from normals in memory, over that of two raw cosine transforms of the same size: median."""
    tile = load_capture(capture)[0]
    offer = installed().get("integrator", "simchony")
    assert offer is not None
    source = next((store / tile.folder / tile.name).glob("normals-*"))
    normals, confidence = (np.array(read_array(source / f"{name}.npy")) for name in ("normals", "confidence"))
    field = NormalField(normals, grid_of(tile, survey(tile)), confidence)
    ratios = []
    for _ in range(rounds + 1):
        started = time.monotonic()
        offer.algorithm().integrate(field)
        seconds = time.monotonic() - started
        ratios.append(seconds / raw_transforms(normals.shape[:2]))
    return statistics.median(ratios[1:])


def raw_transforms(shape: Sequence[int]) -> float:
    """Seconds of a cosine transform there and back, in place, single precision, all cores."""
    field = np.random.default_rng(0).standard_normal(shape, np.float32)
    started = time.monotonic()
    field = scipy.fft.dctn(field, overwrite_x=True, workers=os.cpu_count())
    scipy.fft.idctn(field, overwrite_x=True, workers=os.cpu_count())
    return time.monotonic() - started


if __name__ == "__main__":
    main()
