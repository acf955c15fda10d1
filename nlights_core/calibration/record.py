"""Record of a calibration in the store: ``calibration.json``, and maps on coarse blocks."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nlights_core.calibration.fitting import Calibration
from nlights_core.calibration.uncertainty import SmoothErrors
from nlights_core.calibration.unknowns import Shared, from_vector, nothing
from nlights_core.files.arrays import write_array
from nlights_core.frames import Array, PixelGrid
from nlights_core.near_light.overview import block_edge

MISFIT, OF_NOISE = 0.001, 3.0
"""Smoothed residual, as a share of the albedo and of what noise alone leaves, above which the model does not fit and
no level is stated.  Sound captures leave 0.0003 to 0.0007."""

LARGEST = 0.3
"""Uncertainty of a level above which it counts as not measured, mm."""

NOISIER = 2.5
"""Times the variance of the flats' noise above which the photographs' is another.  Sound captures have 0.9 to 1.1,
flats that are means of four exposures 4; a camera that moved by a pixel between lamps makes 2."""

CHANCE = 2.0
"""As many times what noise explains must the difference be as well."""

MODEL = 0.015
"""Share of a level by which the model is wrong: lamps that are extended, a flat that is smoothed."""


@dataclass(frozen=True)
class TwoAnswers:
    """Difference of the heights by two halves of the lamps.

    Attributes
    ----------
    difference : float
        After the best constant, rms, without what noise explains, mm.
    noise : float
        What noise explains, mm.
    low, high : tuple of str
        The lamps of each half.
    rings : bool
        Whether the halves are the low and the high lamps.
    limit : float
        Difference above which something is wrong, mm.
    """

    difference: float
    noise: float
    low: tuple[str, ...]
    high: tuple[str, ...]
    rings: bool
    limit: float

    @property
    def disagree(self) -> bool:
        """Test whether the halves differ by more than a sound capture and its noise explain."""
        return self.difference > max(self.limit, CHANCE * self.noise)


@dataclass(frozen=True)
class Known:
    """Knowledge of a tile as a whole.

    Attributes
    ----------
    shared : Shared
    level_uncertainty : float or None
        Standard uncertainty of the level, mm; None: it was not measured.
    believed : tuple of str
        Groups of which there is evidence.
    residual : float or None
        Smoothed residual, as a share of the albedo; None: nothing was sought.
    misfit : bool
        Whether it is too large: the model does not fit.
    strange : float or None
        Share of the pixels that are of another material than most.
    unreached : float
        Share of the samples whose ray misses the photographed flat.
    answers : TwoAnswers or None
        How far heights by the low and by the high lamps differ; None: there are no two halves that can measure.
    noisier : float or None
        Variance of the photographs' noise over that of the flats; None: noise is stated, or cannot be compared.
    positions : float or None
        Standard uncertainty of each coordinate of each lamp where there is evidence that it is larger than the
        stand's file states, mm; None: there is none.
    """

    shared: Shared
    level_uncertainty: float | None
    believed: tuple[str, ...]
    residual: float | None
    misfit: bool
    strange: float | None
    unreached: float
    answers: TwoAnswers | None = None
    noisier: float | None = None
    positions: float | None = None


def write_calibration(
    folder: Path,
    found: Calibration,
    errors: SmoothErrors,
    missed: float,
    answers: TwoAnswers | None,
    noisier: float | None,
) -> None:
    """Write ``calibration.json``, ``height.npy`` of the reduced photographs, and ``uncertainty.npy`` (3, h, w).

    ``missed`` is the share of the samples whose ray misses the photographed flat; ``answers``, how far heights by two
    halves of the lamps differ; ``noisier``, how noisy they are against the flats.
    """
    misfit = errors.residual > max(MISFIT, OF_NOISE * errors.noise)
    wide = float(np.hypot(np.sqrt(found.covariance[0, 0]), MODEL * found.shared.level))
    record = {
        "lamps": len(found.shared.strengths),
        "values": found.shared.vector().tolist(),
        "roughnesses": found.shared.roughnesses.tolist(),
        "grazing": found.shared.grazing,
        "level_uncertainty_mm": wide
        if "level" in found.believed and wide <= LARGEST and not misfit
        else None,
        "misfit": misfit,
        "believed": list(found.believed),
        "residual": errors.residual,
        "strange": float(found.strange.mean()),
        "unreached": missed,
        "answers": asdict(answers) if answers else None,
        "noisier": noisier,
        "positions_mm": found.positions,
    }
    (folder / "calibration.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    write_array(folder / "height.npy", found.height)
    write_array(folder / "uncertainty.npy", np.stack([errors.height, errors.slope, errors.noisier]))


def write_nothing(folder: Path, lamps: int, grid: PixelGrid, noisier: float | None) -> None:
    """Write a calibration that found nothing, of a surface in the plane of the flat; its uncertainty is not known.

    ``noisier``: as for `write_calibration`.
    """
    record = {
        "lamps": lamps,
        "values": nothing(lamps).vector().tolist(),
        "roughnesses": nothing(lamps).roughnesses.tolist(),
        "grazing": nothing(lamps).grazing,
        "level_uncertainty_mm": None,
        "misfit": False,
        "believed": [],
        "residual": None,
        "strange": None,
        "unreached": 0.0,
        "answers": None,
        "noisier": noisier,
        "positions_mm": None,
    }
    (folder / "calibration.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    edge = block_edge(grid.columns)
    write_array(folder / "height.npy", np.zeros((grid.rows // edge, grid.columns // edge), np.float32))
    write_array(folder / "uncertainty.npy", np.full((3, 1, 1), np.nan, np.float32))


def read_calibration(folder: Path) -> Known:
    """Read what `write_calibration` wrote."""
    record = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    shared = from_vector(np.array(record["values"]), record["lamps"])
    return Known(
        replace(shared, roughnesses=np.array(record["roughnesses"]), grazing=record["grazing"]),
        record["level_uncertainty_mm"],
        tuple(record["believed"]),
        record["residual"],
        record["misfit"],
        record["strange"],
        record["unreached"],
        _answers(record["answers"]),
        record["noisier"],
        record["positions_mm"],
    )


def _answers(record: dict[str, Any] | None) -> TwoAnswers | None:
    if record is None:
        return None
    return TwoAnswers(**{**record, "low": tuple(record["low"]), "high": tuple(record["high"])})


def read_uncertainty(folder: Path) -> Array:
    """Uncertainty of height (mm) and slope, and the factor of the noise, on coarse blocks, (3, h, w) float32."""
    return np.asarray(np.load(folder / "uncertainty.npy"))
