"""Exchanges: photographs that show another lamp's light than the one they are listed under."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from nlights_core.agreement.wording import flat_name, frame_name, listed
from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.coarse_light import CoarseLight, centred, misfits

LEAST_LAMPS = 4
"""What lamps have in common is their median, which one exchange among three would decide."""

SWAPPED = 0.75
"""Misfit of photographs when lamps change places, over that as they are listed, below which they did.  Sound
captures stay above 1.45 (frames 20 mm high that shade half of a relief, against flats; dark paintings, against
light computed from the stand), most above 4; an exchange has one over that."""

ITSELF = 1.0
"""The same of each photograph by itself.  One that is turned fits the flat of the opposite lamp, but that
lamp's photograph does not fit its flat: it is no exchange."""

FIRMLY = 0.5
"""The same where one of the photographs, but not all, would fit if it were turned instead."""

RATHER = 4.0
"""As many times what is left of a photograph's misfit if it is turned may be left of it in an exchange."""

FEW = 6
SWAPPED_OF_FEW = 0.4
"""`SWAPPED` for fewer than so many lamps, of which one odd photograph shifts what they have in common."""

SURE = 0.8
"""Ratio of two misfits with the computed light below which the smaller tells whether photographs or flats are meant:
1 would be a guess."""


class Exchange(NamedTuple):
    """Lamps that change places among themselves.

    Attributes
    ----------
    lamps : tuple of int
        Each photograph shows the light of the lamp that follows, the last that of the first.
    ratio : float
        Misfit so over misfit as they are listed.
    left : tuple of float
        The same of each photograph.
    """

    lamps: tuple[int, ...]
    ratio: float
    left: tuple[float, ...]


def find_exchanged(
    cells: CoarseLight, tile: Tile, suspects: Mapping[str, float] | None = None
) -> list[CaptureWarning]:
    """Look for photographs, flats, or both, that are listed under each other's lamps.

    Parameters
    ----------
    cells : CoarseLight
        Of lamps that fired.
    tile : Tile
    suspects : mapping of str to float, optional
        Lamps whose photograph may be turned instead, and what is left of its misfit then.

    Returns
    -------
    list of CaptureWarning
        One for each pair, or longer cycle, of lamps.
    """
    if len(cells.lamps) < LEAST_LAMPS:
        return []
    frames = centred(cells.frames)
    flats = None if cells.flats is None else centred(cells.flats)
    light = None if cells.computed is None else centred(cells.computed)
    turned = {cells.lamps.index(lamp): left for lamp, left in (suspects or {}).items()}
    found, named = [], set[int]()
    if flats is not None:
        for exchange in exchanges(misfits(frames, flats)):
            if _may_be_turned(exchange, turned):
                continue
            which = _which(exchange.lamps, frames, flats, light)
            found.append(_exchanged(cells.lamps, tile, exchange, which))
            named |= set(exchange.lamps)
    rest = [i for i in range(len(cells.lamps)) if i not in named]
    if light is None or len(rest) < LEAST_LAMPS:
        return found
    apart = misfits(frames[rest], light[rest])
    if flats is not None:
        apart = np.sqrt(apart * misfits(flats[rest], light[rest]))
    for exchange in exchanges(apart):
        exchange = exchange._replace(lamps=tuple(rest[i] for i in exchange.lamps))
        if not _may_be_turned(exchange, turned):
            both = "both" if flats is not None else "alone"
            found.append(_exchanged(cells.lamps, tile, exchange, both))
    return found


def _may_be_turned(exchange: Exchange, suspects: Mapping[int, float]) -> bool:
    """Test whether an exchange is better explained by photographs that seem turned.

    If all of them do, and as much is left either way, they are opposite lamps that changed places.
    """
    among = [
        (suspects[i], left) for i, left in zip(exchange.lamps, exchange.left, strict=True) if i in suspects
    ]
    if any(left > RATHER * turned for turned, left in among):
        return True
    return 0 < len(among) < len(exchange.lamps) and max(exchange.left) > FIRMLY


def exchanges(apart: Array) -> list[Exchange]:
    """Find the lamps that must change places for the best agreement.

    Parameters
    ----------
    apart : (L, L) array
        Misfit of the photograph of each lamp with what each lamp should show; NaN where not known:
        such a lamp stays where it is.

    Returns
    -------
    list of Exchange
        The most certain first.
    """
    known = np.flatnonzero(np.isfinite(apart).all(axis=1) & np.isfinite(apart).all(axis=0))
    misfit = apart[np.ix_(known, known)]
    shown = reassign(misfit)
    found, seen = [], set[int]()
    for start in range(len(known)):
        cycle = [start]
        while shown[cycle[-1]] != start:
            cycle.append(int(shown[cycle[-1]]))
        if len(cycle) < 2 or start in seen:
            continue
        seen |= set(cycle)
        left = tuple(float(misfit[i, shown[i]] / misfit[i, i]) for i in cycle)
        if max(left) < ITSELF:
            found.append(Exchange(tuple(int(known[i]) for i in cycle), _ratio(misfit, cycle), left))
    return sorted(found, key=lambda exchange: exchange.ratio)


def reassign(misfit: Array) -> Array:
    """Lamp that each photograph shows, (L,), for the best agreement by misfits (L, L).

    A lamp leaves its place only in a cycle that lowers the misfit to `SWAPPED` of what it was.
    """
    from scipy.optimize import linear_sum_assignment

    weighed = misfit / (SWAPPED if len(misfit) >= FEW else SWAPPED_OF_FEW)
    np.fill_diagonal(weighed, np.diag(misfit))
    return np.asarray(linear_sum_assignment(weighed)[1])


def _ratio(misfit: Array, cycle: list[int] | tuple[int, ...]) -> float:
    """Misfit of lamps that each show the next, over that as listed."""
    following = [*cycle[1:], cycle[0]]
    return float(misfit[list(cycle), following].sum() / misfit[list(cycle), list(cycle)].sum())


def _which(lamps: tuple[int, ...], frames: Array, flats: Array, light: Array | None) -> str:
    """Set that is exchanged, by the light computed from the stand: "frames", "flats" or "either"."""
    if light is None:
        return "either"
    by_frames = _ratio(misfits(frames, light), lamps)
    # Where photograph i fits the flat listed under the next lamp, that flat shows lamp i.
    by_flats = _ratio(misfits(flats, light).T, lamps)
    if not np.isfinite(by_frames * by_flats) or not min(by_frames, by_flats) < SURE * max(
        by_frames, by_flats
    ):
        return "either"
    return "frames" if by_frames < by_flats else "flats"


def _exchanged(names: tuple[str, ...], tile: Tile, exchange: Exchange, which: str) -> CaptureWarning:
    lamps = [names[i] for i in exchange.lamps]
    following = [*lamps[1:], lamps[0]]
    pairs = list(zip(lamps, following, strict=True))
    times = exchange.ratio**-0.5 if exchange.ratio > 0 else float("inf")
    better = f"(taken so, they agree {times:.1f} times better)"
    correct = "correct the names of the files or their lamps in artwork.yaml"
    if which == "flats":
        shown = listed([f"{flat_name(tile, other)} shows the light of lamp {lamp}" for lamp, other in pairs])
        sentence = f"flats of lamps {listed(lamps)} are exchanged: {shown} {better}; {correct}"
    elif which == "frames":
        shown = listed([f"{frame_name(tile, lamp)} shows the light of lamp {other}" for lamp, other in pairs])
        sentence = f"photographs of lamps {listed(lamps)} are exchanged: {shown} {better}; {correct}"
    elif which == "either":
        shown = listed([f"{frame_name(tile, lamp)} fits {flat_name(tile, other)}" for lamp, other in pairs])
        sentence = f"photographs or flats of lamps {listed(lamps)} are exchanged: {shown} {better}; {correct}"
    else:
        files = "photograph and flat" if which == "both" else "the photograph"
        shown = listed(
            [f"{files} of {lamp} ({frame_name(tile, lamp)}) show lamp {other}" for lamp, other in pairs]
        )
        sentence = (
            f"lamps {listed(lamps)} are listed in another order than they fired, or the stand's file exchanges their "
            f"positions: {shown} {better}; {correct}, or the stand's file"
        )
    in_order = tuple(name for name in names if name in lamps)
    return CaptureWarning("exchanged", sentence, in_order, times, "times better agreement")
