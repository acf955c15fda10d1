"""Additive light: a constant that all photographs of the artwork have and those of the flat have not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.coarse_light import known_medians
from nlights_core.reduced_light.places import places, unexplained
from nlights_core.reduced_light.relative_light import RelativeLight

LEAST = 0.005
"""Light that is told, as a share of the flats' median: 0.5 %.  Sound captures read -0.003 to 0.001, the lowest
ones with varnish; 3 % of light in the photographs alone reads 0.023 and more."""

CERTAIN = 6.0
"""How many standard errors, found from one part of the artwork to another, it must have."""

DRIFT = 0.03
"""Standard deviation of what a lamp's level may be off: a lamp that has drifted is not taken for light."""

GRAZED = 0.3
"""Places at which a lamp gives less than this share of the median lamp are left out: those turned away from
it are not as dark as the model says, which looks like light."""

PARTS = (4, 6)
"""Parts down and across within which a misfit is taken to be one and the same."""

ROUNDS = 5
"""Rounds in which places that fit badly lose weight."""

SHARES = np.geomspace(LEAST, 0.5, 60)
"""Light that is tried where photographs are so dark that it bends them like a tone curve."""

STRENGTHS = np.geomspace(0.02, 5, 50)
"""The same of light that falls on the artwork, and that it reflects as it does that of the lamps."""

MOST_LOST = 0.1
"""Share of cells that may be darker than such light."""


class Light(NamedTuple):
    """Light in the photographs of the artwork alone, and its standard error, as shares of the flats' median."""

    share: float
    error: float

    @property
    def certain(self) -> bool:
        """Test whether there is some; what is below nothing is no light."""
        return self.share > max(LEAST, CERTAIN * self.error)


def find_light(relative: RelativeLight) -> Light | None:
    """Fit a constant beside what the lamps explain.

    A constant is the larger a share of a photograph, the dimmer its lamp is at a place: so it goes with
    one over the flat, which no surface does.

    Parameters
    ----------
    relative : RelativeLight
        With flats.

    Returns
    -------
    Light or None
        None where too little is known.
    """
    y, x, light, vectors, weights = places(relative)
    level = np.nanmedian(np.where(weights > 0, light, np.float32(np.nan)), axis=0) if len(y) else light[0]
    lit = np.all((weights == 0) | (light > GRAZED * level), axis=0)
    y, x, light, vectors, weights, level = (
        y[lit],
        x[lit],
        light[:, lit],
        vectors[:, lit],
        weights[:, lit],
        level[lit],
    )
    if len(y) < 50:
        return None
    count, parts = len(light), (y * PARTS[0] // relative.light.shape[1]) * PARTS[1]
    parts = parts + x * PARTS[1] // relative.light.shape[2]
    # Without noise: that of the flat is in the light as well, and would be taken for a constant.
    flats = np.nan_to_num(relative.smooth_divisors[:, y, x], nan=1.0)
    light = (light / np.maximum(level, 1e-6)).T
    free = unexplained(vectors, weights)
    constant = np.einsum("nij,nj->ni", free, (np.median(flats) / flats).T)
    # One column for the constant, one for the level of each lamp.
    columns = np.concatenate([constant[:, :, None], free * light[:, None, :]], axis=2)
    left = np.einsum("nij,nj->ni", free, light)
    found = np.zeros(1 + count)
    for _ in range(ROUNDS):
        rest = left - columns @ found
        squares = (rest**2).sum(axis=1)
        trust = 1 / (1 + squares / max(float(np.median(squares)), 1e-12))
        matrix = _products(columns * trust[:, None, None], columns)
        # A part counts once: its places err alike.
        variance = float(trust @ squares) / trust.sum() / (count - 3)
        weight = variance * float(trust.sum()) / (2 * PARTS[0] * PARTS[1] * DRIFT**2)
        matrix += np.diag(np.r_[0.0, np.full(count, weight)]) + 1e-12 * np.eye(1 + count)
        found = np.linalg.solve(matrix, np.einsum("nlk,nl->k", columns * trust[:, None, None], left))
    scores = np.einsum("nlk,nl->nk", columns, left - columns @ found) * trust[:, None]
    sums = np.zeros((PARTS[0] * PARTS[1], 1 + count))
    np.add.at(sums, parts, scores)
    errors = sums @ np.linalg.inv(matrix)[:, 0]
    return Light(float(found[0]), float(np.sqrt(errors @ errors)))


def bending_light(frames: Array, flats: Array, power: float) -> float | None:
    """Find light that explains better than a tone curve why photographs vary less than their flats.

    A photograph that is half additive light varies as a curve would make it vary.  But when such light is taken
    off, or added to the flats where the artwork reflects it, photographs vary as the flats do.

    Parameters
    ----------
    frames, flats : (L, h, w) arrays
        Logarithms.
    power : float
        Of the tone curve.

    Returns
    -------
    float or None
        As a share of the flats' median; None where the curve explains more.
    """
    light, unit = np.exp(frames), float(np.nanmedian(np.exp(flats)))
    rests = [
        _differing(np.where(light > share * unit, light - share * unit, np.nan), flats) for share in SHARES
    ]
    room = [_differing(light, np.log(np.exp(flats) + strength * unit)) for strength in STRENGTHS]
    curved = min(_differing(light, one * flats) for one in np.linspace(0.8, 1.2, 9) * power)
    if min(rests) < min(curved, *room):
        return float(SHARES[np.argmin(rests)])
    if min(room) < curved:
        added = STRENGTHS[np.argmin(room)] * unit
        return float(np.nanmedian(light * added / (np.exp(flats) + added)) / unit)
    return None


def _differing(light: Array, logarithm: Array) -> float:
    """Median by which light differs from a logarithm, but for what is the same at a place or under a lamp."""
    known = np.isfinite(light) & (light > 0)
    if known.sum() < (1 - MOST_LOST) * np.isfinite(logarithm).sum():
        return float("inf")
    apart = np.log(np.where(known, light, np.nan)) - logarithm
    apart = apart - known_medians(np.moveaxis(apart, 0, -1))
    flat = apart.reshape(len(apart), -1)
    flat = np.abs(flat - known_medians(flat)[:, None])
    return float(known_medians(flat.reshape(-1)))


def warning_of_light(share: float, error: float | None = None) -> CaptureWarning:
    """The warning of light that the flats have not, a share of their median, with its standard error if known."""
    within = "" if error is None else f" (+- {100 * error:.1f})"
    return CaptureWarning(
        "additive-light",
        f"the photographs of the artwork hold light that its lamps did not give: {100 * share:.1f} %{within} of the "
        "flats' median, which neither the flats nor the dark frame account for; darken the room (for the flats too), "
        "see that the dark frame is of the same exposure, and photograph again",
        (),
        round(100 * share, 2),
        "%",
    )


def _products(left: Array, right: Array) -> Array:
    """Sums of products of columns (n, L, K) over places and lamps, (K, K)."""
    return np.asarray(np.einsum("nlk,nlm->km", left, right), float)
