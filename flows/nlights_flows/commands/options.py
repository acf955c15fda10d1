"""Options that several commands have, said once."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Compression(StrEnum):
    """Compression of the TIFFs among the products."""

    NONE = "none"
    ZSTD = "zstd"


Artwork = Annotated[
    Path, typer.Argument(metavar="ARTWORK.yaml", help="The capture's manifest, or the folder that holds it.")
]
RecipeOption = Annotated[
    str,
    typer.Option(
        "--recipe",
        metavar="RECIPE",
        help="A shipped recipe (default, no-flats, ...) or a file.",
    ),
]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the products go.")]
StoreOption = Annotated[
    Path | None,
    typer.Option("--store", metavar="DIR", help="Where the artefacts are kept; OUT/.store if not given."),
]
StandOption = Annotated[
    str | None,
    typer.Option("--stand", metavar="NAME_OR_FILE", help="A stand instead of the one the manifest names."),
]
Root = Annotated[
    Path | None,
    typer.Option(
        "--root", metavar="DIR", help="Folder that the manifest's paths may not leave; its own by default."
    ),
]
Tiles = Annotated[
    list[str] | None,
    typer.Option("--tile", metavar="NAME", help="Only this tile; may be given several times."),
]
Prefect = Annotated[
    bool,
    typer.Option(
        "--prefect",
        help="Run as a Prefect flow; implied where a Prefect API is configured (PREFECT_API_URL).",
    ),
]
CompressionOption = Annotated[
    Compression,
    typer.Option("--compression", help="Of the TIFFs: zstd takes less space and more time than the physics."),
]
Copy = Annotated[
    bool,
    typer.Option(
        "--copy",
        help="Copy the products out of the store: they take a second place, and are files of their own.",
    ),
]
Memory = Annotated[
    str | None,
    typer.Option(
        "--memory",
        metavar="SIZE",
        help="Memory that a tile may take, as 6GiB; half of the machine's by default.",
    ),
]
Timeout = Annotated[
    float | None,
    typer.Option(
        "--timeout",
        metavar="SECONDS",
        min=1,
        help="Stop a stage that takes longer; its tile fails, the others go on.",
    ),
]
Runner = Annotated[str, typer.Option("--runner", metavar="NAME", help="Where tiles run: here, or dask.")]
Address = Annotated[
    str | None,
    typer.Option("--address", metavar="ADDRESS", help="Of the Dask scheduler, as tcp://10.0.0.5:8786."),
]
