"""The command line: `nlights`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlights_core import __version__
from nlights_core.errors import NlightsError
from nlights_core.names.control_characters import escape_controls
from nlights_flows.commands import compare as compare_command
from nlights_flows.commands import doctor as doctor_command
from nlights_flows.commands import init as init_command
from nlights_flows.commands import nightly as nightly_command
from nlights_flows.commands import plugins as plugin_commands
from nlights_flows.commands import review as review_command
from nlights_flows.commands import tolerance as tolerance_command
from nlights_flows.commands import upkeep as upkeep_commands
from nlights_flows.commands.interrupts import INTERRUPTED, SENTENCE, disregard, heed
from nlights_flows.commands.options import (
    Address,
    Artwork,
    Compression,
    CompressionOption,
    Copy,
    Memory,
    Out,
    Prefect,
    RecipeOption,
    Root,
    Runner,
    StandOption,
    StoreOption,
    Tiles,
    Timeout,
)
from nlights_flows.tiles.streams import complain, prepare_streams, say, silence

if TYPE_CHECKING:
    from nlights_flows.tiles.run_options import RunOptions
    from nlights_flows.tiles.running import Outcome

UNREAD = 141
"""What a shell calls a command whose reader went away (128 + SIGPIPE)."""


app = typer.Typer(
    name="nlights",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="""Measure paintings and drawings by photometric stereo.

Photographs of an artwork under 8 lamps at measured positions become albedo, normals, height,
reflection map and a mesh, tile by tile.

A first look, without a camera:

`nlights simulate capture --stand horizontal --scene painting --width 1000`

`nlights digitise capture/artwork.yaml --out products`

Then open `products/.../report.html`.  Exit codes: 0 all done; 1 some tiles failed, the others are
done; 2 nothing was produced.
""",
)


def version(show: bool) -> None:
    """Print the version."""
    if show:
        say(f"nlights {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    show: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def simulate(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where the capture goes: a new or empty folder.")
    ],
    stand: Annotated[
        str, typer.Option(metavar="NAME_OR_FILE", help="The stand that takes the photographs.")
    ] = "horizontal",
    scene: Annotated[
        str, typer.Option(metavar="SCENE", help="plane, drawing, painting or relief.")
    ] = "painting",
    width: Annotated[
        int, typer.Option(metavar="N", min=32, max=20000, help="Width of the photographs, px.")
    ] = 1000,
    varnish: Annotated[
        bool, typer.Option("--varnish", help="Varnish the painting: it gets highlights.")
    ] = False,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Another seed, other lamps and noise.")] = 0,
) -> None:
    """Write a simulated capture, and its truth, to try things on.

    Writes `artwork.yaml`, one photograph per lamp, flats, a dark frame, and `truth/` with the
    exact normals.tif, height.tif and albedo.tif.
    """
    from nlights_core.configurations import load_stand
    from nlights_core.simulation.captures import simulate as run
    from nlights_core.simulation.scenes import SCENES
    from nlights_flows.tiles import console

    if scene not in SCENES:
        raise NlightsError(f"--scene: there is no scene '{scene}'; choose one of {', '.join(SCENES)}")
    with console.progress_bar(f"simulating {scene}") as progress:
        run(
            folder,
            load_stand(stand),
            scene=scene,
            width=width,
            varnish=varnish,
            seed=seed,
            progress=lambda done, total: progress(done / total),
        )
    say(f"{folder / 'artwork.yaml'}: {scene}, {width} px wide; the truth is in {folder / 'truth'}")


@app.command()
def check(
    artwork: Artwork,
    recipe: RecipeOption = "default",
    stand: StandOption = None,
    root: Root = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print problems and warnings of every tile as JSON, nothing else.")
    ] = False,
) -> None:
    """Look at a capture before it is digitised: manifest, recipe, every photograph, the lamps.

    Says all that `digitise` would refuse, and warns of what is seldom meant.  Reads every pixel
    once and writes nothing.  Exit codes: 0 all tiles can be digitised; 1 some cannot; 2 none can.
    """
    from nlights_core.manifest import load_capture
    from nlights_core.recipe import load_recipe
    from nlights_flows.tiles import checking, console

    try:
        chosen = load_recipe(recipe)
        tiles = load_capture(artwork, stand=stand, root=root)
    except NlightsError as fault:
        if as_json:
            console.print_findings([checking.of_the_whole(fault)])
        raise
    with console.progress_bar("reading photographs") as progress:
        findings = checking.check_tiles(tiles, chosen, progress)
    if as_json:
        console.print_findings(findings)
    else:
        console.show_findings(findings)
    bad = sum(bool(finding.problems) for finding in findings)
    raise typer.Exit(0 if not bad else 2 if bad == len(findings) else 1)


@app.command()
def plan(
    artwork: Artwork,
    recipe: RecipeOption = "default",
    out: Out = Path("products"),
    store: StoreOption = None,
    stand: StandOption = None,
    root: Root = None,
    tile: Tiles = None,
) -> None:
    """Say what `digitise` would do: which stages exist, which would be made, and why.

    Runs nothing.  A stage is made anew when its algorithm, an option, its code or anything
    before it differs.
    """
    given = {**locals(), "tiles": tile}
    from nlights_flows.tiles import console, planning, preparing
    from nlights_flows.tiles.run_options import RunOptions

    options = RunOptions.of(given)
    chosen, tiles = preparing.prepare_run(artwork, options)
    failed = 0
    for one in tiles:
        try:
            console.show_plan(one, planning.plan(one, chosen, options.artefacts))
        except NlightsError as fault:
            failed += 1
            console.complain(f"{one.name}: {fault}")
    raise typer.Exit(0 if not failed else 2 if failed == len(tiles) else 1)


@app.command()
def digitise(
    artwork: Artwork,
    recipe: RecipeOption = "default",
    out: Out = Path("products"),
    store: StoreOption = None,
    stand: StandOption = None,
    root: Root = None,
    tile: Tiles = None,
    prefect: Prefect = False,
    compression: CompressionOption = Compression.NONE,
    copies: Copy = False,
    memory: Memory = None,
    timeout: Timeout = None,
    runner: Runner = "here",
    address: Address = None,
) -> None:
    """Turn the photographs of an artwork into measured surfaces.

    Writes `OUT/<artwork>/<tile>/`: normals.tif, albedo.tif, reflection.tif, height.tif,
    confidence.tif, mesh.ply, mesh.glb, report.html and more.  What was finished before is not
    done again; a fault of one tile costs that tile only.
    """
    given = {**locals(), "tiles": tile}
    from nlights_flows.tiles import console, direct, environment
    from nlights_flows.tiles.run_options import RunOptions
    from nlights_flows.tiles.running import exit_code

    options = RunOptions.of(given)
    if prefect or environment.api_configured():
        with options.in_force():
            outcomes = _run_flow(artwork, options)
    else:
        outcomes = direct.digitise(artwork, options)
    console.show_outcomes(outcomes)
    raise typer.Exit(exit_code(outcomes))


def _run_flow(artwork: Path, options: RunOptions) -> list[Outcome]:
    """Digitise as a Prefect flow."""
    from nlights_flows.tiles import environment, preparing

    preparing.prepare_run(artwork, options)  # a misspelt recipe need not wait for Prefect
    preparing.make_folders(options)
    with environment.prefect_at_hand():
        from nlights_flows.tiles.digitise import digitise as flow

        state: Any = flow(artwork=str(artwork), **options.plain(), return_state=True)
        outcomes = state.data if isinstance(state.data, list) else state.result(raise_on_failure=False)
        if isinstance(outcomes, BaseException):
            raise outcomes
    return outcomes


@app.command()
def report(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Product folders of tiles, or folders that hold some."),
    ],
) -> None:
    """Print the quality numbers of tiles side by side, with their units.

    Exit codes: 0 all are shown; 1 those of some tiles are damaged and left out; 2 none is shown.
    """
    from nlights_flows.tiles import console

    raise typer.Exit(1 if console.show_numbers(folders) else 0)


@app.command()
def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The product folder of a tile.")],
    truth: Annotated[
        Path, typer.Option("--truth", metavar="DIR", help="A folder with normals.tif and height.tif.")
    ],
) -> None:
    """Compare a tile's products with the truth, where it is known.

    Prints, and writes as `evaluation.json` into DIR: the angles between the normals in degrees,
    the difference of the heights in mm (a free constant removed), the share of both that lies
    within the uncertainty stated for its pixel (coverage; 0.68 is right), and the share that is
    known. What DIR states no uncertainty of is not measured (null).
    """
    import json
    import math

    from nlights_core.simulation.evaluation import evaluate as compare
    from nlights_core.store import write_whole
    from nlights_flows.tiles import console

    result = {name: None if math.isnan(value) else value for name, value in compare(folder, truth).items()}
    console.show_evaluation(result)
    write_whole(folder / "evaluation.json", json.dumps(result, indent=1) + "\n")


init_command.register(app)
compare_command.register(app)
nightly_command.register(app)
review_command.register(app)
plugin_commands.register(app)
tolerance_command.register(app)
upkeep_commands.register(app)
doctor_command.register(app)


def main() -> None:
    """Run the command line; a reader who goes away ends it without a word."""
    try:
        heed()
        prepare_streams()
        code = _run()
        sys.stdout.flush()
    except BrokenPipeError:
        code = _unread()
    except OSError as fault:  # of the flush: the disk is full to which the output goes
        silence(1)
        complain(f"standard output: {fault.strerror or fault}")
        code = 2
    except KeyboardInterrupt:
        code = _stopped()
    except SystemExit as fault:
        # Typer and rich end the process themselves where a pipe is broken, with a 1 that means something else.
        if not isinstance(fault.__context__, BrokenPipeError):
            raise
        code = _unread()
    disregard()
    sys.exit(code)


def _run() -> int:
    """Run the command line; name broken plugins at its end."""
    try:
        return _explained()
    finally:
        _warn_of_plugins()


def _warn_of_plugins() -> None:
    """Name the plugins that were found to be broken, if this command has looked at any."""
    registry = sys.modules.get("nlights_core.registry")
    for plugin in registry.broken_plugins() if registry else ():
        complain(f"warning: a plugin is not used: {plugin.why}")


def _explained() -> int:
    """Explain what is the user's to mend, without a traceback."""
    try:
        code: int = app(standalone_mode=False)
        return _stopped() if code == INTERRUPTED else code  # Typer has swallowed the interrupt
    except (typer.Abort, KeyboardInterrupt):
        return _stopped()
    except NlightsError as fault:
        complain(fault)
        return 2
    except BrokenPipeError:
        raise
    except OSError as fault:
        complain(f"{fault.filename or 'system'}: {fault.strerror or fault}")
        return 2
    except Exception as fault:
        # Typer carries its own copy of click, so its faults are known by what they can do.
        if not hasattr(fault, "show"):
            raise
        if isinstance(said := getattr(fault, "message", None), str):
            fault.message = escape_controls(said)  # type: ignore[attr-defined]
        fault.show()
        return getattr(fault, "exit_code", 2)


def _stopped() -> int:
    complain(SENTENCE)
    return INTERRUPTED


def _unread() -> int:
    """End quietly where whoever read the output has seen enough; Python must not complain while it ends."""
    silence(1, 2)
    return UNREAD
