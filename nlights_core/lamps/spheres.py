"""Chrome spheres: the circle of their outline, the highlight, and the direction it tells.

Image coordinates are (column, row) in pixels, pixel centres at whole numbers, rows downwards;
directions are in the plane frame (y up).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nlights_core.frames import Array

GREY = np.array([0.298936021293775, 0.587043074451121, 0.114020904255103])
"""Rec. 601 luma to all its digits, as MATLAB's ``rgb2gray`` (and hence PSBox) has it."""


def to_grey(photograph: Array) -> Array:
    """Grey values of a photograph.

    Parameters
    ----------
    photograph : (h, w, C) array
        One channel, or red, green, blue (further channels are ignored).

    Returns
    -------
    (h, w) float64 array
        In the photograph's own unit.
    """
    if photograph.shape[2] < 3:
        return photograph[..., 0].astype(float)
    return np.asarray(photograph[..., :3].astype(float) @ GREY)


def fit_circle(points: Array, *, tolerance: float | None = None) -> Array:
    """Circle with the least squared distance to given points.

    The distance is geometric, ``hypot(x - xc, y - yc) - r``, as in PSBox's ``FitCircle.m``.

    Parameters
    ----------
    points : (n, 2) array
        Column and row of each point, px; n is at least 3.
    tolerance : float, optional
        Distance in px from which on a point counts less and less (Cauchy's loss).  None: plain
        least squares, every point counts.

    Returns
    -------
    (3,) float64 array
        Column and row of the centre, radius; px.

    Examples
    --------
    >>> fit_circle(np.array([[3, 2], [1, 4], [-1, 2], [1, 0]])).round(9).tolist()
    [1.0, 2.0, 2.0]
    """
    from scipy.optimize import least_squares

    points = np.asarray(points, float)

    def distances(circle: Array) -> Array:
        return np.asarray(np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2])

    start = np.array([*points.mean(axis=0), points.std(axis=0).sum()])
    loss = {} if tolerance is None else {"loss": "cauchy", "f_scale": tolerance}
    fit = least_squares(distances, start, xtol=1e-12, ftol=1e-12, gtol=1e-12, x_scale=start[2] or 1, **loss)
    return np.asarray(fit.x)


def circle_of_mask(mask: Array) -> Array:
    """Circle along the outline of a mask, though a stand may hide a part of the sphere.

    Parameters
    ----------
    mask : (h, w) array
        The sphere is where it exceeds half its largest value: scanned masks are not clean.

    Returns
    -------
    (3,) float64 array
        Column and row of the centre, radius; px.

    Raises
    ------
    ValueError
        When the mask is empty.
    """
    from skimage.measure import find_contours

    # A frame of zeros closes the outline of a mask that touches the border.
    framed = np.pad(np.asarray(mask, float), 1)
    outlines = find_contours(framed, 0.5 * framed.max())  # type: ignore[no-untyped-call]
    if not outlines:
        raise ValueError("the mask is the same everywhere")
    outline = max(outlines, key=len)[:, ::-1] - 1
    return fit_circle(outline, tolerance=max(1.0, 0.002 * len(outline)))


def highlight_centre(grey: Array, circle: Array, threshold: float) -> Array:
    """Place of the lamp's highlight on a chrome sphere.

    The median of the columns and of the rows of all bright pixels inside the disc, as in
    PSBox: small second reflections shift a mean by degrees, a median hardly.

    Parameters
    ----------
    grey : (h, w) array
        Photograph as fractions of saturation.
    circle : (3,) array
        Column and row of the centre, radius; px.
    threshold : float
        Pixels at least this bright are the highlight; to the nearest of 256 levels, since
        PSBox rounds its grey to 8 bits.  When there are none, it is those of at least 90 % of
        the disc's brightest, if that stands out.

    Returns
    -------
    (2,) float64 array
        Column and row, px.

    Raises
    ------
    ValueError
        When nothing stands out in the disc; the message says what was found.
    """
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    inside = np.hypot(columns - circle[0], rows - circle[1]) < circle[2]
    if not inside.any():
        raise ValueError("the circle lies outside the photograph")
    disc = grey[inside]
    bright = disc >= threshold - 0.5 / 255
    if not bright.any():
        peak, typical = float(disc.max()), float(np.median(disc))
        if peak < 3 * typical or peak <= 0:
            raise ValueError(
                f"its brightest pixel, {peak:.3g}, is under three times its median, {typical:.3g}"
            )
        bright = disc >= 0.9 * peak
    if bright.mean() > 0.1:
        raise ValueError(f"{100 * bright.mean():.0f} % of the disc are bright, a highlight is below 10 %")
    spot = np.array([np.median(columns[inside][bright]), np.median(rows[inside][bright])])
    away = np.hypot(columns[inside][bright] - spot[0], rows[inside][bright] - spot[1])
    together = float(np.mean(away < max(2.0, 0.3 * circle[2])))
    if together < 0.5:
        raise ValueError(
            f"its bright pixels lie scattered, only {100 * together:.0f} % of them together as a mirror has them"
        )
    return spot


def mirror_direction(highlight: Array, circle: Array) -> Array:
    """Direction to the lamp whose highlight is seen on a chrome sphere.

    With the viewing direction v = (0, 0, 1) of a distant camera, the normal under a highlight
    that lies (dx, dy) px to the right of and above the centre is ``n = (dx, dy, sqrt(r^2 -
    dx^2 - dy^2)) / r``, and the law of mirrors gives ``l = 2 (n . v) n - v``.

    Parameters
    ----------
    highlight : (2,) array
        Column and row of the highlight, px.
    circle : (3,) array
        Column and row of the centre, radius; px.

    Returns
    -------
    (3,) float64 array
        Unit vector from the artwork to the lamp, plane frame.

    Examples
    --------
    A highlight 0.6 radii above the centre, where the sphere is inclined by 36.87 degrees:

    >>> mirror_direction(np.array([50.0, 20.0]), np.array([50.0, 50.0, 50.0])).round(12).tolist()
    [0.0, 0.96, 0.28]
    """
    x = (highlight[0] - circle[0]) / circle[2]
    y = (circle[1] - highlight[1]) / circle[2]
    normal = np.array([x, y, np.sqrt(max(0.0, 1 - x * x - y * y))])
    return np.asarray(2 * normal[2] * normal - np.array([0.0, 0.0, 1.0]))


BUNCHED_DEG = 6.0
"""Directions that are no further from their mean, rms, are no rig's: real ones have 14 to 25."""

LEANING_DEG = 50.0
"""Inclination of the mean of all directions that no rig has: lamps stand around the artwork."""

THINNEST = 0.05
"""Least singular value of directions over sqrt(L), below which all lie in one plane: real ones have 0.15 up."""

COINCIDENT_DEG = 1.0
"""Two lamps are not so near to each other: one bright spot was taken for the highlights of both."""


def doubt_of_directions(directions: Array, lamps: Sequence[str]) -> str | None:
    """Reason why directions are those of no rig, as a clause; None where there is none.

    Parameters
    ----------
    directions : (L, 3) array
        Unit vectors to the lamps.  Fewer than three are not judged.
    lamps : sequence of str
        Their names.
    """
    if len(directions) < 3:
        return None
    mean = directions.mean(axis=0)
    mean = mean / np.linalg.norm(mean)
    spread = float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(directions @ mean, -1, 1)) ** 2))))
    lean = float(np.degrees(np.arccos(np.clip(mean[2], -1, 1))))
    if spread < BUNCHED_DEG:
        return (
            f"the highlights are bunched: all lamps would be within {spread:.1f} degrees (rms) of one direction, "
            f"and a rig's are {BUNCHED_DEG:.0f} at the least"
        )
    if lean > LEANING_DEG:
        return (
            f"all lamps would stand on one side, {lean:.0f} degrees from the camera in the mean, and a rig's "
            f"stand around the artwork ({LEANING_DEG:.0f} at the most)"
        )
    near = np.triu(np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1))) < COINCIDENT_DEG, 1)
    if near.any():
        first, second = (lamps[k] for k in np.argwhere(near)[0])
        return (
            f"lamps {first} and {second} would be less than {COINCIDENT_DEG:.0f} degree apart: a spot that does "
            "not move was taken for their highlights"
        )
    if np.linalg.svd(directions, compute_uv=False)[-1] < THINNEST * np.sqrt(len(directions)):
        return "all lamps would lie in one plane with the artwork, and a rig's stand around it"
    return None
