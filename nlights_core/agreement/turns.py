"""Turns: photographs that were turned or mirrored against the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nlights_core.agreement.exchanges import SWAPPED, reassign
from nlights_core.agreement.wording import flat_name, frame_name
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.coarse_light import (
    LEAST_CELLS,
    CoarseLight,
    centred,
    known_medians,
    misfits,
    variance,
)

ACROSS = 80
"""About how many cells a photograph is wide: patterns of the artwork tell as well as light."""

ARTWORK = "photographs of the artwork"

LEAST_LAMPS = 4
"""The others tell what a photograph should show: of two others none is the odd one."""

TURNED = 0.27
"""Misfit of a photograph when it is turned, over that as it is, below which it was.  Sound ones stay above 1.5, and
one that only moved by some pixels above 0.32; turned ones stay below 0.21."""

FEW = 6
TURNED_OF_FEW = 0.1
"""`TURNED` for a whole set of fewer than so many lamps, of which one odd photograph shifts what all have in common.
Nine of ten sets of 4 lamps that are turned stay below it; sound ones stay above 0.7."""

STRANGE = 4.0
"""As many times the median lamp's must the misfit of a turned photograph be as it is: sound ones are alike."""

EITHER = 0.7
"""Ratio of misfits below which the smaller decides: between photograph and flat, or between two ways of turning."""

PATTERN = 0.5
"""Correlation of fine patterns, turned, that is asked for where no flat tells the light: on a sphere, light from the
left looks like light from the right mirrored.  Photographs of one artwork correlate by 0.7 to 1."""

NO_PATTERN = 0.3
"""Correlation as it is that a turned photograph stays below."""

MOST = 0.75
"""Share of the other photographs that must have that pattern: shading is another from every side."""

FINE = 13
"""Cells within which a pattern is fine: a sixth of the field."""

HALF_TURN = "turned by 180 degrees"
WAYS = {
    HALF_TURN: (slice(None, None, -1), slice(None, None, -1)),
    "mirrored left to right": (slice(None), slice(None, None, -1)),
    "mirrored top to bottom": (slice(None, None, -1), slice(None)),
}
"""What a camera's or a converter's tag of orientation does to pictures that keep their shape: rows, columns."""


def find_turned_together(cells: CoarseLight, tile: Tile) -> list[CaptureWarning]:
    """Look for a whole set of photographs that is turned or mirrored against the flats, or both against the stand.

    Parameters
    ----------
    cells : CoarseLight
        Of lamps that fired.
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        Of one at most, with all lamps.
    """
    if len(cells.lamps) < LEAST_LAMPS:
        return []
    frames = centred(cells.frames)
    flats = None if cells.flats is None else centred(cells.flats)
    light = None if cells.computed is None else centred(cells.computed)
    limit = TURNED if len(cells.lamps) >= FEW else TURNED_OF_FEW
    if flats is not None:
        way, ratio, exchanged = _way_of_all(((frames, flats),))
        if ratio < limit:
            subject, against = _odd_set(frames, flats, light)
            return [_turned_together(cells.lamps, subject, against, way, ratio, exchanged)]
    if light is None:
        return []
    pairs = ((frames, light),) if flats is None else ((frames, light), (flats, light))
    way, ratio, exchanged = _way_of_all(pairs)
    if ratio < limit:
        subject = f"{ARTWORK}{' and flats' if flats is not None else ''}"
        return [_turned_together(cells.lamps, subject, "the stand", way, ratio, exchanged)]
    return []


def _way_of_all(pairs: tuple[tuple[Array, Array], ...]) -> tuple[str, float, bool]:
    """Way in which all pictures, turned, fit their partners best, and the ratio of the misfits.

    Returns
    -------
    way : str
    ratio : float
        Infinite where lamps in another order explain it better.
    exchanged : bool
        Whether lamps in another order explain it as well.
    """

    def apart(place: tuple[slice, ...]) -> Array:
        # Of several pairs the geometric mean: what fits badly anyway must not decide.
        with np.errstate(divide="ignore"):  # what fits exactly stays 0
            logs = [np.log(misfits(first[(slice(None), *place)], second)) for first, second in pairs]
        return np.asarray(np.exp(np.mean(logs, axis=0)))

    listed = apart((slice(None), slice(None)))
    as_is = np.diag(listed)
    if not np.isfinite(listed).all():
        return "", float("inf"), False
    turned = {way: np.diag(apart(place)) for way, place in WAYS.items()}
    way = likeliest_way({way: float(misfit.sum()) for way, misfit in turned.items()})
    best = turned[way]
    exchanged = listed[np.arange(len(listed)), reassign(listed)].sum()
    if exchanged < SWAPPED * best.sum() or not np.mean(best < as_is) > 0.7:
        return way, float("inf"), False
    return way, float(best.sum() / as_is.sum()), bool(SWAPPED * exchanged < best.sum())


def _odd_set(frames: Array, flats: Array, light: Array | None) -> tuple[str, str]:
    """Set that is turned, and against which, by the light computed from the stand."""
    if light is not None:
        by_frames, by_flats = (float(np.diag(misfits(one, light)).sum()) for one in (frames, flats))
        if min(by_frames, by_flats) < EITHER * max(by_frames, by_flats):
            return (ARTWORK, "the flats") if by_frames > by_flats else ("flats", f"the {ARTWORK}")
    return f"{ARTWORK}, or else all flats,", "the others"


def _turned_together(
    lamps: tuple[str, ...], subject: str, against: str, way: str, ratio: float, exchanged: bool
) -> CaptureWarning:
    times = ratio**-0.5
    instead = " (or the lamps are listed in another order than they fired)" if exchanged else ""
    return CaptureWarning(
        "turned",
        f"all {subject} are {way} against {against}{instead}: turned back they agree {times:.1f} times better, "
        "where photographs the right way round agree best as they are; export them again with the top of the field "
        "at the top, or correct the axes in the stand's file",
        lamps,
        times,
        "times better agreement",
    )


def find_turned(cells: CoarseLight, tile: Tile) -> list[CaptureWarning]:
    """Look for single photographs or flats that fit the others only when they are turned or mirrored.

    Parameters
    ----------
    cells : CoarseLight
        Of lamps whose photographs are in their places.
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        One for each lamp.
    """
    if len(cells.lamps) < LEAST_LAMPS:
        return []
    light = cells.flats if cells.flats is not None else cells.computed
    frames = cells.frames
    others = _medians_of_others(frames)
    light = np.zeros_like(frames) if light is None else light - _medians_of_others(light)
    own = _variances(frames - others - light)
    usual = np.nanmedian(own) if np.isfinite(own).any() else np.nan
    found = []
    for i, lamp in enumerate(cells.lamps):
        # Without flats the light itself is strange to the others.
        if not own[i] > (STRANGE if cells.flats is not None else 0) * usual:
            continue
        way, ratio, kind = _best_way(cells, i, others[i], light[i], own[i])
        if ratio < TURNED and (cells.flats is not None or _pattern_is_turned(frames, others, i, way)):
            found.append(_turned(tile, lamp, way, kind, ratio))
    return found


def likeliest_way(misfits: Mapping[str, float]) -> str:
    """The way of the least misfit; by 180 degrees unless that is clearly worse, for nobody means to mirror."""
    known = {way: misfit for way, misfit in misfits.items() if np.isfinite(misfit)}
    best = min(known, key=lambda way: known[way], default=HALF_TURN)
    half = known.get(HALF_TURN, np.inf)
    return HALF_TURN if EITHER * half < known.get(best, np.inf) else best


def _best_way(cells: CoarseLight, i: int, others: Array, light: Array, own: float) -> tuple[str, float, str]:
    """Best way to turn photograph or flat of a lamp, the ratio of the misfit, and which of the two it is."""
    frame = cells.frames[i]
    frames_turned = {
        way: float(_variances(frame[place] - others - light) / own) for way, place in WAYS.items()
    }
    way = likeliest_way(frames_turned)
    best = frames_turned[way]
    if cells.flats is None:
        return way, best, "frame"
    flat = cells.flats[i]
    flats_turned = {
        way: float(_variances(frame - others - (light - flat + flat[place])) / own)
        for way, place in WAYS.items()
    }
    way_of_flat = likeliest_way(flats_turned)
    best_of_flat = flats_turned[way_of_flat]
    if best < EITHER * best_of_flat:
        return way, best, "frame"
    if best_of_flat < EITHER * best:
        return way_of_flat, best_of_flat, "flat"
    # A plane without a pattern: only the stand tells which of the two has the light on the wrong side.
    kind = "either"
    if cells.computed is not None:
        computed = cells.computed[i]
        by_frame, by_flat = (float(_variances(one - computed)) for one in (frame, flat))
        if min(by_frame, by_flat) < EITHER * max(by_frame, by_flat):
            kind = "frame" if by_frame > by_flat else "flat"
    return (way_of_flat, best_of_flat, kind) if kind == "flat" else (way, best, kind)


def _pattern_is_turned(frames: Array, others: Array, i: int, way: str) -> bool:
    """Test whether the fine pattern of a photograph is that of the others turned, whatever the light."""
    wanted, turned = _fine(others[i]), _fine(frames[(i, *WAYS[way])])
    alike = [_correlation(_fine(frame), wanted) for frame in frames]
    # What all others share is no shading.
    shared = np.mean(np.delete(alike, i) > PATTERN) > MOST
    return bool(shared and alike[i] < NO_PATTERN and _correlation(turned, wanted) > PATTERN)


def _fine(light: Array) -> Array:
    """Light (h, w) less its mean over `FINE` cells each way; NaN where not known."""
    from scipy.ndimage import uniform_filter

    known = np.isfinite(light)
    share = np.maximum(uniform_filter(known.astype(np.float64), FINE), 1e-9)
    return np.asarray(light - uniform_filter(np.where(known, light, 0), FINE) / share)


def _correlation(first: Array, second: Array) -> float:
    """Correlation of what both know; 0 where that is too little."""
    known = np.isfinite(first) & np.isfinite(second)
    if known.sum() < LEAST_CELLS or not (np.std(first[known]) > 0 and np.std(second[known]) > 0):
        return 0.0
    return float(np.corrcoef(first[known], second[known])[0, 1])


def _medians_of_others(light: Array) -> Array:
    """Median of all other lamps, for each lamp of (L, h, w); NaN where less than half of them are known."""
    count = len(light)
    last = np.moveaxis(light, 0, -1)
    return np.stack([known_medians(np.delete(last, i, axis=-1), 0.5) for i in range(count)])


def _variances(differences: Array) -> Array:
    """Robust variances of pictures (..., h, w)."""
    return variance(differences.reshape(*differences.shape[:-2], -1))


def _turned(tile: Tile, lamp: str, way: str, kind: str, ratio: float) -> CaptureWarning:
    frame, flat = frame_name(tile, lamp), flat_name(tile, lamp)
    which = {"frame": frame, "flat": flat, "either": f"{frame} or {flat}"}[kind]
    times = ratio**-0.5
    return CaptureWarning(
        "turned",
        f"{which} (lamp {lamp}) is {way} against the other photographs: turned back it agrees {times:.1f} times "
        "better, where a photograph the right way round agrees best as it is; export it again with the orientation "
        "of the others (a tag of orientation may have been applied to it alone)",
        (lamp,),
        times,
        "times better agreement",
    )
