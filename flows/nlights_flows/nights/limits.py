"""Limits of the quality numbers: ``configs/limits.yaml``, or a file of the house's own."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from nlights_core.configurations import Source, list_faults, shipped
from nlights_core.errors import CaptureError
from nlights_core.frames import PixelGrid
from nlights_core.report import quality
from nlights_core.report.agreement_quality import of_agreement
from nlights_core.report.alignment_quality import of_shifts
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.report.figures import NOT_IN_RECIPE
from nlights_core.report.flat_quality import of_flat_levels
from nlights_core.solving.agreement import Agreement
from nlights_core.stands import Record

Verdict = Literal["ok", "warn", "fail"]

VERDICTS: tuple[Verdict, ...] = ("ok", "warn", "fail")
"""From good to bad."""


class Limit(Record):
    """Limit of one quality number; too large or, where ``fail`` is below ``warn``, too small."""

    name: str = Field(description="of the number, as the report has it; of numbers per lamp without the lamp")
    unit: str = Field(description="of the number; both limits are in it")
    warn: float = Field(description="beyond it the page warns")
    fail: float | None = Field(default=None, description="beyond it the number has failed")
    source: str = Field(min_length=1, description="where the limits come from")
    at_least: bool | None = Field(
        default=None, description="whether the number must not be too small, where `fail` does not tell"
    )

    @model_validator(mode="after")
    def _has_a_direction(self) -> Limit:
        if self.fail is not None and self.at_least is not None:
            raise ValueError("at_least is told by fail and warn; remove it")
        if self.fail == self.warn:
            raise ValueError(f"fail and warn are both {self.warn:g}; make them differ, or leave fail out")
        return self

    @property
    def smallest(self) -> bool:
        """Test whether the number must not be too small."""
        return bool(self.at_least) if self.fail is None else self.fail < self.warn

    def covers(self, name: str) -> bool:
        """Test whether a number of a tile is meant: the name alone, or with a lamp's."""
        return name == self.name or name.startswith((f"{self.name}, ", f"{self.name} ("))

    def verdict(self, value: float) -> Verdict:
        """Verdict of a value."""
        sign = -1 if self.smallest else 1
        if self.fail is not None and sign * value > sign * self.fail:
            return "fail"
        return "warn" if sign * value > sign * self.warn else "ok"


class Limits(Record):
    """A table of limits."""

    limits: list[Limit]

    def judged(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """The quality numbers that have a limit, with it and their verdict.

        Parameters
        ----------
        rows : sequence of mapping
            Of ``quality.json``.

        Returns
        -------
        list of dict
            "limit" (its name), "name", "value", "unit", "warn", "fail", "smallest" and "verdict" (None where the
            number was not measured), in the order of the limits.
        """
        return [
            {
                "limit": limit.name,
                "name": row["name"],
                "value": row["value"],
                "unit": row["unit"],
                "warn": limit.warn,
                "fail": limit.fail,
                "smallest": limit.smallest,
                "verdict": None if row["value"] is None else limit.verdict(row["value"]),
            }
            for limit in self.limits
            for row in rows
            if limit.covers(row["name"]) and row["unit"] == limit.unit  # a tile without a scale is in pixels
        ]


def known_numbers() -> dict[str, str]:
    """Names and units of all quality numbers that the report can make; of those per lamp without the lamp."""
    numbers = [
        *quality.measure({}, PixelGrid(1, 1, 1.0)),
        *of_agreement(Agreement(None, ()), ()),
        *quality.of_positions(None, None),
        *quality.of_flat(None, None, NOT_IN_RECIPE),
        *of_flat_levels(None, None, None, (), NOT_IN_RECIPE),
        *of_calibration(None, None),
        *of_shifts(None),
    ]
    # The number of lamps stands in this one's name, so that no limit can mean it.
    return {n.name: n.unit for n in numbers if not n.name.startswith("Pixels with all")}


def load_limits(what: str = "default") -> Limits:
    """Load limits.

    Parameters
    ----------
    what : str
        ``default`` for the shipped ones, or a path.

    Raises
    ------
    CaptureError
        Every fault of the file, with line, field, what was found and what is allowed.
    """
    path = shipped("limits.yaml") if what == "default" else Path(what)
    if what != "default" and not path.is_file():
        raise CaptureError(f"--limits: {path}: there is no such file; give a path, or 'default'")
    source = Source(path, CaptureError)
    table = source.check(Limits)
    known, faults = known_numbers(), []
    names = [limit.name for limit in table.limits]
    for i, limit in enumerate(table.limits):
        if limit.name not in known:
            near = difflib.get_close_matches(limit.name, known, 1)
            meant = f"; did you mean '{near[0]}'?" if near else ""
            listed = "; ".join(known)
            faults.append(
                source.fault(
                    ("limits", i, "name"),
                    f"no quality number is called '{limit.name}'{meant}\n    there are: {listed}",
                )
            )
        elif limit.unit != known[limit.name]:
            right = known[limit.name] or "nothing"
            faults.append(
                source.fault(
                    ("limits", i, "unit"), f"'{limit.name}' is in {right}; got {limit.unit or 'nothing'}"
                )
            )
        if limit.name in names[:i]:
            faults.append(source.fault(("limits", i, "name"), f"'{limit.name}' stands twice; remove one"))
    if faults:
        raise CaptureError(list_faults(faults))
    return table
