"""Decoding: what every format's decoder is, and how its faults are told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlights_core.errors import TileError
from nlights_core.frames import Array


@dataclass(frozen=True)
class Decoder:
    """An open photograph file.

    Parameters
    ----------
    rows, columns, channels : int
        Size of the image; channels are 1 or 3, without alpha.
    dtype : numpy.dtype
        uint8, uint16, uint32 or float32 (to which other floats are converted), native order.
    icc : bytes or None
        The embedded ICC profile.
    step : int
        Rows that can only be decoded together: a row of compressed strips or tiles, or the whole
        image.  1: any rows can be had alone.
    decode : callable
        ``decode(start, stop)`` gives rows as (stop - start, columns, channels) numbers, in any
        byte order; ``start`` is a multiple of ``step``, ``stop`` too or the end of the image.
    close : callable
        Closes the file.
    fill : callable or None
        ``fill(start, stop, out)`` reads rows right into a contiguous array (stop - start, columns,
        channels) of ``dtype``, where the file holds them so.
    pages : tuple of str
        Of a TIFF with several full pages, what each is; the one that is read first.
    """

    rows: int
    columns: int
    channels: int
    dtype: np.dtype[np.generic]
    icc: bytes | None
    step: int
    decode: Callable[[int, int], Array]
    close: Callable[[], None] = lambda: None
    fill: Callable[[int, int, Array], None] | None = None
    pages: tuple[str, ...] = ()


@contextmanager
def explain_damage(path: Path) -> Iterator[None]:
    """Turn whatever a decoder raises about a damaged file into one sentence.

    Raises
    ------
    TileError
        Names the file and what its decoder said.  Failures of the system (`OSError` with a
        number: disk, network) and of memory pass unchanged, for a retry may mend them.
    """
    try:
        yield
    except (TileError, MemoryError):
        raise
    except Exception as fault:
        if isinstance(fault, OSError) and fault.errno is not None:
            raise
        found = str(fault) or type(fault).__name__
        raise TileError(
            f"{path}: damaged or incomplete, its decoder says '{found}'; copy it again from the camera "
            "or export it anew"
        ) from fault
