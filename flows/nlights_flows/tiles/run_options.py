"""Options of a run: one frozen record, handed on whole wherever tiles are run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

from nlights_core.errors import CaptureError
from nlights_core.files.tiffs import Compression
from nlights_core.memory import allowed, parse_size
from nlights_core.store import Store

RUNNERS = ("here", "dask")
"""Where tiles can be run."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of how tiles are run; the command line, the flows and Python have the same names and defaults.

    Attributes
    ----------
    recipe : str
        Name of a shipped recipe, or a path.
    out : Path
        Folder of the products.
    store : Path or None
        Folder of the artefacts; ``<out>/.store`` by default.
    stand : str or None
        Name or path of a stand, instead of the manifest's.
    root : Path or None
        Capture root; the manifest's folder by default.
    tiles : tuple of str
        Only the tiles of these names; all by default.
    compression : {"none", "zstd"}
        Of the TIFFs among the products.
    copies : bool
        Whether products are copies of the files in the store, instead of sharing their place on the disk.
    memory : str or None
        Memory that a tile may take, as ``6GiB``.
    timeout : float or None
        Seconds that a stage may take; then it is stopped, and its tile has failed.
    runner : {"here", "dask"}
        Where tiles run: in this process, or on the workers of a Dask cluster.
    address : str or None
        Of the Dask scheduler, as ``tcp://10.0.0.5:8786``; without one, workers are started on this machine.
    """

    recipe: str = "default"
    out: Path = Path("products")
    store: Path | None = None
    stand: str | None = None
    root: Path | None = None
    tiles: tuple[str, ...] = ()
    compression: Compression = "none"
    copies: bool = False
    memory: str | None = None
    timeout: float | None = None
    runner: str = "here"
    address: str | None = None

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> RunOptions:
        """Make the record of plain values, as commands, flows and JSON have them; others are left out.

        Examples
        --------
        >>> RunOptions.of({"out": "products", "tiles": ["r0c0"], "inbox": "/inbox"}).tiles
        ('r0c0',)
        """
        names = {field.name for field in fields(cls)}
        known = {name: value for name, value in given.items() if name in names}
        for name in ("out", "store", "root"):
            if known.get(name) is not None:
                known[name] = Path(known[name])
        return cls(**{**known, "tiles": tuple(known.get("tiles") or ())})

    def plain(self, *but: str) -> dict[str, Any]:
        """The record as JSON has it, ``but`` for some: what `of` understands, and parameters of the flows."""
        values = asdict(self) | {"tiles": list(self.tiles) or None, "compression": str(self.compression)}
        for name in ("out", "store", "root"):
            values[name] = None if values[name] is None else str(values[name])
        return {name: value for name, value in values.items() if name not in but}

    @property
    def artefacts(self) -> Store:
        """The store of the artefacts."""
        return Store(self.store or self.out / ".store")

    def check(self) -> None:
        """See that every option is among what is allowed.

        Raises
        ------
        CaptureError
            Naming the option, what was found and what is allowed.
        """
        if self.runner not in RUNNERS:
            raise CaptureError(
                f"--runner: there is no runner '{self.runner}'; choose one of {', '.join(RUNNERS)}"
            )
        if self.address and self.runner == "here":
            raise CaptureError("--address: is where another runner is; leave it out with --runner here")
        if self.compression not in get_args(Compression):
            raise CaptureError(
                f"--compression: '{self.compression}'; choose one of {', '.join(get_args(Compression))}"
            )
        if self.timeout is not None and not self.timeout >= 0:
            raise CaptureError(f"--timeout: should be a number of seconds, 0 or more; got {self.timeout}")
        self.memory_bytes()

    def memory_bytes(self) -> int | None:
        """Memory that a tile may take, bytes; None where nothing was said.

        Raises
        ------
        CaptureError
            When it is no size.
        """
        try:
            return None if self.memory is None else parse_size(self.memory)
        except ValueError as fault:
            raise CaptureError(f"--memory: {fault}") from None

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Check the options, and keep to the memory that they allow while the block lasts."""
        self.check()
        with allowed(self.memory_bytes()):
            yield
