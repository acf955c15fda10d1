"""The commands `nlights verify` and `nlights clean`: is everything still what was written, and what may go."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlights_flows.commands.options import StoreOption

if TYPE_CHECKING:
    from nlights_flows.upkeep.cleaning import Cleaned
    from nlights_flows.upkeep.verification import Verified


def verify(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Where the products are.")] = Path("products"),
    store: StoreOption = None,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair", help="Restore products from whole artefacts; remove artefacts that are damaged."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was found as JSON.")] = False,
) -> None:
    """Check every product and every artefact against the digests that were written with it.

    Reads all of OUT and of the store; a night may be at work meanwhile.  Names every file that is not what was
    written, and the command that makes again what cannot be restored.

    Exit codes: 0 all is whole, or was mended; 1 something remains; 2 there was nothing to check.
    """
    from nlights_flows.tiles import console
    from nlights_flows.upkeep.verification import verify as look

    with console.progress_bar("verifying") as progress:
        found = look(out, store or out / ".store", repair=repair, progress=progress)
    if as_json:
        print(json.dumps(found.record(), indent=1))
    else:
        _show(found, out)
    raise typer.Exit(found.exit_code())


def _show(found: Verified, out: Path) -> None:
    """Print what became of a verification."""
    from nlights_flows.tiles import console

    if not found.products + found.artefacts:
        console.complain(f"{out}: there are no products here, and no artefacts; name the folder of --out")
        return
    for damage in found.damages:
        for name, fault in damage.files.items():
            became = ": removed" if damage.deleted else ": restored" if name in damage.restored else ""
            console.complain(f"{damage.folder}/{name}: {fault}{became}")
        for name in damage.restored:
            if name not in damage.files:
                console.complain(f"{damage.folder}/{name}: restored")
    damaged = len(found.damages)
    remaining = sum(bool(damage.remaining) for damage in found.damages)
    state = f"{damaged} damaged, {damaged - remaining} of them mended" if damaged else "all whole"
    print(
        f"{found.products} products of tiles, {found.artefacts} artefacts, {found.size / 1e9:.3g} GB: {state}"
    )
    if found.commands:
        print("to make again what is damaged or was removed:")
        for command in found.commands:
            print(f"  {command}")


def clean(
    store: Annotated[Path, typer.Option("--store", metavar="DIR", help="Where the artefacts are kept.")],
    out: Annotated[
        list[Path],
        typer.Option(
            "--out",
            metavar="DIR",
            help="Where products are that were made from this store; given for every such folder.",
        ),
    ],
    older_than: Annotated[
        float,
        typer.Option(
            "--older-than", metavar="DAYS", min=0, help="Only what no run has made or used for so many days."
        ),
    ],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go; remove nothing.")] = False,
) -> None:
    """Remove from a store what no product needs any more, and what killed runs left half-written.

    An artefact stays if it is in the chain that the provenance of any product names.  A night may be at work
    meanwhile, if DAYS is 1 or more: what it makes or uses is younger.
    """
    from nlights_flows.tiles import console
    from nlights_flows.upkeep.cleaning import clean as go

    with console.progress_bar("cleaning") as progress:
        found = go(store, out, older_than, dry=dry_run, progress=progress)
    _tell(found, dry_run)


def _tell(found: Cleaned, dry: bool) -> None:
    """Print what became of a cleaning."""
    from nlights_flows.tiles import console

    for folder in found.unreadable:
        console.complain(
            f"{folder}: does not say what it was made of, so the artefacts of its artwork stay; see `nlights verify`"
        )
    for folder in found.artefacts:
        print(folder)
    would = "would be " if dry else ""
    print(
        f"{len(found.artefacts)} artefacts and {found.drafts} drafts {would}removed, {found.size / 1e9:.3g} GB; "
        f"{found.kept} artefacts stay"
    )


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(verify)
    app.command()(clean)
