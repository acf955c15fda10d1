"""The dark frame, which is subtracted from everything: whether light reached it."""

from __future__ import annotations

import numpy as np

from nlights_core.capture import Tile
from nlights_core.capture_warnings import CaptureWarning
from nlights_core.frames import Array
from nlights_core.reduced_light.coarse_light import CELLS, cell_medians
from nlights_core.reduced_light.samples import Samples

PICTURE = 0.003
"""Spread of the dark frame over the field (from its 5 to its 95 % quantile) as a share of the flats' light.
Sensors without light stay below 0.0005; 1 % of one lamp's light gives 0.02."""

LEAST_PICTURE = 0.001
"""The same as a share of saturation, below which it is not told: the glow at the edge of a warm sensor."""

NOISY = 8.0
"""The same over the standard deviation that noise gives the mean of a cell: noise alone spreads by 3.3."""

SIMILAR = 0.8
"""Correlation of the dark frame with one of the photographs above which it shows that picture, though faintly.
Noise, and the glow of a warm sensor, stay below 0.3."""

LEAST_SIMILAR = 0.0002
"""Spread of such a dark frame, as a share of saturation, below which it does no harm."""

BELOW = 0.002
"""How far below the dark frame, as a share of saturation, a photograph must be to count: half a number of 8 bits."""

BELOW_SHARE = 0.01
"""Share of a photograph that may be so dark.  No light is less than none: sound photographs have no such place."""


def find_lit_dark(samples: Samples, tile: Tile) -> list[CaptureWarning]:
    """Look for a dark frame that shows a picture, or is brighter than the photographs anywhere.

    Parameters
    ----------
    samples : Samples
    tile : Tile

    Returns
    -------
    list of CaptureWarning
        Of one at most, without lamps; none where there is no dark frame.
    """
    if samples.dark is None or tile.dark is None:
        return []
    edge = max(1, samples.grid.columns // CELLS)
    light = samples.frames if samples.flats is None else samples.flats
    level = float(np.nanmedian(light)) if np.isfinite(light).any() else 0.0
    dark, noise = _cell_means(samples.dark, edge)
    low, high = np.nanquantile(dark, (0.05, 0.95))
    spread = float(high - low)
    remedy = "photograph it again with the lens covered, with the exposure of the others, or leave dark out"
    shown = spread > max(PICTURE * level, LEAST_PICTURE, NOISY * noise, 1.5 * samples.step)
    shown |= spread > max(LEAST_SIMILAR, samples.step) and _likeness(dark, samples, edge) > SIMILAR
    if shown:
        return [
            CaptureWarning(
                "dark-lit",
                f"{tile.dark.name}: the dark frame shows a picture: its brightness varies by {spread:.2%} of "
                f"saturation over the field, where a covered sensor stays below {LEAST_PICTURE:.1%}; {remedy}",
                (),
                100 * spread,
                "% of saturation",
            )
        ]
    for kind, photographs in (("frames", samples.frames), ("flats", samples.flats)):
        paths = tile.frames if kind == "frames" else tile.flats
        if photographs is None or paths is None:
            continue
        darker = np.array([np.mean(_cell_means(one, edge)[0] < -BELOW) for one in photographs])
        worst = int(np.argmax(darker))
        if darker[worst] > BELOW_SHARE:
            lamp = samples.lamps[worst]
            return [
                CaptureWarning(
                    "dark-lit",
                    f"{tile.dark.name}: the dark frame is brighter than {paths[lamp].name} (lamp {lamp}) on "
                    f"{darker[worst]:.1%} of the field, where no light can be less than none; {remedy}",
                    (),
                    100 * float(darker[worst]),
                    "% of the field",
                )
            ]
    return []


def _cell_means(light: Array, edge: int) -> tuple[Array, float]:
    """Means of the middle half of squares of samples, and their standard deviation by noise.

    No hot pixel reaches them; and a median of 8-bit numbers would be a whole number: 0 here, 1 there.
    """
    rows, columns = light.shape[0] // edge, light.shape[1] // edge
    cut = light[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge)
    order = np.sort(cut.swapaxes(1, 2).reshape(rows, columns, -1).astype(np.float64), axis=-1)
    known = np.count_nonzero(np.isfinite(order), axis=-1)[..., None]
    place = np.arange(order.shape[-1])
    middle = (place >= known // 4) & (place < known - known // 4) & (2 * known >= order.shape[-1])
    count = middle.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(middle, order, 0).sum(axis=-1) / count
    spread = np.std(order, axis=-1)
    spread = spread[np.isfinite(spread)]
    return mean, float(np.median(spread)) / edge if spread.size else 0.0


def _likeness(dark: Array, samples: Samples, edge: int) -> float:
    """Highest correlation of the dark frame's cells with those of any photograph or flat."""
    likeness = 0.0
    for photographs in (samples.frames, samples.flats):
        if photographs is None:
            continue
        for picture in cell_medians(photographs, edge):
            known = np.isfinite(picture)
            if known.mean() > 0.5 and np.std(picture[known]) > 0:
                likeness = max(likeness, float(np.corrcoef(picture[known], dark[known])[0, 1]))
    return likeness
