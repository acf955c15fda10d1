"""One number of a report, and how a person writes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NOT_MEASURED = "not measured"
NOT_IN_RECIPE = "not in this recipe"

CHECKED_ON = (
    "Checked on simulated matt artworks (S), on no real stand (R) yet; on glossy objects of public data (P) the "
    "errors are larger than this says."
)
"""Where it was seen whether the stated uncertainty of the normals is right."""

FINEST = {
    "°": 0.01,
    "%": 0.01,
    "% of pixels": 0.01,
    "% of albedo": 0.01,
    "mm": 0.001,
    "µm": 0.01,
    "px": 0.001,
}
"""By unit, the smallest step that a person should read; smaller digits are arithmetic, not measurement."""


@dataclass(frozen=True)
class Number:
    """One measured quantity.

    Parameters
    ----------
    group : str
        Heading under which it is listed.
    name : str
        What it is.
    value : float or None
        None: there is none.  That is never a pass.
    unit : str
        Unit of the value.
    meaning : str
        What it tells, in one plain sentence.
    missing : str
        What is to be said where there is no value: `NOT_MEASURED`, or `NOT_IN_RECIPE` where no step
        of the recipe could have given one.
    warning : str
        What is wrong with it and what to do, in a sentence; empty where nothing is.
    code : str
        Kind of that fault, for programs; see `nlights_core.capture_warnings.CaptureWarning`.
    """

    group: str
    name: str
    value: float | None
    unit: str
    meaning: str
    missing: str = NOT_MEASURED
    warning: str = ""
    code: str = ""


def figure_of(value: float | None, unit: str = "") -> str:
    r"""A value with three significant digits, as a person writes it, and none finer than `FINEST`.

    Examples
    --------
    >>> [figure_of(v) for v in (None, 0.0, 98.123, 0.01234, 11656.0)]
    ['not measured', '0', '98.1', '0.0123', '11\u202f656']
    >>> [figure_of(v, "°") for v in (0.00042, 0.01234, 1.2345)]
    ['< 0.01', '0.01', '1.23']

    Not quite all is not all:

    >>> [figure_of(v, "% of pixels") for v in (99.997, 100.0)]
    ['> 99.9', '100']
    """
    if value is None or not np.isfinite(value):
        return NOT_MEASURED
    if value == 0:
        return "0"
    finest, size = FINEST.get(unit, 0.0), abs(value)
    decimals = max(0, 2 - int(np.floor(np.log10(size))))
    if size < finest:
        text = f"< {finest:g}" if value > 0 else f"> -{finest:g}"
    elif unit == "% of pixels" and 99.95 <= value < 100:
        text = "> 99.9"
    elif size >= 1000:
        text = f"{value:,.0f}".replace(",", "\u202f")
    elif size < 1e-4:
        digits, power = f"{value:.1e}".split("e")
        text = f"{digits} \N{MULTIPLICATION SIGN} 10^{int(power)}"
    else:
        text = f"{value:.{min(decimals, round(-np.log10(finest))) if finest else decimals}f}"
    return text.replace("-", "\N{MINUS SIGN}")
