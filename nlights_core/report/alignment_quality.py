"""Numbers of how far the photographs of a tile lie from each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nlights_core.report.figures import Number

if TYPE_CHECKING:
    from nlights_core.movement.shifts import Shifts


def of_shifts(shifts: Shifts | None) -> list[Number]:
    """Numbers of an alignment; None: to list them only."""
    taken = None
    if shifts and shifts.found is not None:
        taken = max((one.right**2 + one.down**2) ** 0.5 for one in shifts.shifts.values())
    return [
        Number(
            "Agreement",
            "Largest shift of a photograph, taken out",
            taken,
            "px",
            "Against the photographs that lie on each other, or else the mean of all; 0: none was certain, and "
            "nothing was moved.",
        ),
        Number(
            "Agreement",
            "Uncertainty of the shifts",
            shifts.error if shifts else None,
            "px",
            "By how much parts of the field and details of two sizes differ on them; gloss makes it large. Not "
            "measured where there is too little detail.",
        ),
    ]
