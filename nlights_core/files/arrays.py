"""Arrays on disk: written by bands, read as memory maps."""

from __future__ import annotations

import io
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from nlights_core.files.steady_files import SteadyFile
from nlights_core.frames import Array


class BandWriter:
    """Writer of a .npy file, band by band.

    Plain writes, not a memory map: on a full disk a write raises `OSError`, where a memory map
    kills the process.

    Parameters
    ----------
    path : Path
        The file, which must not exist.
    shape : tuple of int
        Of the whole array.
    dtype : dtype
        Of the whole array.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: Any = np.float32) -> None:
        self.shape, self.dtype, self._rows = shape, np.dtype(dtype), 0
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": self.dtype.str, "fortran_order": False, "shape": shape}
        )
        self._file = SteadyFile(path, read_soon=True)
        self._file.write(header.getbuffer())

    def write(self, band: Array) -> None:
        """Append rows."""
        if band.shape[1:] != self.shape[1:]:
            raise ValueError(f"rows of shape {self.shape[1:]} are expected, got {band.shape[1:]}")
        self._file.write(np.ascontiguousarray(band, self.dtype).data)
        self._rows += len(band)

    def __enter__(self) -> BandWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if kind is None and self._rows != self.shape[0]:
            raise ValueError(f"{self._rows} of {self.shape[0]} rows were written")


def write_array(path: Path, array: Array) -> None:
    """Write a whole array."""
    with BandWriter(path, array.shape, array.dtype) as file:
        file.write(array)


def read_array(path: Path) -> Array:
    """Open a .npy file as a read-only memory map."""
    return np.load(path, mmap_mode="r", allow_pickle=False)  # type: ignore[no-any-return]
