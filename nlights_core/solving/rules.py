"""Rules: to which of its usable samples a kernel fits a pixel, as the bundled normal solvers say."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

Kernel = Literal["least-squares", "robust", "progressive", "rank-trim", "median-of-triplets"]
"""Whose work a kernel does."""


class Rule(NamedTuple):
    """To which of its usable samples a pixel is fitted.

    Attributes
    ----------
    way : int
        Place of the `Kernel` among all.
    condition : float
        Option of `nlights_core.solving.least_squares.UsableLights`.
    keep : int
        Option of ``progressive``: how many samples are left in the end.
    darkest, brightest : float
        Options of ``rank-trim``: shares that are dropped.
    most : int
        Option of ``median-of-triplets``: how many triplets are solved at most.
    """

    way: int
    condition: float
    keep: int = 0
    darkest: float = 0.0
    brightest: float = 0.0
    most: int = 0


def rule(kernel: Kernel, condition: float, **options: Any) -> Rule:
    """The rule of a kernel with the options of its solver, of which there may be more."""
    known = {name: value for name, value in options.items() if name in Rule._fields}
    return Rule(get_args(Kernel).index(kernel), condition, **known)
