"""Tone curves: how the numbers of a photograph stand for light where they are not in proportion to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from nlights_core.errors import TileError
from nlights_core.frames import Array
from nlights_core.photographs.icc_profiles import ProfileError, parse_profile

SAME = 1e-3
"""By how much of white two curves may differ and be the same: one as a formula and one as a table of 8 bits."""

STRAIGHT = 1e-4
"""By how much of white a curve may differ from a straight line and be none."""

BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))
"""The largest light of a number below the saturation level."""

_RAMP = np.linspace(0, 1, 257)


@dataclass(frozen=True)
class Formula:
    """A curve as ICC.1 has it (parametricCurveType, function type 4), of which the others are cases.

    Light is ``(a v + b)^gamma + e`` from v = d on, and ``c v + f`` below; v is 1 for white.
    """

    gamma: float
    a: float = 1.0
    b: float = 0.0
    c: float = 0.0
    d: float = -np.inf
    e: float = 0.0
    f: float = 0.0

    def light(self, encoded: Array) -> Array:
        """Light of encoded values v, float64; odd about 0 where the power has no end there."""
        inner = self.a * encoded + self.b
        with np.errstate(over="ignore"):
            power = np.sign(inner) * np.abs(inner) ** self.gamma + self.e
        return np.where(encoded >= self.d, power, self.c * encoded + self.f)


@dataclass(frozen=True)
class Table:
    """A curve as a table of light at equal steps of v from 0 to 1, straight in between and beyond."""

    values: tuple[float, ...]

    def light(self, encoded: Array) -> Array:
        """Light of encoded values v, float64."""
        values = np.array(self.values)
        last = len(values) - 1
        place = np.asarray(encoded, np.float64) * last
        # Beyond an end the step there goes on: a float file may hold more than white, or noise about 0.
        cell = np.clip(np.floor(place), 0, last - 1).astype(np.intp)
        return np.asarray(values[cell] + (place - cell) * (values[cell + 1] - values[cell]))


Curve = Formula | Table

SRGB = Formula(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
"""IEC 61966-2-1."""

LIGHTNESS = Formula(3.0, 1 / 1.16, 0.16 / 1.16, 27 / 243.89, 0.08)
"""Lightness L* of CIE 15 over 100, as eciRGB v2 has it: (24389 / 27) Y below 8."""


@dataclass(frozen=True)
class ToneCurve:
    """The curve of a photograph.

    Attributes
    ----------
    name : str
        What people call it.
    channels : tuple of Formula or Table
        One for all channels, or one for each.
    colours : tuple of float
        The profile's red, green and blue (X, Y, Z of each), where a profile says the curve.
    """

    name: str
    channels: tuple[Curve, ...]
    colours: tuple[float, ...] = ()

    def same_as(self, other: ToneCurve) -> bool:
        """Test whether two photographs mean the same, though their curves may be written differently."""
        if self == other:
            return True
        count = max(len(self.channels), len(other.channels))
        ramps = [_ramps(curve, count) for curve in (self, other)]
        alike = float(np.abs(ramps[0] - ramps[1]).max()) <= SAME
        return alike and np.allclose(self.colours or (0,), other.colours or (0,), atol=5e-3)


def _ramps(curve: ToneCurve, count: int) -> Array:
    """Light of a ramp up to white, 1 there, for so many channels."""
    own = [one.light(_RAMP) / one.light(np.ones(1)) for one in curve.channels]
    return np.stack(own * (count if len(own) == 1 else 1))


def stated_curve(transfer: str) -> ToneCurve | None:
    """Curve that a capture states: "linear", "srgb", "L*" or "gamma" and a number; None: light itself."""
    if transfer == "linear":
        return None
    if transfer == "srgb":
        return ToneCurve("sRGB", (SRGB,))
    if transfer == "L*":
        return ToneCurve("L*", (LIGHTNESS,))
    gamma = float(transfer.removeprefix("gamma"))
    return None if gamma == 1 else ToneCurve(f"gamma {gamma:g}", (Formula(gamma),))


def profile_curve(profile: bytes, channels: int) -> ToneCurve | None:
    """Curve that an ICC profile states for images of so many channels; None: light itself.

    Raises
    ------
    ProfileError
        Where it states none, or is damaged.
    """
    found = parse_profile(profile)
    curves: list[Curve] = []
    for kind, numbers in found.curves:
        curve = Formula(*numbers) if kind == "formula" else Table(numbers)
        _check(curve, found.name)
        curves.append(curve)
    if len(set(curves)) == 1:
        curves = curves[:1]
    if len(curves) > 1 and channels == 1:
        raise ProfileError(f"'{found.name}' has three curves that differ, and the file one channel")
    if found.grey and channels == 3:
        raise ProfileError(f"'{found.name}' is for grey, and the file is in colour")
    whole = ToneCurve(f"the profile '{found.name}'", tuple(curves), found.colours)
    return None if np.abs(_ramps(whole, 1) - _RAMP).max() <= STRAIGHT else whole


def _check(curve: Curve, name: str) -> None:
    """Refuse what no tone curve is: a profile may be damaged, or made for something else."""
    with np.errstate(all="ignore"):
        light = curve.light(np.linspace(0, 1, 4097))
    if not np.isfinite(light).all() or (np.diff(light) < -1e-9).any() or not light[-1] > max(light[0], 0):
        raise ProfileError(f"'{name}' is damaged: its curve does not rise from black to white")


def curve_of(transfer: str | None, profile: bytes | None, channels: int, path: object) -> ToneCurve | None:
    """Curve of a photograph: as the capture states, else as its own profile does, else none.

    Parameters
    ----------
    transfer : str or None
        What the capture states; it goes before the profile.
    profile : bytes or None
        What the file embeds.
    channels : int
        Of the file.
    path : Path
        Of the file, for sentences.

    Raises
    ------
    TileError
        Where the profile has to tell, and cannot.
    """
    if transfer not in (None, "icc"):
        return stated_curve(str(transfer))
    if profile is None:
        if transfer is None:
            return None
        raise TileError(
            f"{path}: has no embedded profile, but encoding.transfer is icc; state the tone curve itself (linear, "
            'srgb, "gamma 2.2" or "L*"), or export it with its profile'
        )
    try:
        return profile_curve(profile, channels)
    except ProfileError as fault:
        raise TileError(
            f"{path}: its embedded profile {fault}, so what its numbers mean is not known; state encoding.transfer "
            '(linear, srgb, "gamma 2.2" or "L*"), or export it linearly'
        ) from None


def linear_light(numbers: Array, saturation: float, curve: Curve | None = None) -> Array:
    """Turn a file's numbers into linear light.

    Parameters
    ----------
    numbers : array of uint8, uint16, uint32 or float32
        What the file holds, in any byte order.
    saturation : float
        Level at which the sensor saturates, in those numbers.  Infinite: nothing saturates, light is 1
        at the largest number of their type (1 for floats), and integers stay below 1.
    curve : Formula or Table, optional
        The tone curve that is undone (see `white_of` for what its white is); none by default.

    Returns
    -------
    float32 array of the same shape
        Fraction of the light at the saturation level: 1 or more exactly where the number is at or above it.
    """
    scale = saturation if np.isfinite(saturation) else full_scale(numbers.dtype)
    unsigned, size = numbers.dtype.kind == "u", numbers.dtype.itemsize
    if curve is None and not (unsigned and size == 4):
        # Up to 24 bits the correctly rounded quotient never reaches 1 from below.
        light = np.divide(numbers, np.float32(scale), dtype=np.float32)
    elif unsigned and size < 4:
        light = _table(size, scale, curve)[numbers]
    else:
        light = _decoded(numbers, scale, white_of(scale, numbers.dtype), curve)
    return np.minimum(light, BELOW_ONE) if unsigned and np.isinf(saturation) else light


def _decoded(numbers: Array, scale: float, white: float, curve: Curve | None) -> Array:
    """Light of numbers, computed one by one in double precision."""
    fraction = numbers / np.float64(scale)
    if curve is None:
        light = fraction.astype(np.float32)
    else:
        most = curve.light(np.array([scale / white]))[0]
        light = (curve.light(numbers / np.float64(white)) / most).astype(np.float32)
    return np.where(fraction >= 1, np.maximum(light, np.float32(1)), np.minimum(light, BELOW_ONE))


@lru_cache(maxsize=16)
def _table(itemsize: int, scale: float, curve: Curve | None) -> Array:
    """Linear light of every 8- or 16-bit number: a power per pixel would cost more than the physics."""
    white = white_of(scale, np.dtype(f"u{itemsize}"))
    return _decoded(np.arange(256**itemsize, dtype=np.uint32), scale, white, curve)


def white_of(saturation: float, dtype: np.dtype[np.generic]) -> float:
    """Number that a tone curve takes for white, where the sensor saturates at another.

    It is the largest of the type (1 for floats), since a program that applies a curve does so to the
    whole range, and may leave white to what is brighter than the sensor's end.  But a level of fewer
    bits, all of them set (1023, 4095, 16383), says that the range is that; so does one above 1 in floats.
    """
    full = full_scale(dtype)
    if dtype.kind != "u":
        return max(full, saturation)
    fewer = saturation.is_integer() and saturation > 1 and not int(saturation) & (int(saturation) + 1)
    return saturation if fewer and saturation < full else full


def full_scale(dtype: np.dtype[np.generic]) -> float:
    """The largest number of an unsigned type; 1 for floats."""
    return float(256**dtype.itemsize - 1) if dtype.kind == "u" else 1.0
