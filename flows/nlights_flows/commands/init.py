"""The command `nlights init`: a first ``artwork.yaml`` for a folder of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlights_core.errors import CaptureError

if TYPE_CHECKING:
    from nlights_flows.first_manifests.writing import Written


def init(
    folder: Annotated[
        Path | None, typer.Argument(metavar="FOLDER", help="The folder that holds the photographs.")
    ] = None,
    objects: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="OBJECTS.csv",
            help="A list of folders, with the columns folder, id, title, stand, recipe.",
        ),
    ] = None,
    number: Annotated[
        str, typer.Option("--id", metavar="ID", help="Inventory number; the folder's name if not given.")
    ] = "",
    stand: Annotated[
        str, typer.Option("--stand", metavar="NAME_OR_FILE", help="The stand that took the photographs.")
    ] = "",
) -> None:
    """Write a first `artwork.yaml` for a folder of photographs, never over an existing one.

    Looks at names, sizes and EXIF: photographs of the artwork, flats, dark frame, mask, chrome spheres, lists of
    lights.  Says what it found, what it could not tell, and the command to go on with.

    Exit codes: 0 it can be digitised; 1 something is missing, and it says what; 2 nothing was written.
    """
    from nlights_flows.first_manifests.objects import read_objects, write_manifests
    from nlights_flows.first_manifests.writing import Wanted, write_manifest
    from nlights_flows.tiles import console

    if objects is None:
        if folder is None:
            raise CaptureError(
                "init: give the folder that holds the photographs, or a list of them with --from"
            )
        written = write_manifest(folder, Wanted(id=number, stand=stand))
        _show(written)
        raise typer.Exit(1 if written.missing else 0)
    if number:
        raise CaptureError("--id: is for one folder; with --from give the ids in the column id of the list")
    rows = read_objects(objects, folder, stand)
    complete = incomplete = 0
    for result in write_manifests(objects, rows):
        if isinstance(result, str):
            console.complain(result)
            continue
        console.say(
            f"{result.path}: {f'missing: {result.missing}' if result.missing else result.commands[-1]}"
        )
        complete += not result.missing
        incomplete += bool(result.missing)
    failed = len(rows) - complete - incomplete
    console.say(
        f"{len(rows)} folders: {complete} can be digitised, {incomplete} lack something, {failed} failed"
    )
    raise typer.Exit(0 if complete == len(rows) and rows else 1 if complete + incomplete else 2)


def _show(written: Written) -> None:
    from nlights_flows.tiles import console

    console.say(f"{written.path}: written")
    for sentence in written.found:
        console.say(f"  found: {sentence}")
    for sentence in written.unsure:
        console.say(f"  not told or left out: {sentence}")
    if written.missing:
        console.complain(f"missing: {written.missing}")
    console.say("then go on with:" if written.missing else "go on with:")
    for command in written.commands:
        console.say(f"  {command}")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(init)
