"""Compilation of loops over pixels, by numba, when they are first called.

They are compiled for a kind of processors (`nlights_core.machine.targets`), not for the very one, give the same bits
on all, and can be prepared on one machine for another.  Where they are kept: `nlights_core.machine.kernel_cache`.

Import this module only from compiled ones: it needs numba, which takes half a second.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

from nlights_core.machine import compilation
from nlights_core.machine.kernel_cache import chosen_target, folders, place_of, writable_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_njit: Any = numba.njit
_file_of_index: Any = IndexDataCacheFile
_settings: Any = numba.config

if _target := chosen_target():
    _settings.CPU_NAME, _settings.CPU_FEATURES = _target.name, _target.features


class _Place(_CacheLocator):
    """Place where numba looks for a function; the folder's name alone tells that it is fresh."""

    def __init__(self, function: Any) -> None:
        self.name = place_of(function.__module__)

    def get_cache_path(self) -> str:
        return self.name

    def get_source_stamp(self) -> str:
        return self.name

    def get_disambiguator(self) -> str:
        return ""

    @classmethod
    def from_function(cls, function: Any, file: str) -> _Place:
        return cls(function)


class _Impl(CompileResultCacheImpl):
    _locator_classes = [_Place]  # type: ignore[list-item] # noqa: RUF012


class _KernelCache(FunctionCache):
    """Cache that looks for a function in all folders, and writes to one."""

    _impl_class = _Impl

    def _files(self) -> list[Any]:
        return [self._file(folder) for folder in folders()]

    def _file(self, folder: Path) -> Any:
        name = self._impl.locator.name
        return _file_of_index(str(folder / name), self._impl.filename_base, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        target_context.refresh()
        key = self._index_key(sig, target_context.codegen())
        for file in self._files():
            try:
                data = file.load(key)
                if data is not None:
                    return self._impl.rebuild(target_context, data)
            except Exception:  # half a file, or another user's: it is compiled anew
                continue
        compilation.begin(self._py_func.__name__)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = writable_folder()
        if folder is None or not self._impl.check_cachable(data):
            return
        try:
            file = self._file(folder)
            (folder / self._impl.locator.name).mkdir(exist_ok=True, mode=0o755)
            file.save(self._index_key(sig, data.codegen), self._impl.reduce(data))
        except OSError:
            compilation.not_kept(folder)

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        # The folder's name is a digest of all sources: numba's digest of the function's own code adds nothing,
        # and cannot be made of one that holds another compiled function.
        return sig, codegen.magic_tuple()


def decorators(**options: Any) -> tuple[Callable[[Function], Function], Callable[[Function], Function]]:
    """Make two decorators: for loops that Python calls, and for those that only other loops call.

    The former are kept on disk for the next process.  The latter are part of them, and are not kept by
    themselves; without a way in from Python they take a quarter less time to compile.

    Parameters
    ----------
    **options
        Of `numba.njit`, beside those that all loops have.

    Returns
    -------
    kernel, inner : callable
    """
    common = {"nogil": True, "error_model": "numpy", **options}

    def kernel(function: Function) -> Function:
        made: Any = _njit(**common)(function)
        made._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
        return made  # type: ignore[no-any-return]

    inner: Any = _njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **common)
    return kernel, inner


kernel, inner = decorators()
