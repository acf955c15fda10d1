"""Known heights: what somebody measured by other means, read from files and compared with a height map."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from scipy.ndimage import map_coordinates

from nlights_core.capture import HeightFile
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, KnownHeights
from nlights_core.frames import Array
from nlights_core.machine.regular_files import irregular_kind

MOST = 200_000
"""Points that are kept of a scan, evenly from first to last: a smooth correction needs no more."""

DIFFERENCES = "known_heights.csv"
"""Where it stands to which heights a height was tied."""

COLUMNS = ("x_mm", "y_mm", "z_mm", "sigma_mm")
"""Of a CSV; the last may be absent."""


def read_known_heights(given: HeightFile) -> KnownHeights:
    """Read a CSV or a PLY of heights that somebody measured.

    Parameters
    ----------
    given : HeightFile
        The file, and what the manifest says of it.

    Returns
    -------
    KnownHeights
        Every point of the file, or `MOST` of them.

    Raises
    ------
    TileError
        With file, line and column, where it is missing, unreadable, or of another form.
    """
    path = given.file
    try:
        if kind := irregular_kind(path):
            raise TileError(f"{path}: known_heights: {kind}, where a file is expected; name the file itself")
    except OSError as fault:
        raise TileError(
            f"{path}: known_heights: cannot be read ({fault.strerror}); correct its name in the manifest"
        ) from fault
    if path.suffix.lower() == ".ply":
        points, sigma = _ply(path), None
    elif path.suffix.lower() in (".csv", ".txt"):
        points, sigma = _csv(path)
    else:
        raise TileError(f"{path}: known_heights: is neither a CSV nor a PLY by its name; write one of them")
    if sigma is None:
        if given.sigma_mm is None:
            raise TileError(
                f"{path}: known_heights: has no column sigma_mm, and the manifest states none; add "
                "sigma_mm (the standard uncertainty of a height, mm) to either"
            )
        sigma = np.full(len(points), given.sigma_mm)
    step = -(-len(points) // MOST) or 1
    return KnownHeights(points[::step], sigma[::step], given.registration_mm, given.tilted, path.name)


def _ply(path: Path) -> Array:
    """Vertices of a PLY, (N, 3) float64."""
    import trimesh

    try:
        with path.open("rb") as file:
            loaded: Any = trimesh.load(file, file_type="ply", process=False)
        points = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
    except OSError as fault:
        raise TileError(f"{path}: known_heights: cannot be read ({fault.strerror})") from fault
    except Exception as fault:  # its reader lets anything through
        raise TileError(
            f"{path}: known_heights: is no PLY that can be read ({type(fault).__name__}: {fault}); export it "
            "anew, as binary or text, with vertices x, y, z"
        ) from fault
    if not len(points):
        raise TileError(f"{path}: known_heights: has no vertices; export the points")
    if not np.isfinite(points).all():
        raise TileError(f"{path}: known_heights: has vertices that are not finite; export it without them")
    return points


def _csv(path: Path) -> tuple[Array, Array | None]:
    """Points (N, 3) and uncertainties (N,) of a CSV, None where it has no such column."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, rows = _table(path, file)
            numbers = np.array(list(_numbers(path, header, rows)), np.float64)
    except OSError as fault:
        raise TileError(f"{path}: known_heights: cannot be read ({fault.strerror})") from fault
    except (UnicodeDecodeError, csv.Error) as fault:
        raise TileError(f"{path}: known_heights: is no CSV in UTF-8; export it as that") from fault
    if not len(numbers):
        raise TileError(f"{path}: known_heights: has no points; write one on each line")
    return numbers[:, :3], numbers[:, 3] if "sigma_mm" in header else None


def _table(path: Path, file: TextIO) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Header of a CSV, and its further lines with their numbers; # begins a remark."""
    first, number = "", 0
    while (not first or first.startswith("#")) and (line := file.readline()):
        first, number = line.strip(), number + 1
    divider = next((sign for sign in ";\t" if sign in first), ",")
    header = [name.strip().strip('"') for name in first.split(divider)]
    missing = [name for name in COLUMNS[:3] if name not in header]
    if missing:
        raise TileError(
            f"{path}: known_heights: has no column {', '.join(missing)} in its first line; name the columns "
            f"{', '.join(COLUMNS)} (plane frame, mm; the last may be absent)"
        )
    return header, (
        (number + i, row)
        for i, row in enumerate(csv.reader(file, delimiter=divider), 1)
        if "".join(row).strip() and not row[0].lstrip().startswith("#")
    )


def _numbers(path: Path, header: list[str], rows: Iterable[tuple[int, list[str]]]) -> Iterator[list[float]]:
    """x, y, z and perhaps sigma of each line."""
    wanted = [name for name in COLUMNS if name in header]
    places = [header.index(name) for name in wanted]
    for number, row in rows:
        found = []
        for name, place in zip(wanted, places, strict=True):
            text = row[place].strip() if place < len(row) else ""
            try:
                value = float(text)
            except ValueError:
                value = np.nan
            if not np.isfinite(value) or (name == "sigma_mm" and value <= 0):
                allowed = "a number above 0" if name == "sigma_mm" else "a finite number with a decimal point"
                raise TileError(
                    f"{path}:{number}: known_heights: {name}: should be {allowed}, mm; got {text!r}"
                )
            found.append(value)
        yield found


def within(field: HeightMap, known: KnownHeights) -> Array:
    """Test which known points lie on the photograph's field, (N,) bool."""
    grid = field.grid
    across, up = (n * grid.pixel_size / 2 for n in (grid.columns, grid.rows))
    return (np.abs(known.points[:, 0]) <= across) & (np.abs(known.points[:, 1]) <= up)


def heights_at(field: HeightMap, known: KnownHeights) -> tuple[Array, Array]:
    """Heights of the map where others were measured.

    Where a point's place is uncertain, the height is the mean over where it may be, and its spread
    there is an uncertainty: a probe that may have met either side of a stroke says less.

    Parameters
    ----------
    field : HeightMap
    known : KnownHeights

    Returns
    -------
    height : (N,) float64 array
        NaN where the map is not known, or the point is outside.
    spread : (N,) float64 array
        Standard deviation over where the point may be, in the height's unit; 0 where its place is sure.
    """
    x, y = known.points[:, 0], known.points[:, 1]
    inside = within(field, known)
    middle = np.where(inside, _between(field, x, y), np.nan)
    # A point that is higher than the plane is seen farther out.
    if field.grid.camera is not None:
        lens = field.grid.camera
        share = np.nan_to_num(middle) / lens[2]
        x, y = (x - lens[0] * share) / (1 - share), (y - lens[1] * share) / (1 - share)
        middle = np.where(inside, _between(field, x, y), np.nan)
    if not known.registration_mm:
        return middle, np.zeros(len(middle))
    total, squares, count = (np.zeros(len(middle)) for _ in range(3))
    # Nine places whose mean square is the variance along each axis.
    reach = known.registration_mm * np.sqrt(1.5)
    for across in (-reach, 0.0, reach):
        for up in (-reach, 0.0, reach):
            found = _between(field, x + across, y + up) - np.nan_to_num(middle)
            there = np.isfinite(found)
            total += np.where(there, found, 0)
            squares += np.where(there, found, 0) ** 2
            count += there
    mean = total / np.maximum(count, 1)
    spread = np.sqrt(np.maximum(squares / np.maximum(count, 1) - mean**2, 0))
    return np.where(np.isfinite(middle), middle + mean, np.nan), spread


def _between(field: HeightMap, x: Array, y: Array) -> Array:
    """Heights between the four nearest pixels, NaN where one of them is not known or there are none."""
    grid = field.grid
    columns = np.asarray((x - grid.centre[0]) / grid.pixel_size + (grid.columns - 1) / 2)
    rows = np.asarray((grid.rows - 1) / 2 - (y - grid.centre[1]) / grid.pixel_size)
    out = (np.abs(columns - (grid.columns - 1) / 2) > grid.columns / 2) | (
        np.abs(rows - (grid.rows - 1) / 2) > grid.rows / 2
    )
    places = np.stack([np.clip(rows, 0, grid.rows - 1), np.clip(columns, 0, grid.columns - 1)])
    found = map_coordinates(field.height, places, np.float64, order=1, mode="nearest")
    found[out] = np.nan
    return np.asarray(found)


def differences(field: HeightMap, known: KnownHeights, removed: Array | None = None) -> Array:
    """Differences of a height map to known heights after the best constant, and tilt where that is free.

    Parameters
    ----------
    field : HeightMap
    known : KnownHeights
    removed : (H, W) float32 array, optional
        What is taken from the height before.

    Returns
    -------
    (N,) float64 array
        In the height's unit; NaN where the map is not known.  The constant (and tilt) is that of least
        absolute differences, so that a few odd points do not move it.
    """
    found = heights_at(field, known)[0] - known.points[:, 2]
    if removed is not None:
        found -= heights_at(HeightMap(removed, field.grid), known)[0]
    there = np.isfinite(found)
    if not there.any():
        return found
    terms = np.ones((int(there.sum()), 1))
    if known.tilted:
        terms = np.column_stack([terms, known.points[there, :2]])
    found[there] -= terms @ least_absolute(terms, found[there])
    return found


def write_differences(folder: Path, field: HeightMap, removed: Array, known: KnownHeights) -> None:
    """Write ``known_heights.csv``: each known height, and its difference before and after a trend was removed.

    Parameters
    ----------
    folder : Path
        Where it goes.
    field : HeightMap
        The height that was photographed.
    removed : (H, W) float32 array
        The trend, mm.
    known : KnownHeights
    """
    before, after = differences(field, known), differences(field, known, removed)
    lines = [",".join((*COLUMNS, "before_mm", "after_mm"))]
    for point, sigma, *off in zip(known.points, known.sigma, before, after, strict=True):
        numbers = [f"{value:.6g}" for value in (*point, sigma)]
        lines.append(",".join([*numbers, *("" if np.isnan(value) else f"{value:.4f}" for value in off)]))
    (folder / DIFFERENCES).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_differences(folder: Path) -> tuple[Array, Array] | None:
    """Differences before and after, (N,) float64 mm each, NaN where none; None where nothing was written."""
    path = folder / DIFFERENCES
    if not path.is_file():
        return None
    table = np.genfromtxt(path, delimiter=",", skip_header=1, ndmin=2)
    return table[:, -2], table[:, -1]


def least_absolute(terms: Array, values: Array, rounds: int = 40) -> Array:
    """Coefficients of the terms (N, K) of least absolute distance from values (N,), by reweighting."""
    weights = np.ones(len(values))
    coefficients = np.zeros(terms.shape[1])
    for _ in range(rounds):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(terms * root[:, None], values * root, rcond=1e-12)[0]
        left = np.abs(values - terms @ coefficients)
        weights = 1 / np.maximum(left, 1e-6 + 1e-3 * np.median(left))
    return coefficients
