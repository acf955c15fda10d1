"""Numbers of what all pixels of a tile share: level, lamps, gloss, stray light, and how well they fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nlights_core.calibration.record import NOISIER
from nlights_core.frames import Array
from nlights_core.report.figures import NOT_MEASURED, Number

if TYPE_CHECKING:
    from nlights_core.calibration.record import Known

MOST_DRIFT = 2.0
"""Percent by which lamps may have changed since the flats without a warning."""

MOST_MISSED = 0.1
"""Percent of the samples whose ray misses the flat, above which it is told."""

MOST_STRANGE = 1.0
"""Percent of pixels of another material above which it is told."""

LEAST_LIGHT = 0.2
"""Percent of the mean flat above which light that is always there is told."""


def of_calibration(known: Known | None, uncertainty: Array | None) -> list[Number]:
    """Numbers of a calibration.

    Parameters
    ----------
    known : Known or None
        None: to list the numbers only.
    uncertainty : (3, h, w) array or None
        Of height and slope, and the factor of the noise, on coarse blocks.
    """
    return [
        *_level(known, uncertainty),
        *_light(known),
        *_gloss(known),
        *_fit(known),
        _halves(known),
        _noise(known),
    ]


def _level(known: Known | None, uncertainty: Array | None) -> list[Number]:
    measured = known is not None and known.level_uncertainty is not None
    return [
        Number(
            "Level",
            "Mean level",
            known.shared.level if known and measured else None,
            "mm",
            "Mean height above the plane of the flat, found in the photographs: a raised point is lit differently.",
        ),
        Number(
            "Level",
            "Uncertainty of the level",
            known.level_uncertainty if known else None,
            "mm",
            "Standard uncertainty of the number above; not measured where it is above 0.3 mm or the model does not "
            "fit.",
        ),
        Number(
            "Level",
            "Uncertainty of the height",
            _typical(uncertainty),
            "mm",
            "Standard uncertainty of the smooth part of the height after the best constant, typically; "
            "height_uncertainty.tif has it for every pixel, with noise.",
        ),
    ]


def _typical(uncertainty: Array | None) -> float | None:
    """Root mean square of the height's uncertainty; None where it is not known."""
    if uncertainty is None or not np.isfinite(uncertainty[0]).all():
        return None
    return float(np.sqrt(np.mean(uncertainty[0].astype(float) ** 2)))


def _light(known: Known | None) -> list[Number]:
    drift = additive = room = None
    if known and known.residual is not None:
        strengths = known.shared.strengths
        drift = 100 * (float(np.exp(strengths.max())) - float(np.exp(strengths.min())))
        additive, room = 100 * known.shared.additive, 100 * known.shared.room
    return [
        Number(
            "Light",
            "Drift of the lamps since the flats",
            drift,
            "%",
            "Strongest against weakest; it was corrected, and counts as 0 where there is no evidence of it. Above "
            "2 %, photograph the flats again.",
            warning=f"The lamps have changed by {drift:.1f} % since the flats were taken: photograph the flats again."
            if drift is not None and drift > MOST_DRIFT
            else "",
            code="drift",
        ),
        _positions(known),
        Number(
            "Light",
            "Light that the dark frame lacks",
            additive,
            "%",
            "Of the mean flat, in photographs and flats alike; it was taken out, and counts as 0 where there is no "
            "evidence of it.",
            warning=f"Photographs and flats have {additive:.1f} % of light that the dark frame lacks: photograph the "
            "dark frame with the room as it was, the lamps off; the measurement was corrected for it."
            if additive is not None and additive > LEAST_LIGHT
            else "",
            code="additive-light",
        ),
        Number(
            "Light",
            "Light of the room",
            room,
            "%",
            "Of the mean flat, reflected by artwork and flat; as above.",
            warning=f"Artwork and flat reflect {room:.1f} % of light of the room, which the dark frame lacks: darken "
            "the room, and photograph artwork and flats again; the measurement was corrected for it."
            if room is not None and additive is not None and additive <= LEAST_LIGHT < room
            else "",
            code="additive-light",
        ),
    ]


def _positions(known: Known | None) -> Number:
    """Distance of the lamps from where the stand's file has them, as far as the photographs tell.

    Where the model does not fit it is no cause that anybody should look for: photographs that moved look like it too.
    """
    off = known.positions if known else None
    return Number(
        "Light",
        "Lamps' distance from the stand's file, per axis",
        off,
        "mm",
        "Typical, where the photographs are evidence that it is more than the file states; the height's uncertainty "
        "then counts with this instead. Positions are not corrected: measure the stand again.",
        NOT_MEASURED
        if known is None or known.residual is None
        else "no evidence that it is more than stated",
        warning=f"The lamps stand some {off:.1f} mm (per axis) from where the stand's file has them, more than it "
        "states: see that it is the file of this stand, and measure its points of interest again. The uncertainty of "
        "the height counts with this distance."
        if known is not None and off is not None and not known.misfit
        else "",
        code="lamp-positions",
    )


def _gloss(known: Known | None) -> list[Number]:
    gloss = roughness = departure = flat = None
    if known and known.residual is not None:
        shared = known.shared
        gloss = 4 * float(shared.gloss.sum())
        if gloss:
            roughness = float(np.exp(np.average(np.log(shared.roughnesses), weights=shared.gloss)))
        departure = shared.departure
        flat = 4 * float(shared.flat_gloss.sum())
    return [
        Number(
            "Surface",
            "Gloss",
            gloss,
            "%",
            "Reflectance at normal incidence of all highlights together; varnish has 4 %. It was taken out of the "
            "photographs; 0: there is no evidence of any.",
        ),
        Number(
            "Surface",
            "Roughness of the gloss",
            roughness,
            "",
            "Alpha of the highlights, a mean over their parts: 0.1 is a sharp highlight, 0.3 a varnish brushed on, "
            "0.6 satin; not measured where there is no gloss.",
        ),
        Number(
            "Surface",
            "Departure from Lambert's law",
            departure,
            "",
            "Share of the term by which rough matt paint departs; 0.4 is very rough.",
        ),
        Number(
            "Surface",
            "Gloss of the flat",
            flat,
            "%",
            "As for the artwork; it was taken out.",
            warning=f"The flat has highlights of {flat:.1f} %: it is not matt. They were taken out of its "
            "photographs; a matt flat is surer."
            if flat
            else "",
            code="flat-gloss",
        ),
    ]


def _fit(known: Known | None) -> list[Number]:
    residual = strange = missed = None
    if known and known.residual is not None and known.strange is not None:
        residual, strange, missed = 100 * known.residual, 100 * known.strange, 100 * known.unreached
    return [
        Number(
            "Surface",
            "Smooth residual",
            residual,
            "%",
            "What the model misses in patches of the field, as a share of the albedo; sound captures have 0.03 to "
            "0.07.",
            warning=f"The photographs differ from the model by {residual:.2f} % in patches of the field: what the "
            "surface or the light does is not in the model. The uncertainties include it; no level is stated."
            if known and known.misfit
            else "",
            code="model-misfit",
        ),
        Number(
            "Surface",
            "Other material",
            strange,
            "%",
            "Pixels that reflect light unlike most, such as gold: they had no say in these numbers.",
            warning=f"{strange:.0f} % of the pixels reflect light unlike the rest, as gold or a frame does: their "
            "normals, and heights across them, are not measured as the others are; the height's uncertainty says so."
            if strange is not None and strange > MOST_STRANGE
            else "",
            code="other-material",
        ),
        Number(
            "Surface",
            "Rays that miss the flat",
            missed,
            "%",
            "A raised point is lit along a ray that meets the flat's plane beside it; where that is outside the "
            "photographed flat, the sample is left out.",
            warning=f"{missed:.1f} % of the lamps' rays meet the flat's plane outside its photographs, because the "
            "surface lies above it; they were left out. Photograph the flats at the height of the artwork, or a "
            "larger flat."
            if missed is not None and missed > MOST_MISSED
            else "",
            code="flat-reach",
        ),
    ]


def _halves(known: Known | None) -> Number:
    """Difference of the heights by two halves of the lamps."""
    answers = known.answers if known else None
    warning = ""
    if answers is not None and answers.disagree:
        low, high = (", ".join(half) for half in (answers.low, answers.high))
        which = f"the low lamps ({low}) and by the high ones ({high})"
        if not answers.rings:
            which = f"{low} and by {high}"
        warning = (
            f"Heights by {which} differ by {answers.difference:.2f} mm, {answers.limit:.2f} mm are normal: something "
            "in light, surface or stand is not as it is believed to be, and the height may be wrong by a part of it. "
            "Do not rely on the slow bow of this height; see the other warnings for the cause."
        )
    return Number(
        "Agreement",
        "Heights by two halves of the lamps, difference rms",
        answers.difference if answers else None,
        "mm",
        "The height is measured twice, by the low and by the high lamps alone, with all corrections: after the best "
        "constant, and without noise. It is several times the error of the height where something is wrong.",
        warning=warning,
        code="two-rings",
    )


def _noise(known: Known | None) -> Number:
    """Noise of the photographs against that of the flats."""
    times = known.noisier if known else None
    warning = ""
    if times is not None and times > NOISIER:
        number = max(2, round(times))
        warning = (
            f"The photographs of the artwork have {times:.1f} times the variance of noise of the flats, as if each "
            f"flat were the mean of {number} exposures; the photographs' own was used. If the flats are such means, "
            f"write flats_averaged: {number} (of how many exposures) into artwork.yaml; if not, see whether the "
            "camera was set to another ISO, or state sensor."
        )
    elif times is not None and times < 1 / NOISIER:
        warning = (
            f"The flats have {1 / times:.1f} times the variance of noise of the photographs of the artwork, and "
            "theirs was used for both: uncertainties are too large. Photograph flats with the ISO setting of the "
            "artwork; if its photographs are means of several exposures, state in sensor the electrons of one times "
            "their number."
        )
    return Number(
        "Agreement",
        "Noise of the photographs against the flats'",
        times,
        "times the variance",
        "The two should be the same, 1; not measured where sensor or flats_averaged is stated, or with fewer than "
        "five lamps.",
        warning=warning,
        code="flats-averaged",
    )
