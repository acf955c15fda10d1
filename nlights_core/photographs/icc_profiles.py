"""ICC profiles: the tone curves that they state, and what they become when those are undone.

Only what the curves need is read, after ICC.1:2010 (versions 2 and 4): a header of 128 bytes, a table of tags,
and big-endian numbers.  No library gives the curves exactly: Pillow's ImageCms works in 8 bits.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

LARGEST_NAME = 60
"""Characters of a profile's name that a sentence shows."""

_HEADER = 128
_TAG = struct.Struct(">4sII")
_CURVES = (b"rTRC", b"gTRC", b"bTRC")
_COLOURS = (b"rXYZ", b"gXYZ", b"bXYZ")
_STRAIGHT = b"curv" + bytes(8)
_KEPT = (b"cprt", b"wtpt", b"bkpt", b"chad", b"lumi", b"tech", *_COLOURS)
"""What stays true of linear light."""

_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}
"""Numbers of a parametric curve, by its type."""

_CLASSES = {b"link": "links two devices", b"abst": "is an abstract one", b"nmcl": "lists named colours"}


class ProfileError(ValueError):
    """A profile states no tone curve: its name in quotes and why, as the middle of a sentence."""


@dataclass(frozen=True)
class Profile:
    """Curves and colours of a profile.

    Attributes
    ----------
    name : str
        Its description.
    grey : bool
        It is for images of one channel.
    curves : tuple of (str, tuple of float)
        Of each channel "formula" and its gamma, a, b, c, d, e, f, or "table" and its values, 1 for white.
    colours : tuple of 9 floats
        X, Y, Z of red, green and blue; empty for grey.
    """

    name: str
    grey: bool
    curves: tuple[tuple[str, tuple[float, ...]], ...]
    colours: tuple[float, ...]


@lru_cache(maxsize=16)
def parse_profile(profile: bytes) -> Profile:
    """Read the curves of a profile.

    Raises
    ------
    ProfileError
        Where it has none (tables of colours, CMYK, Lab), or is damaged.
    """
    try:
        return _parsed(profile)
    except (struct.error, IndexError, OverflowError):
        raise ProfileError(f"'{_name(profile)}' is damaged or cut short") from None


def _parsed(profile: bytes) -> Profile:
    tags, name = _tags(profile), _name(profile)
    space, kind = profile[16:20], profile[12:16]
    if kind in _CLASSES:
        raise ProfileError(f"'{name}' {_CLASSES[kind]} and states no tone curve")
    if space not in (b"RGB ", b"GRAY"):
        found = space.decode("ascii", "replace").strip()
        raise ProfileError(f"'{name}' is for {found} and not for RGB or grey")
    wanted = (b"kTRC",) if space == b"GRAY" else _CURVES
    if not all(tag in tags for tag in wanted):
        if any(tag.startswith((b"A2B", b"D2B")) for tag in tags):
            raise ProfileError(f"'{name}' is made of tables of colours (LUT), not of tone curves")
        raise ProfileError(f"'{name}' has no tone curves")
    curves = tuple(_curve(tags[tag], name) for tag in wanted)
    colours: tuple[float, ...] = ()
    if space == b"RGB " and all(tag in tags for tag in _COLOURS):
        colours = tuple(value for tag in _COLOURS for value in _fixed(tags[tag], 8, 3))
    return Profile(name, space == b"GRAY", curves, colours)


def _tags(profile: bytes) -> dict[bytes, bytes]:
    """Data of a profile by tag; struct.error where it is cut short."""
    if len(profile) < _HEADER + 4 or profile[36:40] != b"acsp":
        raise struct.error("no profile")
    (count,) = struct.unpack_from(">I", profile, _HEADER)
    tags = {}
    for i in range(min(count, 1000)):
        tag, start, size = _TAG.unpack_from(profile, _HEADER + 4 + _TAG.size * i)
        if start + size > len(profile):
            raise struct.error("a tag reaches past the end")
        tags[tag] = profile[start : start + size]
    return tags


def _curve(data: bytes, name: str) -> tuple[str, tuple[float, ...]]:
    """One tone curve, as `Profile.curves` has it."""
    if data[:4] == b"curv":
        (count,) = struct.unpack_from(">I", data, 8)
        if count == 0:
            return "formula", (1.0,)
        if count == 1:
            return "formula", (struct.unpack_from(">H", data, 12)[0] / 256,)
        return "table", tuple(value / 65535 for value in struct.unpack_from(f">{count}H", data, 12))
    if data[:4] == b"para":
        (kind,) = struct.unpack_from(">H", data, 8)
        if kind in _PARAMETERS:
            return "formula", _formula(kind, _fixed(data, 12, _PARAMETERS[kind]), name)
    raise ProfileError(f"'{name}' has a tone curve of no known type")


def _formula(kind: int, numbers: tuple[float, ...], name: str) -> tuple[float, ...]:
    """Gamma, a, b, c, d, e, f of a parametric curve of any of the five types."""
    if kind in (1, 2):
        gamma, a, b, *rest = numbers
        if a == 0:
            raise ProfileError(f"'{name}' is damaged: its curve does not rise from black to white")
        level = rest[0] if rest else 0.0
        return gamma, a, b, 0.0, -b / a, level, level
    return numbers


def _fixed(data: bytes, start: int, count: int) -> tuple[float, ...]:
    """Numbers of 16 bits before and 16 after the point."""
    return tuple(value / 65536 for value in struct.unpack_from(f">{count}i", data, start))


def _name(profile: bytes) -> str:
    """Description of a profile, as far as it can be read."""
    try:
        data = _tags(profile)[b"desc"]
        if data[:4] == b"mluc":
            size, start = struct.unpack_from(">II", data, 20)
            text = data[start : start + size].decode("utf-16-be", "replace")
        else:
            (size,) = struct.unpack_from(">I", data, 8)
            text = data[12 : 12 + size].decode("ascii", "replace")
    except (struct.error, KeyError):
        return "without a name"
    text = "".join(c for c in text.split("\0")[0] if c.isprintable()).strip()
    return text[:LARGEST_NAME] or "without a name"


@lru_cache(maxsize=16)
def linear_profile(profile: bytes, channels: int) -> bytes | None:
    """Profile of the same colours for linear light: its curves are straight lines.

    What is left of a photograph when its curve is undone would be shown wrongly by the profile that
    it came with.

    Parameters
    ----------
    profile : bytes
        What a photograph embeds.
    channels : int
        Of the images that shall embed it.

    Returns
    -------
    bytes or None
        The very same where its curves are straight already; None where it states no curves, for then
        nobody can say what it makes of linear light, and where it is for grey and the images are not.
    """
    try:
        found = parse_profile(profile)
    except ProfileError:
        return None
    if found.grey and channels != 1:
        return None
    if all(kind == "formula" and set(numbers) == {1.0} for kind, numbers in found.curves):
        return profile
    wanted = (b"kTRC",) if found.grey else _CURVES
    name = f"{found.name}, linear".encode("ascii", "replace")
    described = b"desc" + bytes(4) + struct.pack(">I", len(name) + 1) + name + b"\0" + bytes(8 + 3 + 67)
    if profile[8] >= 4:
        text = name.decode().encode("utf-16-be")
        described = b"mluc" + bytes(4) + struct.pack(">II2s2sII", 1, 12, b"en", b"US", len(text), 28) + text
    tags = {tag: data for tag, data in _tags(profile).items() if tag in _KEPT}
    tags |= {b"desc": described} | dict.fromkeys(wanted, _STRAIGHT)
    return _assembled(profile[:_HEADER], tags)


def _assembled(header: bytes, tags: dict[bytes, bytes]) -> bytes:
    """A profile of a header and tags; equal data are stored once."""
    places: dict[bytes, int] = {}
    table, body, start = b"", b"", _HEADER + 4 + _TAG.size * len(tags)
    for tag, data in tags.items():
        if data not in places:
            places[data] = start + len(body)
            body += data + bytes(-len(data) % 4)
        table += _TAG.pack(tag, places[data], len(data))
    whole = (
        header[4:84] + bytes(44) + struct.pack(">I", len(tags)) + table + body
    )  # no digest of the old content
    return struct.pack(">I", 4 + len(whole)) + whole
