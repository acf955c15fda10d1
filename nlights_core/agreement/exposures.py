"""Exposures that the cameras noted: of photographs against flats, one another, and the dark frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from nlights_core.agreement.wording import flat_name, frame_name, listed
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.photographs.exif import ExposureNote, read_exposure
from nlights_core.reduced_light.coarse_light import CoarseLight, known_medians

ANOTHER = 1.1
"""Factor of exposure from which on two exposures are told to differ.  Cameras move in thirds of a stop, 1.26, and
note rounded values: two exposures that are meant to be equal are noted alike."""

SEEN = 0.5
"""Share of the noted difference, in stops, that the light of one photograph must show before it is told: numbers
that a converter has already evened out are as they should be."""


def find_odd_exposures(cells: CoarseLight, tile: Tile) -> list[CaptureWarning]:
    """Look for exposures that the files note and that differ.

    Parameters
    ----------
    cells : CoarseLight
        Of lamps that can be trusted.
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        Of a single lamp with it; of all flats or the dark frame without lamps.
    """
    frames = {lamp: read_exposure(tile.frames[lamp]) for lamp in cells.lamps}
    flats = None
    if tile.flats is not None and cells.flats is not None:
        flats = {lamp: read_exposure(tile.flats[lamp]) for lamp in cells.lamps}
    found = _of_lamps(cells, tile, frames, flats)
    if tile.dark is not None:
        found += _of_dark(tile.dark, frames)
    return found


def _of_lamps(
    cells: CoarseLight,
    tile: Tile,
    frames: Mapping[str, ExposureNote],
    flats: Mapping[str, ExposureNote] | None,
) -> list[CaptureWarning]:
    """Warnings about photographs and flats."""
    lamps = cells.lamps
    if flats is None:
        # One exposure among the photographs stands for what flats would have had.
        usual = usual_note(list(frames.values()))
        factors = np.array([frames[lamp].brighter_than(usual) for lamp in lamps])
        level = cells.frames
    else:
        factors = np.array([frames[lamp].brighter_than(flats[lamp]) for lamp in lamps])
        level = cells.frames - cells.flats if cells.flats is not None else cells.frames
    usual_factor = float(np.median(factors))
    found = []
    if flats is not None and not 1 / ANOTHER < usual_factor < ANOTHER:
        first = lamps[int(np.argmin(np.abs(factors - usual_factor)))]
        found.append(
            CaptureWarning(
                "exposure",
                f"the flats were exposed otherwise than the photographs of the artwork: {flat_name(tile, first)} "
                f"says {flats[first]}, {frame_name(tile, first)} (lamp {first}) {frames[first]}, a factor of "
                f"{usual_factor:.2f}, where the same exposure is usual; photograph both with the same exposure, or "
                "divide white_reflectance by that factor; normals and heights do not suffer, albedo does",
                (),
                usual_factor,
                "times the flats' exposure",
            )
        )
    shown = known_medians(level.reshape(len(lamps), -1))
    shown = shown - np.nanmedian(shown) if np.isfinite(shown).any() else shown
    for i, lamp in enumerate(lamps):
        noted = float(factors[i] / usual_factor)
        if 1 / ANOTHER < noted < ANOTHER or not shown[i] / np.log(noted) > SEEN:
            continue
        own = f"{frame_name(tile, lamp)} (lamp {lamp}) was exposed otherwise than the others: it says {frames[lamp]}"
        if flats is not None:
            own += f", its flat {flats[lamp]}"
        found.append(
            CaptureWarning(
                "exposure",
                f"{own}, a factor of {noted:.2f} against the other lamps, where the same exposure is usual; "
                "photograph it again with the exposure of the others",
                (lamp,),
                noted,
                "times the others' exposure",
            )
        )
    return found


def usual_note(notes: Sequence[ExposureNote]) -> ExposureNote:
    """Median of some exposures, each part by itself."""

    def median(values: list[float | None]) -> float | None:
        known = sorted(value for value in values if value is not None)
        return known[len(known) // 2] if known else None

    return ExposureNote(
        median([note.seconds for note in notes]),
        median([note.f_number for note in notes]),
        median([note.iso for note in notes]),
    )


def _of_dark(path: Path, frames: Mapping[str, ExposureNote]) -> list[CaptureWarning]:
    """Warnings about the dark frame: its time and sensitivity count, not its aperture."""
    usual, own = usual_note(list(frames.values())), read_exposure(path)
    found = []
    for what, mine, theirs in (
        ("exposure time", own.seconds, usual.seconds),
        ("sensitivity", own.iso, usual.iso),
    ):
        if mine is None or theirs is None or 1 / ANOTHER < mine / theirs < ANOTHER:
            continue
        found.append(f"{what} {mine:g} against {theirs:g}")
    if not found:
        return []
    return [
        CaptureWarning(
            "exposure",
            f"{path.name}: the dark frame was exposed otherwise than the photographs ({own} against {usual}; "
            f"{listed(found)}), where a dark frame needs the same time and sensitivity; photograph it again so",
            (),
            None,
            "",
        )
    ]
