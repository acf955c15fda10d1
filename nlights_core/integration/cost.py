"""Cost of an integration: said before it starts, and bounded."""

from __future__ import annotations

from nlights_core.capture_warnings import CaptureWarning, warn
from nlights_core.machine.band_threads import cores
from nlights_core.machine.progress import note
from nlights_core.memory import GIB, require

DIRECT, CYCLE = 0.05, 0.055
"""Seconds of one core for a million pixels: a solution of the whole rectangle, a multigrid iteration.

Measured on one machine with fields of 22 megapixels; others differ by a factor.
"""

SHARED = 2 / 3
"""Share of the work that all cores do together."""

WORTH_SAYING = 10.0
"""Shorter work is not announced, seconds."""


def expected_seconds(pixels: int, solutions: float, iterations: float) -> float:
    """Time that so many solutions of the rectangle and multigrid iterations take on this machine, seconds."""
    alone = (DIRECT * solutions + CYCLE * iterations) * pixels / 1e6
    return alone * (1 - SHARED + SHARED / cores())


def announce(what: str, pixels: int, bytes_per_pixel: int, solutions: float, iterations: float) -> None:
    """Refuse an integration for which there is not the memory; else say what it may cost, if that is long.

    Parameters
    ----------
    what : str
        What sort of field it is, after "integrator: ".
    pixels : int
        Of the field.
    bytes_per_pixel : int
        Working memory that it takes at the most.
    solutions, iterations : float
        Solutions of the whole rectangle and multigrid iterations after which it ends in any case.

    Raises
    ------
    TileError
        When there is not the memory for it.
    """
    require(bytes_per_pixel * pixels, f"integrator: {what}")
    seconds = expected_seconds(pixels, solutions, iterations)
    if seconds >= WORTH_SAYING:
        memory = bytes_per_pixel * pixels / GIB
        note(
            f"integrator: {what}, {pixels / 1e6:.3g} megapixels: at most about {_time(seconds)} "
            f"and {memory:.1f} GiB"
        )


def warn_unsettled(left: float, tolerance: float, iterations: int) -> None:
    """Warn that the iterations ran out before the height had settled.

    Parameters
    ----------
    left, tolerance : float
        Share of the residual that is left, and that was meant to be.
    iterations : int
        How many were made.
    """
    warn(
        CaptureWarning(
            code="height-unsettled",
            sentence=f"the height had not settled after {iterations} iterations: {left:.1g} of what the "
            f"normals ask for is left, {tolerance:.1g} was meant to be; mask what is not the artwork, such as "
            "table and black background, and look for waves in the height before it is measured",
            value=left,
        )
    )


def _time(seconds: float) -> str:
    return f"{seconds:.0f} seconds" if seconds < 90 else f"{seconds / 60:.0f} minutes"
