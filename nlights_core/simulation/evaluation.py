"""Evaluation of products: how far they are from a simulated capture's truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

from nlights_core.errors import CaptureError, NlightsError, TileError
from nlights_core.frames import Array


def angles_between(first: Array, second: Array) -> Array:
    """Angles between vectors, degrees, accurate even where they are tiny.

    ``atan2(|a x b|, a . b)``: the arc cosine of the scalar product alone loses everything below
    0.02 degrees to the rounding of float32.

    Parameters
    ----------
    first, second : (..., 3) arrays
        Of any length but zero; NaN gives NaN.

    Returns
    -------
    (...) float64 array
    """
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(across, np.sum(a * b, axis=-1))))


def covered(errors: Array, stated: Array) -> tuple[int, int]:
    """Count how many errors are no larger than their stated uncertainty.

    Parameters
    ----------
    errors : array
        Not negative.
    stated : array of the same shape
        Standard uncertainties in the errors' unit; NaN where none is stated.

    Returns
    -------
    within, of : int
        Errors within their uncertainty, of those for which one is stated.

    Examples
    --------
    >>> covered(np.array([0.1, 0.3, 9.0]), np.array([0.2, 0.2, np.nan]))
    (1, 2)
    """
    said = np.isfinite(stated)
    return int(np.count_nonzero(errors[said] <= stated[said])), int(np.count_nonzero(said))


NUMBERS = (
    "angle_mean_deg",
    "angle_median_deg",
    "angle_p95_deg",
    "normals_coverage",
    "height_rms_mm",
    "height_max_mm",
    "height_coverage",
)
"""What is measured over the pixels that the products know."""


def evaluate(products: Path, truth: Path) -> dict[str, float]:
    """Compare the normals and heights of a tile with the truth of a simulated capture.

    Parameters
    ----------
    products : Path
        Folder with the ``normals.tif`` (H, W, 3) and ``height.tif`` (H, W, mm) of a tile.  Where
        it holds ``confidence.tif`` (H, W, degrees) and ``height_uncertainty.tif`` (H, W, mm) too,
        their coverage is measured.
    truth : Path
        The simulated capture's folder ``truth``, with normals and height under the same names.

    Returns
    -------
    dict of str to float
        ``angle_mean_deg``, ``angle_median_deg``, ``angle_p95_deg``: angle between the normals;
        ``height_rms_mm``, ``height_max_mm``: deviation of the heights after the best constant is
        removed (a tilt or a bow is an error); ``normals_coverage``, ``height_coverage``: share of
        these angles and deviations that are no larger than the uncertainty stated for their pixel,
        0.68 where it is stated rightly; ``known_share``: share of the truth's pixels whose normal
        and height the products know.  The other figures are over these pixels; NaN where there
        is none, and where no uncertainty is stated: not measured.

    Raises
    ------
    TileError
        When a product is missing or unreadable, or differs from the truth in size.
    CaptureError
        When the truth is missing or unreadable.
    """
    normals, height = (_read(products / name, TileError) for name in ("normals.tif", "height.tif"))
    true_normals, true_height = (_read(truth / name, CaptureError) for name in ("normals.tif", "height.tif"))
    for name, found, right in (
        ("normals.tif", normals, true_normals),
        ("height.tif", height, true_height),
    ):
        if found.shape != right.shape:
            raise TileError(
                f"{products / name}: has the size {found.shape}, but the truth in {truth} has {right.shape}; "
                "compare products of this capture at full resolution"
            )
    in_truth = np.isfinite(true_height) & np.isfinite(true_normals).all(axis=-1)
    known = in_truth & np.isfinite(height) & np.isfinite(normals).all(axis=-1)
    if not known.any():
        return {**dict.fromkeys(NUMBERS, float("nan")), "known_share": 0.0}
    angles = np.concatenate(
        [angles_between(n[k], t[k]) for n, t, k in zip(normals, true_normals, known, strict=True)]
    )
    deviation = height[known].astype(np.float64) - true_height[known]
    deviation -= deviation.mean()
    deviation = np.abs(deviation)
    return {
        "angle_mean_deg": float(angles.mean()),
        "angle_median_deg": float(np.median(angles)),
        "angle_p95_deg": float(np.percentile(angles, 95)),
        "normals_coverage": _coverage(angles, products / "confidence.tif", known),
        "height_rms_mm": float(np.sqrt(np.mean(deviation**2))),
        "height_max_mm": float(deviation.max()),
        "height_coverage": _coverage(deviation, products / "height_uncertainty.tif", known),
        "known_share": float(known.sum() / in_truth.sum()),
    }


def _coverage(errors: Array, path: Path, known: Array) -> float:
    """Share of the errors at the known pixels that a map of uncertainties covers; NaN where there is no map."""
    if not path.exists():
        return float("nan")
    stated = _read(path, TileError)
    if stated.shape != known.shape:
        raise TileError(
            f"{path}: has the size {stated.shape}, but the height beside it has {known.shape}; make the products anew"
        )
    within, of = covered(errors, stated[known])
    return within / of if of else float("nan")


def _read(path: Path, fault: type[NlightsError]) -> Array:
    """A TIFF as an array."""
    if not path.is_file():
        raise fault(f"{path}: is missing; name the folder that holds it")
    try:
        return np.asarray(tifffile.imread(path))
    except (tifffile.TiffFileError, ValueError) as reason:
        raise fault(f"{path}: is no readable TIFF ({reason}); make it anew") from reason
