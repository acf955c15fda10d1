"""How loops over pixels are compiled, for numba.

Import this module only from compiled ones: it needs numba, which takes half a second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core.codegen import get_host_cpu_features

Function = TypeVar("Function", bound=Callable[..., Any])

_settings: Any = numba.config
_host: str = get_host_cpu_features()  # type: ignore[no-untyped-call]
# The compiler uses half the width of AVX-512, for the sake of the first processors that had it: they slowed
# down.  Those that know its byte permutations too are younger, and gain a sixth.  The results are the same.
if _settings.CPU_FEATURES is None and "+avx512vbmi," in _host:
    _settings.CPU_FEATURES = f"{_host},-prefer-256-bit"


def compiling(**options: Any) -> Callable[[Function], Function]:
    """A decorator that compiles a function when it is first called, and keeps it on disk for the next process."""
    decorator: Callable[[Function], Function] = numba.njit(
        cache=True, nogil=True, error_model="numpy", **options
    )
    return decorator


compiled = compiling()
