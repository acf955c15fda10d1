"""Accuracy on photographed objects whose normals are known: DiLiGenT, and the grey sphere of UW."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy_tables import Cell, Table, kept

from nlights_core import strengths as strength_fit
from nlights_core.algorithms import NormalSolver
from nlights_core.capture import Encoding
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.images import Photograph, grey
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.registry import installed
from nlights_core.store import Store
from nlights_core.testing.evaluation import angles_between
from nlights_flows.running import run_directly

DATA = Path(__file__).parents[1].parent / "shared" / "data"
OBJECTS = ("ball", "bear")

PEERS: list[tuple[Cell, ...]] = [
    ("plain least squares, as published", None, None, None, None, None, None, None),
    ("L1 per pixel, public Python", 2.43, None, None, 6.25, None, None, None),
    ("robust principal components, public Python", 3.10, None, None, 7.17, None, None, None),
]
"""Mean angles in degrees of other programs, from numerics.md."""

RIG = [91, 7, 43, 48, 92, 55, 44, 0]
"""The lights nearest to 15 and to 45 degrees above the horizon on each of four sides, as in this rig."""

SAMPLES = 20_000
"""Pixels that a refinement of strengths sees."""


class Shots(NamedTuple):
    """The pixels of an object: images (L, 1, n), lights (L, 1, 1, 3), weights (L, 1, n), truth (1, n, 3)."""

    images: Array
    lights: Array
    weights: Array
    truth: Array

    def of(self, lamps: list[int]) -> Shots:
        """The same pixels under some of the lamps."""
        return Shots(self.images[lamps], self.lights[lamps], self.weights[lamps], self.truth)
