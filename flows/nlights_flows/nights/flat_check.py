"""The Prefect flow `flat-check`: the flat measured as if it were an artwork, and how flat it is."""

# No `from __future__ import annotations` here: Prefect resolves the parameters' types itself.
import json
import logging
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from prefect import flow, get_run_logger
from prefect.exceptions import MissingContextError
from prefect.states import Completed, Failed

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.files.tiffs import read_tiff
from nlights_core.frames import Array
from nlights_core.manifest import load_capture
from nlights_core.photographs.images import Photograph, grey, reduce_photograph
from nlights_core.store import write_whole
from nlights_flows.tiles.digitise import digitise

SAMPLES = 1000
"""Largest number of rows and of columns that are looked at; a larger map is thinned evenly."""

BLOCK = 16
"""Edge of the blocks over which a photograph's level is averaged before its median is taken, px."""


@flow(name="flat-check", persist_result=False, validate_parameters=True)
def flat_check(
    artwork: str,
    out: str = "products",
    recipe: str = "default",
    store: str | None = None,
    height_range_mm: float = 1.0,
    normals_rms_deg: float = 0.5,
    level_percent: float = 5.0,
) -> Any:
    """Digitise a capture of the flat and state how flat it comes out.

    Parameters
    ----------
    artwork : str
        Path of the ``artwork.yaml`` whose artwork is the flat; its flats are those in use.
    out : str
        Folder of the products; the record goes to ``<out>/flat-checks``.
    recipe : str
        Name of a shipped recipe, or a path.
    store : str, optional
        Folder of the artefacts; ``<out>/.store`` by default.
    height_range_mm : float
        How far apart the 0.5th and the 99.5th percentile of the height may be, its plane removed.
    normals_rms_deg : float
        How far the normals may be from their mean, rms.
    level_percent : float
        How much a lamp may have changed since the flats, and since the last check.

    Returns
    -------
    State
        Completed, or Failed where a limit is passed or nothing could be measured.
    """
    limits = {
        "height_range_mm": height_range_mm,
        "normals_rms_deg": normals_rms_deg,
        "level_percent": level_percent,
    }
    tile = load_capture(Path(artwork))[0]
    state: Any = digitise(
        artwork=artwork, recipe=recipe, out=out, store=store, tiles=[tile.name], return_state=True
    )
    if not state.is_completed():
        return Failed(message=f"the flat could not be measured: {state.message}")
    checks = Path(out) / "flat-checks"
    record = check_flat(tile, Path(out) / tile.folder / tile.name, last_check(checks, tile), limits)
    name = f"{tile.folder}-{record['time'].replace(':', '')}.json"
    write_whole(checks / name, json.dumps(record, indent=1) + "\n")
    _logger().info(record["sentence"])
    return (Failed if record["faults"] else Completed)(message=record["sentence"])


def check_flat(
    tile: Tile, products: Path, last: Mapping[str, Any] | None, limits: Mapping[str, float]
) -> dict[str, Any]:
    """Compare a measured flat with the limits.

    Parameters
    ----------
    tile : Tile
        The flat's capture.
    products : Path
        Its products.
    last : mapping or None
        The record of the check before.
    limits : mapping
        ``height_range_mm``, ``normals_rms_deg`` and ``level_percent``.

    Returns
    -------
    dict
        The figures, ``faults`` (sentences) and ``sentence``.
    """
    shape = flatness(read_tiff(products / "height.tif"), read_tiff(products / "normals.tif"))
    now = levels(tile.frames, tile)
    flats = levels(tile.flats, tile) if tile.flats else {}
    since = {
        "the flats": {lamp: 100 * (now[lamp] / flats[lamp] - 1) for lamp in flats},
        "the last check": {
            lamp: 100 * (now[lamp] / value - 1)
            for lamp, value in (last["levels"] if last else {}).items()
            if lamp in now
        },
    }
    faults = _faults(shape, since, limits)
    return {
        "time": datetime.now().astimezone().isoformat(timespec="seconds"),
        "artwork": tile.artwork,
        "tile": tile.name,
        **shape,
        "levels": now,
        "changes_percent": since,
        "limits": dict(limits),
        "faults": faults,
        "sentence": _sentence(tile, shape, faults),
    }


def _faults(
    shape: Mapping[str, float], since: Mapping[str, Mapping[str, float]], limits: Mapping[str, float]
) -> list[str]:
    """List what is beyond its limit; not a number is not a pass."""
    faults = [
        f"{words} {shape[name]:.3g} {unit}, at most {limits[name]:g} {unit} are allowed"
        for name, words, unit in (
            ("height_range_mm", "the height ranges over", "mm"),
            ("normals_rms_deg", "the normals are scattered by", "degrees"),
        )
        if not shape[name] <= limits[name]
    ]
    return faults + [
        f"{lamp} changed by {change:+.1f} % since {when}, at most {limits['level_percent']:g} % are allowed"
        for when, changes in since.items()
        for lamp, change in changes.items()
        if not abs(change) <= limits["level_percent"]
    ]


def _sentence(tile: Tile, shape: Mapping[str, float], faults: list[str]) -> str:
    """The outcome for people: what was measured, and what to do where that is needed."""
    measured = (
        f"height {shape['height_rms_mm']:.3g} mm rms over a range of {shape['height_range_mm']:.3g} mm, "
        f"normals {shape['normals_rms_deg']:.3g} degrees rms"
    )
    if not faults:
        return f"the flat {tile.artwork} came out flat: {measured}"
    return (
        f"the flat {tile.artwork} is not as it should be: {'; '.join(faults)} ({measured}); see that it "
        "lies flat and clean, take new flats, and measure the lamps again if that does not help"
    )


def flatness(height: Array, normals: Array) -> dict[str, float]:
    """Flatness of a measured surface.

    Parameters
    ----------
    height : (H, W) array
        mm; NaN where not known.
    normals : (H, W, 3) array
        Unit normals.

    Returns
    -------
    dict
        ``height_rms_mm`` and ``height_range_mm`` (0.5th to 99.5th percentile) after the best plane
        was removed; ``normals_rms_deg`` from the mean normal.  NaN where nothing is known.

    Examples
    --------
    A tilted plane is flat:

    >>> rows, columns = np.mgrid[0:40, 0:50]
    >>> normals = np.broadcast_to([0.0, 0.6, 0.8], (40, 50, 3))
    >>> found = flatness(0.5 * rows + 0.1 * columns, normals)
    >>> all(value < 1e-6 for value in found.values())
    True
    """
    step = max(1, -(-max(height.shape) // SAMPLES))
    z = np.asarray(height[::step, ::step], np.float64)
    known = np.isfinite(z)
    unit = np.asarray(normals[::step, ::step], np.float64)
    unit = unit[np.isfinite(unit).all(axis=-1)]
    if known.sum() < 3 or not len(unit):
        return dict.fromkeys(("height_rms_mm", "height_range_mm", "normals_rms_deg"), float("nan"))
    plane = np.stack([*np.nonzero(known), np.ones(known.sum())], axis=1)
    left = z[known] - plane @ np.linalg.lstsq(plane, z[known], rcond=None)[0]
    low, high = np.percentile(left, (0.5, 99.5))
    mean = unit.mean(axis=0)
    mean /= np.linalg.norm(mean)
    # Half the chord, not the arc cosine: that one knows no small angles.
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(unit - mean, axis=1) / 2, 0, 1))
    return {
        "height_rms_mm": float(np.sqrt(np.mean(left**2))),
        "height_range_mm": float(high - low),
        "normals_rms_deg": float(np.degrees(np.sqrt(np.mean(angle**2)))),
    }


def levels(photographs: Mapping[str, Path], tile: Tile) -> dict[str, float]:
    """Brightness of each lamp's photograph: the median as a share of saturation, the dark subtracted."""
    dark = _level(tile.dark, tile) if tile.dark else 0.0
    return {lamp: _level(path, tile) - dark for lamp, path in photographs.items()}


def _level(path: Path, tile: Tile) -> float:
    with Photograph(path, tile.encoding) as photograph:
        block = min(BLOCK, photograph.info.rows, photograph.info.columns)
        return float(np.median(grey(reduce_photograph(photograph, block, keep_saturated=True))))


def last_check(folder: Path, tile: Tile) -> dict[str, Any] | None:
    """The newest record of this flat in a folder; None when there is none.

    Raises
    ------
    CaptureError
        When it cannot be read.
    """
    records = []
    for path in folder.glob("*.json"):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if (record["artwork"], record["tile"]) == (tile.artwork, tile.name):
                records.append((datetime.fromisoformat(record["time"]), record))
        except (ValueError, KeyError, TypeError) as fault:
            raise CaptureError(f"{path}: is no record of a check of the flat ({fault}); remove it") from None
    return max(records, key=lambda pair: pair[0])[1] if records else None


def _logger() -> Any:
    try:
        return get_run_logger()
    except MissingContextError:
        return logging.getLogger(__name__)
