"""The stage that writes the products that are images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.calibration.record import read_uncertainty
from nlights_core.capture import Tile
from nlights_core.files.arrays import read_array
from nlights_core.files.tiffs import Compression
from nlights_core.machine.progress import Progress
from nlights_core.photographs.headers import grid_of, survey
from nlights_core.products.writing import open_maps, white_reflectance, write_maps
from nlights_core.store import ArtefactRef, Store, Work, describe

RESTS_ON = ("calibration", "near_light", "photographs", "products", "solving")
"""Departments whose code decides the result, beside what all results rest on."""


def maps(
    store: Store,
    tile: Tile,
    normals: ArtefactRef,
    height: ArtefactRef,
    trend: ArtefactRef | None,
    integrated: ArtefactRef | None = None,
    perspective: bool = False,
    compression: Compression = "none",
    calibration: ArtefactRef | None = None,
) -> Work:
    """Products that are images: normals, albedo, reflection, height, confidence, trend.

    ``integrated`` is the height of these normals before anything was done to it, where they shall
    be made integrable with it, and ``perspective`` says whether its integrator followed the rays
    of the camera.  ``compression`` is that of the TIFFs, "none" or "zstd".  With a ``calibration`` the height's
    uncertainty is known, and the normals' grows by what all pixels share.
    """
    inputs = {"normals": normals, "height": height, "trend": trend, "integrated": integrated}
    if calibration:
        inputs["calibration"] = calibration
    facts: dict[str, Any] = {"perspective": perspective}
    if compression != "none":
        facts["compression"] = compression
    ref, record = describe("maps", tile.artwork, tile.name, rests_on=RESTS_ON, inputs=inputs, facts=facts)

    def make(folder: Path, progress: Progress) -> None:
        shared = read_uncertainty(store.path(calibration)) if calibration else None
        write_maps(
            folder,
            open_maps(store, normals, height, trend),
            grid_of(tile, survey(tile)),
            coloured=store.path(normals),
            absolute=white_reflectance(store, normals) is not None,
            progress=progress,
            integrated=read_array(store.path(integrated) / "height.npy") if integrated else None,
            perspective=perspective,
            compression=compression,
            shared=shared if shared is not None and np.isfinite(shared).all() else None,
        )

    return Work(ref, record, make)
