"""Targets: the kinds of processors for which loops are compiled, so that one machine prepares them for another."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache


@dataclass(frozen=True)
class Target:
    """A kind of processors.

    Attributes
    ----------
    name : str
        As the compiler calls it.
    features : str
        What the compiler is told beside the name.
    needed : frozenset of str
        What a processor must know to run such code; an older one would die of an illegal instruction.
    """

    name: str
    features: str
    needed: frozenset[str]


_V3 = frozenset(
    [
        "avx",
        "avx2",
        "bmi",
        "bmi2",
        "f16c",
        "fma",
        "lzcnt",
        "movbe",
        "xsave",
        "popcnt",
        "sse4.2",
        "ssse3",
        "cx16",
    ]
)
_V4 = _V3 | frozenset(["avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"])

TARGETS = (
    # The compiler uses half the width of AVX-512, for the sake of the first processors that had it: they slowed
    # down.  Those that know its byte permutations (vbmi) too are younger, and solve normals a sixth faster.
    Target("x86-64-v4", "-prefer-256-bit", _V4 | {"avx512vbmi"}),
    Target("x86-64-v3", "", _V3),
)
"""From the fastest to the one that most processors run (AVX2, since 2013); the results are the same bits."""

NATIVE = "native"
"""Name for what is compiled for a processor that fits no target, or that the environment names."""


@cache
def supported_targets() -> tuple[Target, ...]:
    """Find the targets that this processor can run, the fastest first.

    Returns
    -------
    tuple of Target
        Empty on old and other processors, and where ``NUMBA_CPU_NAME`` or ``NUMBA_CPU_FEATURES`` is set.
    """
    if os.environ.get("NUMBA_CPU_NAME") or os.environ.get("NUMBA_CPU_FEATURES"):
        return ()
    from llvmlite import binding

    known = {name for name, has in binding.get_host_cpu_features().items() if has}
    return tuple(target for target in TARGETS if target.needed <= known)
