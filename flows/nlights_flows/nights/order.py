"""Order of a night, checked before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.errors import CaptureError
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.store import Store
from nlights_flows.nights.estimates import Deadline
from nlights_flows.nights.limits import Limits, load_limits
from nlights_flows.nights.notifying import Hook, read_hook
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import Around


@dataclass(frozen=True)
class Order:
    """Order of a night; docs/nights.md explains every field.

    Attributes
    ----------
    inbox : Path
    options : RunOptions
        How tiles are run; its capture root is the inbox.
    until : str or None
        Time of the day, HH:MM.
    limits : str
    settle : float
        Seconds.
    notify : str or None
        Address of a web hook that is told at the end; secret.
    """

    inbox: Path
    options: RunOptions
    until: str | None = None
    limits: str = "default"
    settle: float = 300.0
    notify: str | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Checked:
    """An order whose recipe, limits, time and web hook were read."""

    order: Order
    recipe: Recipe
    limits: Limits
    deadline: Deadline
    hook: Hook | None = None

    @property
    def options(self) -> RunOptions:
        """Options of how its tiles are run."""
        return self.order.options

    @property
    def store(self) -> Store:
        """Folder of its artefacts."""
        return self.options.artefacts


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


def check_order(order: Order) -> Checked:
    """Read recipe, limits, time and web hook.

    Raises
    ------
    NlightsError
        Naming the option, what was found and what is allowed.
    """
    order.options.check()
    if not order.settle >= 0:
        raise CaptureError(f"--settle: should be a number of seconds, 0 or more; got {order.settle}")
    return Checked(
        replace(order, options=replace(order.options, root=order.inbox)),
        load_recipe(order.options.recipe),
        load_limits(order.limits),
        Deadline.of(order.until),
        read_hook(order.notify) if order.notify else None,
    )
