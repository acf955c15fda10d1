"""Numbers of how the photographs of a tile agree with the model, and what to do where they do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nlights_core.report.figures import Number
from nlights_core.solving.agreement import Agreement

MOST_SURPRISE = 3.0
"""Times the noise by which the typical pixel may differ from the model without a warning.  Sound captures of matt
surfaces reach 1.0, of varnished ones 1.5, since the gloss of a lamp meets few pixels."""

MOST_MISSED = 0.2
"""Share of the albedo by which the typical pixel of a photograph may be off what the other lamps predict, without a
warning.  Sound captures reach 0.02, varnished or not; objects under lamps that a chrome sphere told 0.1."""


def of_agreement(found: Agreement, lamps: Sequence[str], refined: bool = False) -> list[Number]:
    """Numbers of how the photographs agree with the model: residuals against the noise, lamps held out.

    Parameters
    ----------
    found : Agreement
        What was found.
    lamps : sequence of str
        Their names, in its order.
    refined : bool
        Whether the lamps' strengths were fitted to the photographs already.

    Returns
    -------
    list of Number
        With warnings where the photographs do not fit the model.
    """
    known = [(value, lamp) for value, lamp in zip(found.held_out, lamps, strict=True) if value is not None]
    mean = 100 * float(np.sqrt(np.mean([value**2 for value, _ in known]))) if known else None
    worst, lamp = max(known, default=(None, ""))
    return [
        Number(
            "Agreement",
            "Residual in units of the noise, median",
            found.surprise,
            "",
            "1: the typical pixel differs from the model by the photographs' noise and nothing else. Well "
            "above: gloss, wrong lamp positions, or something moved.",
            warning=_surprised(found.surprise, refined),
            code="misfit",
        ),
        Number(
            "Agreement",
            "Held-out lamp, rms",
            mean,
            "% of albedo",
            "How far each photograph is from the one that the other lamps predict: the model's error where "
            "nothing was fitted to.",
        ),
        Number(
            "Agreement",
            f"Held-out lamp, worst ({lamp})" if lamp else "Held-out lamp, worst",
            None if worst is None else 100 * worst,
            "% of albedo",
            "The lamp that the others predict worst: look at its photograph, its flat and its position first.",
            warning=_missed(found.typical, lamps, refined),
            code="held-out",
        ),
    ]


def _surprised(surprise: float | None, refined: bool) -> str:
    """Sentence about residuals that are no noise; empty where they may be."""
    if surprise is None or surprise <= MOST_SURPRISE:
        return ""
    return (
        f"The typical pixel differs from the model by {surprise:.3g} times the photographs' noise "
        f"(up to {MOST_SURPRISE:g} is usual): the lamps or the surface are not as the recipe takes them. "
        f"{_remedy(refined)}; gloss all over the surface and a tone curve in the files do it too."
    )


def _missed(typical: Sequence[float | None], lamps: Sequence[str], refined: bool) -> str:
    """Sentence about photographs that the other lamps do not predict; empty where all are predicted."""
    found = [(lamp, value) for lamp, value in zip(lamps, typical, strict=False) if value is not None]
    bad = [lamp for lamp, value in found if value > MOST_MISSED]
    if not bad:
        return ""
    most = 100 * max(value for _, value in found)
    named = ", ".join(bad[:5]) + (f" and {len(bad) - 5} more" if len(bad) > 5 else "")
    return (
        f"The other lamps do not predict what is photographed under {named}: the typical pixel is off by up to "
        f"{most:.0f} % of the albedo (up to {100 * MOST_MISSED:.0f} is usual). See whether each photograph belongs "
        f"to its lamp and was taken like the others. {_remedy(refined)}."
    )


def _remedy(refined: bool) -> str:
    """Remedy where the photographs do not fit the lamps."""
    return (
        "Try another light_model"
        if refined
        else "Try refine: true in the light_model, or another light_model"
    )
