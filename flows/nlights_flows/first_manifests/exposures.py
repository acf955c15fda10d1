"""Exposures of photographs, as far as their EXIF data tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

MODEL, EXIF, TIME, F_NUMBER, ISO = 272, 0x8769, 33434, 33437, 34855
"""Tags of EXIF."""


def tell_exposures(paths: Sequence[Path], found: list[str], unsure: list[str]) -> None:
    """Tell the camera, and whether all photographs were exposed alike."""
    records = {path: record for path in paths if (record := _exif(path))}
    if not records:
        return
    models = {str(record["model"]) for record in records.values()}
    exposures = {(record["time"], record["f"], record["iso"]) for record in records.values()}
    camera = ", ".join(sorted(models))
    if len(exposures) == 1 and len(models) == 1:
        time, f_number, iso = exposures.pop()
        facts = [
            f"{time:g} s" if time else "",
            f"f/{f_number:g}" if f_number else "",
            f"ISO {iso}" if iso else "",
        ]
        found.append(f"EXIF: {', '.join(filter(None, [camera, *facts]))}")
        return
    odd = sorted(
        f"{path.name}: {record['time'] or 0:g} s, ISO {record['iso']}" for path, record in records.items()
    )
    unsure.append(
        f"whether the photographs agree: EXIF has several exposures or cameras ({'; '.join(odd[:4])} ...)"
    )


def _exif(path: Path) -> dict[str, Any] | None:
    """Camera, exposure time (s), f-number and ISO; None where Pillow cannot read any."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            tags = image.getexif()
            own = tags.get_ifd(EXIF)
            iso = own.get(ISO)
            record = {
                "model": " ".join(str(tags.get(MODEL, "")).split()),
                "time": _number(own.get(TIME)),
                "f": _number(own.get(F_NUMBER)),
                "iso": iso[0] if isinstance(iso, tuple) and iso else iso,
            }
    except Exception:  # EXIF of any origin may be damaged in any way, and says nothing that is needed
        return None
    return record if any(record.values()) else None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if number > 0 else None
