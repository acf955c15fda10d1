"""Presentation of a tolerance study: table, verdict, CSV and the two-by-two plot of Figure 2."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlights_core.store import write_whole
from nlights_flows.tolerance.study import (
    PROMISED_DEG,
    PROMISED_MM,
    PROMISED_POSITION_MM,
    WITH,
    WITHOUT,
    Measurement,
    Study,
    largest_within,
    worst,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURES = ("angle", "distance", "added_angle", "added_distance")
UNITS = {"angle": "deg", "distance": "mm", "added_angle": "deg", "added_distance": "mm"}

LEAST = 1e-4
"""Degrees or mm where the plots begin: nothing below matters to anyone."""

Value = Callable[[Measurement], float]

LINES: tuple[tuple[str, str, str, dict[str, str]], ...] = (
    ("", "mean", "mean over all pixels", {"color": "#0b3c8c", "linestyle": "-", "marker": "o"}),
    (
        "",
        "std",
        "standard deviation over all pixels",
        {"color": "#c4391d", "linestyle": "--", "marker": "s", "markerfacecolor": "white"},
    ),
    (
        "added_",
        "greatest",
        "added by the error: greatest of any pixel",
        {"color": "#222222", "linestyle": ":", "marker": "^"},
    ),
    (
        "added_",
        "mean",
        "added by the error: mean",
        {"color": "#777777", "linestyle": "-.", "marker": "x"},
    ),
)
"""Prefix of the figure, which of its numbers, label, style: told apart without colour."""


def write(study: Study, folder: Path) -> list[Path]:
    """Write ``tolerance.csv``, ``tolerance.png`` and ``tolerance.svg``.

    Parameters
    ----------
    study : Study
        What to show.
    folder : Path
        Exists.

    Returns
    -------
    list of Path
        The files.  The same study gives the same bytes.
    """
    table = folder / "tolerance.csv"
    write_whole(table, as_csv(study))
    return [table, *plot(study, folder)]


def as_csv(study: Study) -> str:
    """Every measurement as a row; the column's name ends with its unit."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    numbers = ("mean", "std", "greatest")
    heads = [f"{figure}_{number}_{UNITS[figure]}" for figure in FIGURES for number in numbers]
    unit = {"mm": "mm", "%": "percent"}[study.unit]
    writer.writerow(["recipe", f"error_{unit}", "draw", *heads])
    for one in study.measurements:
        values = [getattr(getattr(one, figure), number) for figure in FIGURES for number in numbers]
        cells = [f"{value:.6g}" for value in (one.error, *values)]
        writer.writerow([one.recipe, cells[0], one.draw + 1, *cells[1:]])
    return stream.getvalue()


def table(study: Study) -> Iterator[str]:
    """Lines of the table for a terminal: a block per recipe, a row per error."""
    draws = f"; the worst of {study.draws} draws" if study.draws > 1 else ""
    yield f"{study.stand}, {study.scene}: {study.what}{draws}"
    three, two = ("mean", "std", "greatest"), ("mean", "greatest")
    for recipe in (WITHOUT, WITH):
        yield ""
        parts = ("normals, degrees", "added", "mesh, mm", "added")
        yield f"{recipe:<20}" + "".join(
            f"{part:>{width}}" for part, width in zip(parts, (27, 18, 27, 18), strict=True)
        )
        yield f"{study.unit:>20}" + "".join(f"{name:>9}" for name in 2 * (*three, *two))
        for one in worst(study, recipe):
            numbers = [getattr(one.angle, name) for name in three]
            numbers += [getattr(one.added_angle, name) for name in two]
            numbers += [getattr(one.distance, name) for name in three]
            numbers += [getattr(one.added_distance, name) for name in two]
            yield f"{one.error:>20.4g}" + "".join(f"{number:>9.4f}" for number in numbers)


def describe_tolerance(study: Study) -> Iterator[str]:
    """Errors up to which the promise of 0.5 degrees and 1 mm is kept, a sentence each."""
    questions: tuple[tuple[str, Value, Value], ...] = (
        ("in the mean", lambda m: m.angle.mean, lambda m: m.distance.mean),
        (
            "added by the error, at every pixel",
            lambda m: m.added_angle.greatest,
            lambda m: m.added_distance.greatest,
        ),
    )
    for recipe in (WITHOUT, WITH):
        for how, angle, distance in questions:
            normals = _limit(study, recipe, angle, PROMISED_DEG)
            mesh = _limit(study, recipe, distance, PROMISED_MM)
            yield (
                f"{recipe}, {how}: {PROMISED_DEG:g} degrees kept {normals}; {PROMISED_MM:g} mm kept {mesh}"
            )


def _limit(study: Study, recipe: str, value: Value, limit: float) -> str:
    summary = worst(study, recipe)
    wrong = summary[1:]
    if not value(summary[0]) <= limit:
        return f"not even by the right lamps ({value(summary[0]):.2f})"
    found = largest_within([m.error for m in wrong], [value(m) for m in wrong], limit)
    if found is None:
        return f"not even at the smallest error ({wrong[0].error:.4g} {study.unit})"
    if np.isinf(found):
        return f"at all errors (up to {wrong[-1].error:.4g} {study.unit})"
    return f"up to {found:.3g} {study.unit}"


def plot(study: Study, folder: Path) -> list[Path]:
    """Draw Figure 2: normals above, mesh below; without flat field on the left, with it on the right.

    Parameters
    ----------
    study : Study
        What to draw.
    folder : Path
        Exists.

    Returns
    -------
    list of Path
        ``tolerance.png`` and ``tolerance.svg``, without date or version.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "nlights", "font.size": 10}):
        figure = Figure((11, 8.4), dpi=130, facecolor="white", layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 2, sharex=True, sharey="row")
        for column, recipe in enumerate((WITHOUT, WITH)):
            _panel(panels[0, column], study, recipe, "angle", PROMISED_DEG)
            _panel(panels[1, column], study, recipe, "distance", PROMISED_MM)
            below = f"{study.what}, {study.unit}".replace(", ", ",\n", 1 if study.draws > 1 else 0)
            panels[1, column].set_xlabel(below)
            panels[0, column].set_title(recipe, fontsize=12, fontweight="bold")
        for row, figure_name in enumerate(("angle", "distance")):
            panels[row, 0].set_ylim(LEAST, 1.6 * _highest(study, figure_name))
        panels[0, 0].set_ylabel("angle between found and true normals, degrees")
        measured = "mesh from its fitted plane" if study.scene == "plane" else "height from the true height"
        panels[1, 0].set_ylabel(f"distance of the {measured}, mm")
        draws = f", worst of {study.draws} draws" if study.draws > 1 else ""
        promise = "; thin lines: what the paper promises" + (
            f" for {PROMISED_POSITION_MM:g} mm" if study.unit == "mm" else ""
        )
        figure.suptitle(f"Stand {study.stand}, scene {study.scene}{draws}{promise}", fontsize=12)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
        paths = [folder / "tolerance.png", folder / "tolerance.svg"]
        figure.savefig(paths[0], metadata={"Software": None})
        figure.savefig(paths[1], metadata={"Date": None, "Creator": None})
    return paths


def _highest(study: Study, figure: str) -> float:
    """The largest number that the two plots of a figure show; 1 at least, for the promise."""
    summary = [one for recipe in (WITHOUT, WITH) for one in worst(study, recipe)]
    return max(1.0, *(float(getattr(getattr(m, p + figure), n)) for m in summary for p, n, _, _ in LINES))


def _panel(axes: Axes, study: Study, recipe: str, figure: str, promised: float) -> None:
    """One of the four plots, with the paper's promise as thin lines."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    summary = worst(study, recipe)[1:]
    errors = [one.error for one in summary]
    axes.set(xscale="log", yscale="log")
    for prefix, number, label, style in LINES:
        values = [getattr(getattr(one, prefix + figure), number) for one in summary]
        axes.plot(errors, values, label=label, linewidth=1.6, markersize=5.5, **style)  # type: ignore[arg-type]
    axes.axhline(promised, color="black", linewidth=1.0)
    if study.unit == "mm":
        axes.axvline(PROMISED_POSITION_MM, color="black", linewidth=1.0)
    if recipe == WITH:  # beside the right-hand panel, where no curve runs
        name = f"{promised:g} {'degree' if UNITS[figure] == 'deg' else 'mm'}"
        axes.annotate(
            name,
            (1, promised),
            (5, 0),
            xycoords=axes.get_yaxis_transform(),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
    if len(errors) == 1:
        axes.set_xlim(errors[0] / 4, errors[0] * 4)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    for one in (axes.xaxis, axes.yaxis):
        one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(which="major", color="#d5d5d5", linewidth=0.7)
    axes.set_axisbelow(True)
