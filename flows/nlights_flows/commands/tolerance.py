"""The command `nlights tolerance`: how wrong the measurement of a stand may be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlights_core.errors import NlightsError


def tolerance(
    stand: Annotated[
        str, typer.Argument(metavar="STAND", help="A shipped stand or a file: it takes the photographs.")
    ],
    axis: Annotated[
        str | None,
        typer.Option(metavar="AXIS", help="x, y, z, -x, -y or -z: all lamps moved alike; z by default."),
    ] = None,
    errors: Annotated[
        str | None,
        typer.Option(metavar="SIZES", help="0.1..100 (10 sizes), 0.1..100:13 or 0.5,1,5; mm."),
    ] = None,
    random: Annotated[
        bool, typer.Option("--random", help="Move every lamp by chance, along all axes, instead.")
    ] = False,
    strength: Annotated[
        str | None,
        typer.Option(metavar="SIZES", help="Change the lamps' strengths instead: 0.01 is 1 %."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(metavar="NAME_OR_FILE", help="Solve with this stand's lamps and camera instead."),
    ] = None,
    draws: Annotated[int, typer.Option(metavar="N", min=1, max=1000, help="How often chance is asked.")] = 10,
    scene: Annotated[
        str, typer.Option(metavar="SCENE", help="plane, drawing, painting or relief.")
    ] = "plane",
    width: Annotated[
        int, typer.Option(metavar="N", min=32, max=4000, help="Width of the photographs, px.")
    ] = 240,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Another seed, other noise and draws.")] = 1,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the plots go.")] = Path(
        "tolerance"
    ),
) -> None:
    """Find out how wrong the measurement of a stand may be: the paper's Figure 2.

    Simulated photographs are solved with lamps that are moved by an error, without and with the
    flat field.  Writes `tolerance.csv`, `tolerance.png` and `tolerance.svg` into DIR, and prints
    up to which error normals keep within 0.5 degrees and the mesh within 1 mm.
    """
    from nlights_core.recipe import load_recipe
    from nlights_core.simulation.scenes import SCENES
    from nlights_core.store import make_writable
    from nlights_flows.tiles import console
    from nlights_flows.tolerance import plots as tolerance_plots
    from nlights_flows.tolerance import stand_errors
    from nlights_flows.tolerance.study import study

    if scene not in SCENES:
        raise NlightsError(f"--scene: there is no scene '{scene}'; choose one of {', '.join(SCENES)}")
    sweep = stand_errors.choose_sweep(stand, axis, errors, random, strength, against, draws, seed)
    make_writable(out, "--out")
    with console.progress_bar("solving with wrong lamps") as progress:
        found = study(
            stand, sweep, load_recipe("default"), scene=scene, width=width, seed=seed, progress=progress
        )
    promise = tolerance_plots.describe_tolerance(found)
    for line in (*tolerance_plots.table(found), "", *promise, "", *found.notes):
        console.say(line)
    for path in tolerance_plots.write(found, out):
        console.say(path)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(tolerance)
