"""Chrome spheres: the circle of their outline, the highlight, and the direction it tells.

Image coordinates are (column, row) in pixels, pixel centres at whole numbers, rows downwards;
directions are in the plane frame (y up).
"""

from __future__ import annotations

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


def find_circle(photographs: Array) -> tuple[Array, float]:
    """Outline of a chrome sphere, found in its photographs.

    A circular Hough transform of the edges of the mean photograph, reduced to about 250 px,
    gives a start.  Then the outline is sought along 720 rays in the median photograph (the
    highlights move from lamp to lamp and vanish in it): the outermost place where brightness
    still changes half as fast as at its steepest, because near its limb the sphere mirrors the
    background just outside and the steepest place lies a little inside.  A robust fit passes
    over the stand, the reflections and the shadows.

    Parameters
    ----------
    photographs : (L, h, w) array
        Grey photographs of one sphere under all lamps, or one in even light, which shows the
        outline better; its radius is from 12 to 55 % of the shorter side.

    Returns
    -------
    circle : (3,) float64 array
        Column and row of the centre, radius; px.
    support : float
        Share of the rays, from 0 to 1, whose edge lies within 2 % of the radius of the circle;
        chance alone gives a quarter.
    """
    circle = _hough_circle(np.mean(photographs, axis=0))
    median = _log(np.median(photographs, axis=0))
    for width in (0.08, 0.04, 0.02):
        points, _ = _outline_points(median, circle, width)
        if len(points) < 3:
            return circle, 0.0
        circle = fit_circle(points, tolerance=max(0.5, 0.002 * circle[2]))
    # Judged in a wide ring again: in a narrow one any edge is close to the circle.
    points, seen = _outline_points(median, circle, 0.08)
    distance = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]
    return circle, float(np.mean(np.abs(distance) < 0.02 * circle[2])) * seen


def _log(image: Array) -> Array:
    """Logarithm with a floor at one hundredth of the median: edges in the dark count too."""
    return np.asarray(np.log(image + 0.01 * np.median(image) + 1e-3))


def _hough_circle(image: Array) -> Array:
    """Most voted circle among an image's edges, to a few per cent of its radius; px."""
    from scipy.ndimage import gaussian_filter
    from skimage.feature import canny
    from skimage.transform import hough_circle

    factor = max(1, round(max(image.shape) / 250))
    h, w = (size // factor * factor for size in image.shape)
    small = image[:h, :w].reshape(h // factor, factor, w // factor, factor).mean(axis=(1, 3))
    quantiles = {"use_quantiles": True, "low_threshold": 0.7, "high_threshold": 0.9}
    edges = canny(_log(small), sigma=1.5, **quantiles)  # type: ignore[no-untyped-call]
    radii = np.arange(max(3, int(0.12 * min(small.shape))), int(0.55 * min(small.shape)) + 1)
    # Votes are blurred over neighbouring circles: a photographed outline is no perfect circle.
    votes = hough_circle(edges, radii, full_output=True)  # type: ignore[no-untyped-call]
    votes = gaussian_filter(votes, 1)
    index, row, column = np.unravel_index(votes.argmax(), votes.shape)
    centre = np.array([column, row]) - radii[-1]
    return np.array([*(centre * factor + (factor - 1) / 2), radii[index] * factor], float)


def _outline_points(image: Array, circle: Array, width: float) -> tuple[Array, float]:
    """Outermost strong edge on each ray within ``width`` radii; points (n, 2), share of rays."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    smooth = gaussian_filter(image, max(0.7, circle[2] / 300))
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    radius = np.arange(circle[2] * (1 - width), circle[2] * (1 + width), 0.5)[:, None]
    if len(radius) < 2:
        return np.empty((0, 2)), 0.0
    column, row = circle[0] + radius * np.cos(angle), circle[1] + radius * np.sin(angle)
    change = np.abs(np.gradient(map_coordinates(smooth, [row, column], order=1, mode="nearest"), axis=0))
    h, w = image.shape
    change[(column < 1) | (column > w - 2) | (row < 1) | (row > h - 2)] = 0
    steepest = change.max(axis=0)
    outermost = len(radius) - 1 - (change >= 0.5 * steepest)[::-1].argmax(axis=0)
    clear = (steepest > 0.5 * np.median(steepest)) & (steepest > 0)
    rays = np.arange(len(angle))
    points = np.stack([column[outermost, rays], row[outermost, rays]], axis=1)
    return points[clear], float(clear.mean())


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
    return np.array([np.median(columns[inside][bright]), np.median(rows[inside][bright])])


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
