"""The switch of the compiled loops: off, numpy does all work, with the same results."""

from __future__ import annotations

import importlib.util
import os

SWITCH = "NLIGHTS_KERNELS"
"""Environment variable; "off" leaves all work to numpy, with the same results."""


def available() -> bool:
    """Whether there are compiled kernels: numba is installed and the switch is not off."""
    return os.environ.get(SWITCH) != "off" and importlib.util.find_spec("numba") is not None
