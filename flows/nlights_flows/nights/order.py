"""What a night is asked for, checked before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.files.tiffs import Compression
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.store import Store
from nlights_flows.nights.estimates import Deadline
from nlights_flows.nights.limits import Limits, load_limits
from nlights_flows.tiles import dask_runner
from nlights_flows.tiles.preparing import allow_memory
from nlights_flows.tiles.running import Around

COMPRESSIONS = ("none", "zstd")


@dataclass(frozen=True)
class Order:
    """What a night is asked for; docs/nights.md explains every field.

    Attributes
    ----------
    inbox, out : Path
    recipe : str
    store : Path or None
    until : str or None
        Time of the day, HH:MM.
    limits : str
    settle : float
        Seconds.
    compression : str
    timeout : float or None
        Seconds of a stage.
    memory : str or None
    runner, address : str
    """

    inbox: Path
    out: Path
    recipe: str = "default"
    store: Path | None = None
    until: str | None = None
    limits: str = "default"
    settle: float = 300.0
    compression: Compression = "none"
    timeout: float | None = None
    memory: str | None = None
    runner: str = "here"
    address: str | None = None


@dataclass(frozen=True)
class Checked:
    """An order whose recipe, limits and time were read."""

    order: Order
    recipe: Recipe
    limits: Limits
    deadline: Deadline
    store: Store


@dataclass(frozen=True)
class Batch:
    """Tiles of one artwork that shall be run now.

    Attributes
    ----------
    artwork : str
    manifest : Path
    tiles : sequence of Tile
        Those that are to be run; the manifest may have more.
    night : Checked
    """

    artwork: str
    manifest: Path
    tiles: Sequence[Tile]
    night: Checked


RunArtwork = Callable[[Batch, Around], object]
"""How to run an artwork's tiles: here, as a subflow, on other machines.

Each tile must be run through ``around(tile, run)``, which may decline it (the time, a claim) and
takes down what became of it; it may be called from several threads.  What is returned is not looked at.
"""


def checked(order: Order) -> Checked:
    """Read recipe, limits and time; set the memory budget.

    Raises
    ------
    NlightsError
        Naming the option, what was found and what is allowed.
    """
    dask_runner.checked(order.runner, order.address)
    if order.compression not in COMPRESSIONS:
        raise CaptureError(f"--compression: '{order.compression}'; choose one of {', '.join(COMPRESSIONS)}")
    for option, value in (("--settle", order.settle), ("--timeout", order.timeout)):
        if value is not None and not value >= 0:
            raise CaptureError(f"{option}: should be a number of seconds, 0 or more; got {value}")
    allow_memory(order.memory)
    return Checked(
        order,
        load_recipe(order.recipe),
        load_limits(order.limits),
        Deadline.of(order.until),
        Store(order.store or order.out / ".store"),
    )
