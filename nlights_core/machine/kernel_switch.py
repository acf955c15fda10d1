"""The switch of the compiled loops, and how arrays are handed to them."""

from __future__ import annotations

import importlib.util
import os

from nlights_core.frames import Array

SWITCH = "NLIGHTS_KERNELS"
"""Environment variable; "off" leaves the solving of normals to numpy, with the same results.  A calibration and the
removal of gloss have compiled loops only: in numpy they would take minutes."""


def available() -> bool:
    """Test whether there are compiled kernels: numba is installed and the switch is not off."""
    return os.environ.get(SWITCH) != "off" and importlib.util.find_spec("numba") is not None


def read_only(array: Array) -> Array:
    """View an array as one that must not be written.

    To the compiler what may be written is another type.  What comes from a file in one place and from memory in
    another is given as this, so that the loop is compiled once.
    """
    view = array.view()
    view.flags.writeable = False
    return view
