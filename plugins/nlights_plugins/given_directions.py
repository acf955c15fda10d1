"""The given-directions light model: lamps as text files state them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from nlights_core.algorithms import LightModel, Read
from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.names.listed import match_listed

LARGEST = 1 << 19
"""Bytes: no list of lights is larger."""


class GivenDirections(LightModel):
    """Distant lamps whose directions, and strengths where known, somebody has calibrated.

    Reads the directions of RTI domes (``.lp``, ``.dome``), of PSBox (a column per light), of DiLiGenT (a
    row per light) and of the University of Washington (a count, then a row per light).  x is to
    the right, y up, z towards the camera.  Where a file names photographs, each light goes to the
    photograph of that name, whatever its extension.
    """

    name: ClassVar[str] = "given-directions"
    needs: ClassVar[tuple[str, ...]] = ("lights",)

    def locate(self, tile: Tile, read: Read) -> LightField:
        """Read the tile's files of lights; no photograph is read.

        Parameters
        ----------
        tile : Tile
            Its ``lights`` name the files.
        read : Read
            Not used.

        Returns
        -------
        LightField
            Distant; the power is 1, or as the file of intensities says.

        Raises
        ------
        TileError
            When the tile names no files, or one does not fit its frames.
        """
        if tile.lights is None:
            raise TileError(f"tile {tile.name}: given-directions needs a file of directions under 'lights:'")
        listed = read_directions(tile.lights.directions)
        order = _order(tile, listed)
        power = np.ones((1, 1))
        if tile.lights.intensities is not None:
            power = read_intensities(tile.lights.intensities, len(listed.directions))[order]
        return LightField(lamps=tile.lamps, directions=listed.directions[order], power=power)


class Listed(NamedTuple):
    """Contents of a file of directions.

    Attributes
    ----------
    path : Path
        The file.
    names : tuple of str or None
        File names of the photographs, where the file gives them.
    directions : (L, 3) float64 array
        Unit vectors in the plane frame.
    """

    path: Path
    names: tuple[str, ...] | None
    directions: Array


def read_directions(path: Path) -> Listed:
    """Read light directions: an ``.lp`` list, a counted list, a matrix, or Relight's ``.dome``.

    A file whose first line is one whole number is a list: that many lines follow, each with x y
    z, after a file name (with or without spaces) where there is one.  Any other file is a
    matrix of L rows and 3 columns or of 3 rows and L columns; 3 by 3 is taken as a row per light.

    Parameters
    ----------
    path : Path
        A text file; empty lines and lines that start with # are skipped.

    Returns
    -------
    Listed
        In the file's order, scaled to unit length.

    Raises
    ------
    TileError
        When the file is none of these, or a direction is not finite, zero, or not above the
        artwork's plane.
    """
    lines = _lines(path)
    names: tuple[str, ...] | None = None
    if lines[0].lstrip().startswith("{"):
        matrix = _dome(path, "\n".join(lines))
    elif re.fullmatch("[0-9]{1,9}", lines[0].strip()):
        count, rows = int(lines[0].strip()), [line.rsplit(maxsplit=3) for line in lines[1:]]
        if len(rows) != count or not count:
            raise TileError(f"{path}: the first line says {count} lights, but {len(rows)} lines follow")
        matrix = _numbers(path, [row[-3:] for row in rows])
        named = [len(row) == 4 for row in rows]
        if any(named) and not all(named):
            raise TileError(
                f"{path}: light {named.index(not named[0]) + 1} has {'no' if named[0] else 'a'} name, unlike those "
                "before it; name the photographs of all lights, or of none"
            )
        if all(named):
            names = tuple(row[0] for row in rows)
    else:
        matrix = _numbers(path, [line.split() for line in lines])
        if matrix.shape[1] != 3 and matrix.shape[0] == 3:
            matrix = matrix.T
    if matrix.shape[1] != 3:
        raise TileError(
            f"{path}: {matrix.shape[0]} rows of {matrix.shape[1]} numbers; directions are "
            "L rows of 3 or 3 rows of L"
        )
    for number, direction in enumerate(matrix, 1):
        if not np.any(direction):
            raise TileError(f"{path}: light {number} is a zero vector; give its direction x y z")
        if direction[2] <= 0:
            raise TileError(
                f"{path}: light {number} has z = {direction[2]:g}, behind the artwork; x is right, y up, "
                "z towards the camera and above 0"
            )
    matrix = matrix / np.abs(matrix).max(
        axis=1, keepdims=True
    )  # else the squares of very large numbers are infinite
    return Listed(path, names, matrix / np.linalg.norm(matrix, axis=1, keepdims=True))


def _dome(path: Path, text: str) -> Array:
    """Directions of a dome file of Relight; its positions, where it has them, are not used."""
    try:
        return _numbers(path, [[light[axis] for axis in "xyz"] for light in json.loads(text)["directions"]])
    except (ValueError, KeyError, TypeError, RecursionError) as fault:
        raise TileError(
            f"{path}: is no dome file of Relight: JSON with directions, each of x, y, z ({fault})"
        ) from fault


def read_intensities(path: Path, count: int) -> Array:
    """Read light intensities.

    Parameters
    ----------
    path : Path
        A text file with a row per light, in the order of the file of directions: one number, or
        red, green and blue.
    count : int
        How many lights there are.

    Returns
    -------
    (count, 1) or (count, 3) float64 array
        As in the file: only ratios matter.

    Raises
    ------
    TileError
        When the shape is another, or a number is not finite and positive.
    """
    matrix = _numbers(path, [line.split() for line in _lines(path)])
    if matrix.shape not in ((count, 1), (count, 3)):
        raise TileError(
            f"{path}: {matrix.shape[0]} rows of {matrix.shape[1]} numbers, but {count} lights need "
            f"{count} rows of 1 (grey) or 3 (red, green, blue)"
        )
    if np.any(matrix <= 0):
        number = int(np.nonzero(np.any(matrix <= 0, axis=1))[0][0]) + 1
        raise TileError(
            f"{path}: light {number} has an intensity of {matrix[number - 1].min():g}; it must be above 0"
        )
    return matrix


def _order(tile: Tile, listed: Listed) -> list[int]:
    """Index in the file of each frame's light: by the names in it, as listed where it has none."""
    frames = list(tile.frames.values())
    if listed.names is None:
        if len(listed.directions) != len(frames):
            raise TileError(
                f"{listed.path}: {len(listed.directions)} lights, but tile {tile.name} has {len(frames)} frames; "
                "list one light per frame"
            )
        return list(range(len(frames)))
    matched = match_listed(listed.names, frames)
    if matched.doubtful:
        raise TileError(
            f"{listed.path}: {'; '.join(matched.doubtful[:3])}; write the folders of both, or keep one line for each"
        )
    missing = [path.name for path, line in zip(frames, matched.lines, strict=True) if line is None]
    if len(missing) == len(frames):
        raise TileError(
            f"{listed.path}: names {_few(listed.names)}, and none of them is a frame of tile {tile.name} "
            f"({_few(missing)}); correct the names, or remove them all and list the lights in the order of the frames"
        )
    if missing:
        raise TileError(
            f"{listed.path}: names some of the frames of tile {tile.name} but not {_few(missing, 8)}; add a line for "
            "each, or leave those frames out of artwork.yaml"
        )
    return [line for line in matched.lines if line is not None]


def _few(names: Sequence[str], most: int = 3) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _lines(path: Path) -> list[str]:
    """Lines of a text file that say something."""
    try:
        if kind := irregular_kind(path):
            raise TileError(f"{path}: {kind}, where a text file is expected; name the file itself")
        if path.stat().st_size > LARGEST:
            raise TileError(f"{path}: larger than {LARGEST >> 10} KiB, which no list of lights is")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as fault:
        raise TileError(f"{path}: cannot be read ({fault.strerror}); see whether it is there") from fault
    except UnicodeDecodeError as fault:
        raise TileError(f"{path}: not a text file (UTF-8); save it as plain text") from fault
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise TileError(f"{path}: the file is empty; it needs a line per light")
    return lines


def _numbers(path: Path, rows: list[list[str]]) -> Array:
    """A float64 matrix of finite numbers from split lines."""
    if len({len(row) for row in rows}) != 1 or not rows[0]:
        raise TileError(
            f"{path}: lines hold different numbers of values; each light needs as many as the others"
        )
    try:
        matrix = np.array([[float(value) for value in row] for row in rows])
    except (ValueError, TypeError, OverflowError) as fault:
        raise TileError(f"{path}: not a number where one is expected: {str(fault)[:200]}") from fault
    if not np.isfinite(matrix).all():
        row = int(np.nonzero(~np.isfinite(matrix).all(axis=1))[0][0]) + 1
        raise TileError(f"{path}: row {row} holds a number that is not finite (NaN or infinity); correct it")
    return matrix
