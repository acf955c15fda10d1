"""Fitting: rounds in which a tile's coarse height and what all its pixels share are found together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from nlights_core.algorithms import PHOTONS
from nlights_core.calibration import evidence
from nlights_core.calibration.lamp_positions import NOISE_ALONE, columns_of_positions, fit_with_positions
from nlights_core.calibration.linearisation import (
    TUNING,
    Equations,
    improve_normals,
    linearise,
    smooth_residual,
)
from nlights_core.calibration.reflectance import KINDS
from nlights_core.calibration.sampling import (
    Pixels,
    Samples,
    choose_pixels,
    corrected,
    flat_field_of,
    view_directions,
)
from nlights_core.calibration.unknowns import Group, Shared, groups, narrowed, nothing
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.integration.normal_integration import least_squares_height
from nlights_core.near_light.overview import ReducedRoom, thinned_room
from nlights_core.photographs.development import Raw
from nlights_core.photographs.flat_fields import FlatField
from nlights_core.solving.kernels import robust_solution
from nlights_core.solving.least_squares import fit, lit

PIXELS = 12_000
"""About how many pixels have a say."""

MORE_PIXELS = 60_000
"""The same in the last fit where lamps have changed: how much is told by noise alone."""

FEWER_PIXELS = 24_000
"""The same in a fit before it, which the last one corrects, and in the last one where they have not."""

THINNED = 4 * PIXELS
"""Pixels from which on only every other row and column is looked at before the last fit."""

ROUNDS = 4
"""At the most, in which values and height are found; a level of millimetres bends the relief, which bends the level:
each round leaves a fifth of it."""

WITHOUT_CHOICE = 2
"""Rounds in which all groups are fitted: before the others are nearly right, evidence of one is not."""

STEPS, FEWER_STEPS = 3, 2
"""Of Gauss and Newton in which normals are improved, at first and from a round before."""

NARROWED = {1: 0.45, 2: 0.25}
"""After which rounds lobes are moved close to the gloss that was found, and how far they then reach at least."""

STRANGE = 8.0
"""Pixels whose residual is so many times the median pixel's are of another material, such as gold: they have no say,
neither here nor in the coarse height."""

LOST = 0.02
"""Smoothed residual, as a share of the albedo, above which nothing is believed.  Sound captures leave 0.0005, a
canvas 20 mm above the flat 0.01; exchanged photographs, or a table in view, more than 0.1."""

UNLIKE = 0.1
"""Share of the difference between two kinds of highlights that counts as uncertain."""

SHADOW = 0.05
"""Share of the brightest sample below which one is taken to be in shadow."""

CONDITION = 100.0
"""Of the lights of a pixel; a worse one leaves it unknown."""

STEEPEST_DEG = 70.0
"""To which slopes are limited: means over blocks are hardly ever so steep."""


@dataclass(frozen=True)
class Calibration:
    """Values that all pixels of a tile share, and how well they are known.

    Attributes
    ----------
    shared : Shared
    believed : tuple of str
        Groups of which there is evidence, and "level" where it was sought.
    covariance : (M, M) float64 array
        Of the unknowns; 0 where not fitted.
    equations : Equations
        Of the last round.
    height : (h, w) float32 array
        Of the reduced photographs, level included, mm; NaN where not known.
    strange : (h, w) bool array
        Pixels of another material.
    apart : (h, w) float32 array
        What these do to the height if their own normals are taken for right, mm.
    positions : float or None
        Standard uncertainty of each coordinate of each lamp, mm, where there is evidence that it is more than stated.
    """

    shared: Shared
    believed: tuple[str, ...]
    covariance: Array
    equations: Equations
    height: Array
    strange: Array
    apart: Array
    positions: float | None = None


def calibrate(
    room: ReducedRoom,
    lights: LightField,
    flat_field: FlatField,
    chosen: tuple[str, ...],
    positions: float | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Calibration:
    """Find what all pixels of a tile share.

    Parameters
    ----------
    room : ReducedRoom
        The photographs as means over blocks.
    lights, flat_field : LightField, FlatField
        Near lamps, and what a flat reads.
    chosen : tuple of str
        Groups that may be believed; without "level" the surface is taken to lie in the plane of the flat.
    positions : float, optional
        Standard uncertainty of each coordinate of each lamp, mm; None: not known, and taken for 0.
    progress : callable
        Told the share done.

    Raises
    ------
    TileError
        When no normal could be found.
    """
    thin = thinned_room(room) if room.grid.rows * room.grid.columns >= THINNED else room
    state, found, doubt = _choose(thin, lights, flat_field, chosen, progress)
    assert state.equations is not None
    believed = (*(name for name in chosen if name == "level"), *found.believed)
    free = found.free
    if smooth_residual(state.equations) > LOST:
        # What is believed of photographs that the model does not fit would be wrong: nothing is taken out of them.
        state = _State(nothing(len(lights.lamps)), np.zeros(room.grid.shape, np.float32))
        believed, free = (), ()
    else:
        if "lamps" in believed:
            # A drift moves strengths and height by turns, and once does not settle both.
            raw = thin.raw(0, thin.grid.rows, lights)
            _fit_last(state, thin, raw, lights, flat_field, free, positions, doubt, FEWER_PIXELS)
            _follow(state, thin, raw, lights, flat_field)
        _widen(state, room.grid.shape)
    raw = room.raw(0, room.grid.rows, lights)
    wanted = MORE_PIXELS if "lamps" in believed else FEWER_PIXELS
    covariance, wider = _fit_last(state, room, raw, lights, flat_field, free, positions, doubt, wanted)
    if free:
        _follow(state, room, raw, lights, flat_field)
    apart = _with_strange(state, room, raw, lights, flat_field) - state.height
    assert state.equations is not None
    return Calibration(
        state.shared, believed, covariance, state.equations, state.height, state.strange, apart, wider
    )


def _choose(
    room: ReducedRoom,
    lights: LightField,
    flat_field: FlatField,
    chosen: tuple[str, ...],
    progress: Callable[[float], None],
) -> tuple[_State, evidence.Found, Array]:
    """Rounds that choose what is believed: the state, what was found, and the covariance that `_doubt` adds."""
    count = len(lights.lamps)
    raw = room.raw(0, room.grid.rows, lights)
    kinds = [group for group in groups(count) if group.name in chosen]
    always = (0,) if "level" in chosen else ()
    state = _State(nothing(count), np.zeros(room.grid.shape, np.float32))
    found: evidence.Found | None = None
    for number in range(ROUNDS):
        flat, readings = _follow(state, room, raw, lights, flat_field)
        assert state.scaled is not None
        pixels = _pixels(state, room, raw, readings, PIXELS)
        at = (pixels.rows, pixels.columns)
        state.equations = linearise(
            room, pixels, lights, flat, state.height[at], state.scaled[at], state.shared
        )
        state.spread = state.equations.scale
        before, last = state.shared, found
        found = evidence.choose_clear(state.equations, before, kinds, number < WITHOUT_CHOICE, always)
        stands = (
            last is not None and last.free == found.free and evidence.stands(state.equations, before, found)
        )
        state.shared = before.moved(found.values)
        if number in NARROWED and "gloss" in found.believed:
            state.shared = _narrow(state, before, found, kinds, NARROWED[number])
            stands = False
        progress((number + 1) / (ROUNDS + 1))
        if stands:
            break
    assert found is not None
    return state, found, _doubt(state, before, found, kinds)


@dataclass
class _State:
    """State between rounds: see `Calibration`; scaled normals (h, w, 3), and the residuals' spread."""

    shared: Shared
    height: Array
    scaled: Array | None = None
    spread: float = 0.0
    strange: Array = field(default_factory=lambda: np.zeros((0, 0), bool))
    equations: Equations | None = None


def _widen(state: _State, shape: tuple[int, int]) -> None:
    """Begin the last fit at all pixels with what was found at every other one."""
    assert state.scaled is not None
    if state.height.shape != shape:
        rows, columns = (np.arange(length) // 2 for length in shape)
        state.height = state.height[rows][:, columns]
        state.scaled = state.scaled[rows][:, columns]


def _follow(
    state: _State, room: ReducedRoom, raw: Raw, lights: LightField, flat_field: FlatField
) -> tuple[FlatField, Raw]:
    """Let normals and height follow what is believed of all pixels; return flat field and readings so corrected."""
    flat = flat_field_of(flat_field, lights, state.shared)
    readings = corrected(raw, flat_field, state.shared, state.scaled)
    height, shared = state.height, state.shared
    state.scaled, surprise = _solve(room, readings, lights, flat, height, shared, state.scaled, state.spread)
    state.strange = _strange(surprise)
    state.height = _integrate(room, state.scaled, state.strange, shared.level)
    return flat, readings


def _fit_last(
    state: _State,
    room: ReducedRoom,
    raw: Raw,
    lights: LightField,
    flat_field: FlatField,
    free: tuple[int, ...],
    positions: float | None,
    doubt: Array,
    wanted: int,
) -> tuple[Array, float | None]:
    """Fit what is believed once more, with so many pixels and with the lamps' positions.

    Returns the covariance, and the positions' uncertainty where it is more than stated.
    """
    flat, readings = _follow(state, room, raw, lights, flat_field)
    assert state.scaled is not None
    pixels = _pixels(state, room, raw, readings, wanted)
    at = (pixels.rows, pixels.columns)
    z, scaled = state.height[at], state.scaled[at]
    places = np.array(sorted({0, *free}), np.intp)
    surface = state.shared.reflectance
    more = None if positions is None else columns_of_positions(room, pixels, lights, flat, z, scaled, surface)
    state.equations = linearise(
        room, pixels, lights, flat, z, scaled, state.shared, places=places, more=more, independent=NOISE_ALONE
    )
    found = fit_with_positions(state.equations, state.shared, places, free, positions or 1.0)
    covariance = found.covariance
    if free:
        covariance[: len(places), : len(places)] += doubt[np.ix_(places, places)]
        state.shared = state.shared.moved(found.values)
    return covariance, found.uncertainty if positions and found.uncertainty > positions else None


def _pixels(state: _State, room: ReducedRoom, raw: Raw, readings: Raw, wanted: int) -> Pixels:
    """Pixels that have a say, about as many as are wanted."""
    assert state.scaled is not None
    known = np.isfinite(state.scaled[..., 0]) & ~state.strange & raw.inside
    return choose_pixels(room, readings, known, wanted)


def _narrow(state: _State, before: Shared, found: evidence.Found, kinds: list[Group], width: float) -> Shared:
    """Move the lobes of each kind to where the gloss would be if it were of that kind."""
    assert state.equations is not None
    first = 1 + len(state.shared.strengths)
    others = {group.name: group for group in kinds if group.name in found.believed}
    apart = {}
    for kind in dict.fromkeys(KINDS):
        places = tuple(first + place for place, other in enumerate(KINDS) if other == kind)
        trial = list({**others, "gloss": Group("gloss", places, True)}.values())
        alone = evidence.choose(state.equations, before, trial, True, (0,) if 0 in found.free else ())
        apart[kind] = alone.values[first : first + len(KINDS)]
    return narrowed(state.shared, apart, width)


def _doubt(state: _State, before: Shared, found: evidence.Found, kinds: list[Group]) -> Array:
    """Covariance that is added where a surface has highlights without tails, (M, M).

    Varnish has tails.  Where lobes without them fit better, the surface is of a kind that formulas describe less
    well, and part of the difference between the kinds is what may be wrong.
    """
    assert state.equations is not None
    first = 1 + len(state.shared.strengths)
    tails = tuple(first + place for place, kind in enumerate(KINDS) if kind == "ggx")
    others = [first + place for place, kind in enumerate(KINDS) if kind != "ggx"]
    out = np.zeros_like(state.equations.matrix)
    if found.values[others].sum() <= found.values[list(tails)].sum():
        return out
    kept = {group.name: group for group in kinds if group.name in found.believed}
    kept["gloss"] = Group("gloss", tails, True)
    other = evidence.choose(
        state.equations,
        before,
        list(kept.values()),
        True,
        found.free[:1] if found.free[:1] == (0,) else (),
    )
    apart = UNLIKE * (other.values - found.values)
    return np.asarray(np.outer(apart, apart))


def _solve(
    room: ReducedRoom,
    raw: Raw,
    lights: LightField,
    flat_field: FlatField,
    z: Array,
    shared: Shared,
    before: Array | None,
    spread: float,
) -> tuple[Array, Array]:
    """Scaled normals (h, w, 3) float64 of all pixels, and their residuals (h, w) in standard deviations."""
    band = room.develop(raw, lights, flat_field, z)
    count, *shape = band.grey.shape
    weights = lit(band.grey, band.weights, SHADOW)
    rays = np.broadcast_to(band.lights, (count, *shape, 3))
    # Begin where the last round ended: a highlight has more than one answer.
    scaled = np.full((rays[0].size // 3, 3), np.nan) if before is None else before.reshape(-1, 3).copy()
    unknown = np.flatnonzero(np.isnan(scaled[:, 0]))
    if unknown.size:
        grey, some, ray = (a.reshape(count, -1, *a.shape[3:])[:, unknown] for a in (band.grey, weights, rays))
        scaled[unknown] = fit(grey, ray, some, CONDITION).scaled.T
    if not np.isfinite(scaled).any():
        raise TileError(
            "calibration: not a single block has three usable lights; see the mask, the saturation level and "
            "the frames themselves"
        )
    views = view_directions(room.grid, room.grid.points(0, room.grid.rows, z)).reshape(-1, 3)
    weights = weights.reshape(count, -1) * np.float32(PHOTONS)
    samples = Samples(band.grey.reshape(count, -1), weights, rays.reshape(count, -1, 3), views)
    limit = TUNING * spread if spread else np.inf
    surprise = improve_normals(samples, shared, scaled, limit, STEPS if before is None else FEWER_STEPS)
    if not spread:
        # How large residuals are is not known before all samples have counted the same.
        limit = TUNING * max(1.0, float(np.nanmedian(surprise)))
        surprise = improve_normals(samples, shared, scaled, limit, STEPS)
    return scaled.reshape(*shape, 3), surprise.reshape(shape)


def _strange(surprise: Array) -> Array:
    """Mark pixels of another material than most."""
    with np.errstate(invalid="ignore"):
        return np.asarray(surprise > STRANGE * np.nanmedian(surprise))


def _with_strange(
    state: _State, room: ReducedRoom, raw: Raw, lights: LightField, flat_field: FlatField
) -> Array:
    """Height if the normals that a robust solver finds of other materials are taken for right."""
    assert state.scaled is not None
    if not state.strange.any():
        return state.height
    flat = flat_field_of(flat_field, lights, state.shared)
    band = room.develop(corrected(raw, flat_field, state.shared, state.scaled), lights, flat, state.height)
    normals = robust_solution(band.grey, band.lights, band.weights, SHADOW, CONDITION).normals
    scaled = np.where(state.strange[..., None], normals, state.scaled)
    return _integrate(room, scaled, np.zeros_like(state.strange), state.shared.level)


def _integrate(room: ReducedRoom, scaled: Array, strange: Array, level: float) -> Array:
    """Height of mean ``level``, (h, w) float32 mm; pixels of another material get the median normal."""
    from scipy.ndimage import binary_dilation

    size = np.linalg.norm(scaled, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        normals = (scaled / size).astype(np.float32)
    if strange.any():
        wide = binary_dilation(strange, iterations=2) & np.isfinite(normals[..., 0])
        normals[wide] = np.nanmedian(normals[~wide], axis=0)
    height = least_squares_height(normals, room.grid, stencil="6-point", steepest_deg=STEEPEST_DEG)
    height += np.float32(level - np.nanmean(height))
    return np.where(np.isnan(height), np.float32(level), height).astype(np.float32)
