"""Exposures that cameras note in their files (EXIF), as far as they can be read."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL.Image import Exif
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

_DETAILS = 0x8769
"""Tag of the table that holds exposures."""
_TIME, _APERTURE, _SENSITIVITY = 0x829A, 0x829D, 0x8827


@dataclass(frozen=True)
class ExposureNote:
    """Note of a camera about an exposure; None where it did not say.

    Attributes
    ----------
    seconds : float or None
        Exposure time.
    f_number : float or None
        Of the aperture.
    iso : float or None
        Sensitivity.
    """

    seconds: float | None = None
    f_number: float | None = None
    iso: float | None = None

    def __str__(self) -> str:
        """Text as photographers write it: 1/50 s, f/8, ISO 100."""
        parts = []
        if self.seconds is not None:
            short = f"1/{1 / self.seconds:.0f}" if self.seconds < 0.3 else f"{self.seconds:g}"
            parts.append(f"{short} s")
        if self.f_number is not None:
            parts.append(f"f/{self.f_number:g}")
        if self.iso is not None:
            parts.append(f"ISO {self.iso:g}")
        return ", ".join(parts) or "nothing noted"

    def brighter_than(self, other: ExposureNote) -> float:
        """Factor by which the same scene becomes brighter than by another exposure, by what both note."""
        ratio = 1.0
        if self.seconds is not None and other.seconds is not None:
            ratio *= self.seconds / other.seconds
        if self.f_number is not None and other.f_number is not None:
            ratio *= (other.f_number / self.f_number) ** 2
        if self.iso is not None and other.iso is not None:
            ratio *= self.iso / other.iso
        return ratio


def read_exposure(path: Path) -> ExposureNote:
    """Read what a photograph's file notes about its exposure; no pixel is decoded.

    Parameters
    ----------
    path : Path
        TIFF, JPEG, PNG, or a camera raw file that is built like a TIFF (most are).

    Returns
    -------
    ExposureNote
        Of nothing where the file says nothing, or cannot be understood: that is no fault of a photograph.

    Raises
    ------
    OSError
        When the file cannot be opened.
    """
    with path.open("rb") as file, warnings.catch_warnings():
        # Of a damaged note, which is no fault of a photograph.
        warnings.simplefilter("ignore")
        start = file.read(8)
        file.seek(0)
        try:
            if start[:2] == b"\xff\xd8":
                with JpegImageFile(file) as image:
                    exif = image.getexif()
            elif start == b"\x89PNG\r\n\x1a\n":
                with PngImageFile(file) as image:
                    exif = image.getexif()
            elif start[:2] in (b"II", b"MM"):
                exif = Exif()
                exif.load_from_fp(file)
            else:
                return ExposureNote()
            first, details = dict(exif), exif.get_ifd(_DETAILS)
        except Exception:
            # Whatever a damaged note makes the reader do: the photograph itself is read by its decoder.
            return ExposureNote()
    seconds, f_number, iso = (
        _positive(details.get(tag, first.get(tag))) for tag in (_TIME, _APERTURE, _SENSITIVITY)
    )
    return ExposureNote(seconds, f_number, iso)


def _positive(value: Any) -> float | None:
    """A positive number, or the first of several; else None."""
    if isinstance(value, tuple) and value:
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
