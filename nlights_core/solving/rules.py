"""Rules: to which of its usable samples a kernel fits a pixel, as the bundled normal solvers say."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

Kernel = Literal["least-squares", "robust", "progressive", "rank-trim", "median-of-triplets"]
"""Whose work a kernel does."""


class Limits(NamedTuple):
    """Numbers by which a kernel chooses among the usable samples of a pixel.

    Attributes
    ----------
    condition : float
        Option of `nlights_core.solving.least_squares.UsableLights`.
    keep : int
        Option of ``progressive``: how many samples are left in the end.
    darkest, brightest : float
        Options of ``rank-trim``: shares that are dropped.
    most : int
        Option of ``median-of-triplets``: how many triplets are solved at most.
    """

    condition: float
    keep: int = 0
    darkest: float = 0.0
    brightest: float = 0.0
    most: int = 0


class Rule(NamedTuple):
    """Choice of the usable samples that a pixel is fitted to.

    Attributes
    ----------
    kernel : Kernel
        How.
    limits : Limits
        With which numbers.
    """

    kernel: Kernel
    limits: Limits


def rule(kernel: Kernel, condition: float, **options: Any) -> Rule:
    """Make the rule of a kernel with the options of its solver, of which there may be more."""
    known = {name: value for name, value in options.items() if name in Limits._fields}
    return Rule(kernel, Limits(condition, **known))
