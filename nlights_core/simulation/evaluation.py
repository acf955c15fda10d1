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


def evaluate(products: Path, truth: Path) -> dict[str, float]:
    """Compare the normals and heights of a tile with the truth of a simulated capture.

    Parameters
    ----------
    products : Path
        Folder with the ``normals.tif`` (H, W, 3) and ``height.tif`` (H, W, mm) of a tile.
    truth : Path
        The simulated capture's folder ``truth``, with files of the same names.

    Returns
    -------
    dict of str to float
        ``angle_mean_deg``, ``angle_median_deg``, ``angle_p95_deg``: angle between the normals;
        ``height_rms_mm``, ``height_max_mm``: deviation of the heights after the best constant is
        removed (a tilt or a bow is an error); ``known_share``: share of the truth's pixels whose
        normal and height the products know.  The other figures are over these pixels; NaN where
        there is none.

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
        names = ("angle_mean_deg", "angle_median_deg", "angle_p95_deg", "height_rms_mm", "height_max_mm")
        return {**dict.fromkeys(names, float("nan")), "known_share": 0.0}
    angles = np.concatenate(
        [angles_between(n[k], t[k]) for n, t, k in zip(normals, true_normals, known, strict=True)]
    )
    deviation = height[known].astype(np.float64) - true_height[known]
    deviation -= deviation.mean()
    return {
        "angle_mean_deg": float(angles.mean()),
        "angle_median_deg": float(np.median(angles)),
        "angle_p95_deg": float(np.percentile(angles, 95)),
        "height_rms_mm": float(np.sqrt(np.mean(deviation**2))),
        "height_max_mm": float(np.abs(deviation).max()),
        "known_share": float(known.sum() / in_truth.sum()),
    }


def _read(path: Path, fault: type[NlightsError]) -> Array:
    """A TIFF as an array."""
    if not path.is_file():
        raise fault(f"{path}: is missing; name the folder that holds it")
    try:
        return np.asarray(tifffile.imread(path))
    except (tifffile.TiffFileError, ValueError) as reason:
        raise fault(f"{path}: is no readable TIFF ({reason}); make it anew") from reason
