"""Borders of the artwork: where a table, an easel, a chart or a frame begins, from small photographs.

A border is taken for one where a straight step goes along a whole side of a rectangle.  Paint has straight
steps too, such as a horizon: so at least two sides must be found, and what is beyond must either stand
higher or lower (its step is another under each lamp, since one side shades the other) or be much darker than
the artwork is nearly everywhere.  What is told by neither is left to a person.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from nlights_core.frames import Array
from nlights_core.reduced_light.samples import Samples

REACH = 0.42
"""Share of the field, from each edge, within which a border is looked for."""

ASIDE = 3
"""Samples on each side of a step that are compared."""

STEP = 0.15
"""Step in the albedo's logarithm that counts."""

SHADE = 0.3
"""Step in the logarithm of one lamp's light, as a share of all lamps', that counts: paint hardly has any."""

WHOLE = 0.85
"""Share of a side along which a step must go, in one direction."""

TURNED = 0.035
"""Slope to the field's edges up to which a side is looked for: two degrees."""

DARKER = 0.6
"""Share of the artwork's brightness below which what is beyond is dark."""

SIDES = ("left", "right", "top", "bottom")


@dataclass(frozen=True)
class Side:
    """Side of the artwork: a straight line across the field, from edge to edge.

    Attributes
    ----------
    name : str
        Of `SIDES`.
    place : float
        Where it crosses the field's middle line, in samples from this side's edge of the field.
    slope : float
        Samples that it moves inwards per sample along it.
    along : float
        Share of its length along which the step goes.
    relief : bool
        Whether one side of it stands higher.
    """

    name: str
    place: float
    slope: float
    along: float
    relief: bool


@dataclass(frozen=True)
class Border:
    """Border of the artwork.

    Attributes
    ----------
    sides : tuple of Side
        Those that were found; the artwork fills the field towards the others.
    inside : (h, w) bool array
        What is the artwork, a sample or two less along each side.
    albedo : (h, w) float64 array
        Mean of the photographs over their flats, grey: a picture to judge by.
    """

    sides: tuple[Side, ...]
    inside: Array
    albedo: Array

    def sentence(self) -> str:
        """Words for a person: what was found and what to do."""
        where = ", ".join(
            f"{side.name} {'(higher or lower)' if side.relief else '(dark)'}" for side in self.sides
        )
        share = 100 * float(np.mean(~self.inside))
        return (
            f"{share:.0f} % of the field seem to be something other than the artwork, beyond a straight border at "
            f"the {where}: look at the picture in the report, and if that is so state mask: auto, or a mask "
            "of your own"
        )

    def mask(self, rows: int, columns: int, block: int) -> Array:
        """Mask of the photographs, (rows, columns) bool; ``block`` is a sample's edge, px."""
        inside = np.ones((rows, columns), bool)
        for side in self.sides:
            view = _faced(side.name, inside)
            # Samples are counted from the edge of a field of whole samples; the rest lies right and below.
            rest = view.shape[1] - block * _faced(side.name, self.inside).shape[1]
            away = (rest if side.name in ("right", "bottom") else 0) + block * (side.place + 2)
            middle = block * _faced(side.name, self.inside).shape[0] / 2
            along = np.arange(len(view)) - middle
            line = away + side.slope * along
            view &= np.arange(view.shape[1]) >= line[:, None]
        return inside

    def picture(self) -> Array:
        """The small picture of the photographs, what is beyond the border in red, (h, w, 3) uint8."""
        level = np.clip(self.albedo / max(float(np.percentile(self.albedo, 99)), 1e-6), 0, 1) ** (1 / 2.2)
        colours = np.repeat(level[..., None], 3, axis=2)
        beyond = ~self.inside
        colours[beyond] = 0.55 * colours[beyond] + np.array([0.45, 0.0, 0.0])
        return (255 * colours + 0.5).astype(np.uint8)


FILE, PICTURE = "border.json", "border.png"
"""Where it stands what may be no part of the artwork: in words, and as a picture."""


def write_border(folder: Path, border: Border | None) -> None:
    """Write ``border.json`` and ``border.png``; nothing where nothing was found."""
    if border is None:
        return
    from PIL import Image

    told = {"sentence": border.sentence(), "sides": [asdict(side) for side in border.sides]}
    (folder / FILE).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    Image.fromarray(border.picture()).save(folder / PICTURE)


def read_proposal(folder: Path) -> str:
    """The sentence about what may be no part of the artwork, "" where nothing was found."""
    path = folder / FILE
    return str(json.loads(path.read_text(encoding="utf-8"))["sentence"]) if path.is_file() else ""


def find_border(samples: Samples) -> Border | None:
    """Find the straight border of an artwork that does not fill the field.

    Parameters
    ----------
    samples : Samples
        Of the photographs; without flats the light may be uneven, as long as it is smooth.

    Returns
    -------
    Border or None
        None where nothing but the artwork was found.
    """
    light = samples.frames.astype(np.float64)
    if samples.flats is not None:
        light = light / np.where(samples.flats > 0, samples.flats, np.nan)
    else:
        light = light / np.nanmean(light, axis=(1, 2), keepdims=True)
    light = np.where(light > 1e-4, light, 1e-4)  # deep shadow, and what is not known
    albedo = np.median(light, axis=0)
    colours, shares = np.log(albedo), np.log(light / albedo)
    found = [side for name in SIDES if (side := _side(name, colours, shares, None))]
    # Corners are known now: each side must go from corner to corner.
    inside = _within(found, albedo.shape)
    found = [
        again
        for side in found
        if (
            again := _side(side.name, colours, shares, _within([s for s in found if s != side], albedo.shape))
        )
    ]
    inside = _within(found, albedo.shape)
    found = [side for side in found if side.relief or _is_dark(side, albedo, inside)]
    if len(found) < 2:
        return None
    inside = _within(found, albedo.shape)
    return Border(tuple(found), inside, albedo) if inside.mean() > 0.1 else None


def _faced(name: str, maps: Array) -> Array:
    """Maps (..., h, w) turned so that a side lies at the left, and its lines are rows."""
    if name in ("top", "bottom"):
        maps = np.swapaxes(maps, -1, -2)
    return maps[..., ::-1] if name in ("right", "bottom") else maps


def _steps(maps: Array) -> Array:
    """Steps (..., h, w) from the three samples left of each sample to the three right of it, itself left out."""
    padded = np.concatenate([np.zeros((*maps.shape[:-1], 1)), np.cumsum(maps, axis=-1)], axis=-1)
    sums = (padded[..., ASIDE:] - padded[..., :-ASIDE]) / ASIDE
    steps = np.full(maps.shape, np.nan)
    steps[..., ASIDE:-ASIDE] = sums[..., ASIDE + 1 :] - sums[..., : -ASIDE - 1]
    return steps


def _side(name: str, colours: Array, shares: Array, between: Array | None) -> Side | None:
    """Find the side towards one edge of the field: the straight step that goes farthest along it."""
    albedo_steps, lamp_steps = _steps(_faced(name, colours)), _steps(_faced(name, shares))
    length, width = albedo_steps.shape
    rows = np.arange(length)
    lines = (rows >= 0.25 * length) & (rows < 0.75 * length)  # the corners may be anywhere
    if between is not None:
        lines = _faced(name, between).any(axis=1)
    if lines.sum() < 10:
        return None
    places = np.arange(ASIDE, int(REACH * width))
    slopes = np.array(sorted(np.arange(-TURNED, TURNED + 1e-9, 1 / length), key=abs))
    bright, shaded, strength = (np.empty((len(slopes), len(places))) for _ in range(3))
    for i, slope in enumerate(slopes):
        columns = np.rint(places[None, :] + slope * (rows[lines, None] - length / 2)).astype(int)
        here = rows[lines, None], np.clip(columns, ASIDE, width - ASIDE - 1)
        bright[i] = _along(albedo_steps[here], STEP)
        shaded[i] = np.max([_along(lamp[here], SHADE) for lamp in lamp_steps], axis=0)
        strength[i] = np.abs(albedo_steps[here].mean(axis=0)) + np.abs(lamp_steps[:, *here].mean(axis=1)).max(
            axis=0
        )
    # A shadow ends at a line too, but in one photograph only: where the albedo changes is the border.
    material, relief = bright.max(axis=0) >= WHOLE, _near(shaded.max(axis=0) >= 0.6)
    shade = shaded.max(axis=0) >= WHOLE
    if (material & relief).any():
        about = np.flatnonzero(material & relief)[-1]  # of a frame the inner side
    elif (material | shade).any():
        about = np.flatnonzero(material | shade)[0]
    else:
        return None
    score = np.where(np.abs(places - places[about]) <= ASIDE, strength, 0.0)
    score[np.maximum(bright, shaded) < WHOLE] = 0.0
    slope, place = np.unravel_index(int(np.argmax(score)), score.shape)
    share = float(max(bright[slope, place], shaded[slope, place]))
    return Side(name, float(places[place]), float(slopes[slope]), share, bool(relief[place]))


def _near(places: Array) -> Array:
    """Places (n,) that are true, and two to each side."""
    return np.convolve(places, np.ones(5), mode="same") > 0.5


def _along(steps: Array, least: float) -> Array:
    """Share of the lines (h, n) on which a step goes, all in one direction, (n,)."""
    return np.asarray(np.maximum((steps > least).mean(axis=0), (steps < -least).mean(axis=0)))


def _within(sides: list[Side], shape: tuple[int, int]) -> Array:
    """Samples inside all of the sides, a sample or two less along each, (h, w) bool."""
    inside = np.ones(shape, bool)
    for side in sides:
        view = _faced(side.name, inside)
        length, width = view.shape
        line = side.place + side.slope * (np.arange(length) - length / 2)
        view &= np.arange(width) > line[:, None] + 1
    return inside


def _is_dark(side: Side, albedo: Array, inside: Array) -> bool:
    """Test whether nearly all beyond a side is much darker than nearly all of the artwork."""
    beyond = ~_within([side], albedo.shape)
    artwork = albedo[inside]
    if not artwork.size:
        return False
    return bool(np.percentile(albedo[beyond], 90) < DARKER * np.percentile(artwork, 25))
