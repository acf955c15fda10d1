"""Contracts: what every algorithm of a kind must do, as tests to subclass.

An author's test file is three lines::

    from nlights_core.testing import IntegratorContract

    class TestCosineBasis(IntegratorContract):
        algorithm = CosineBasis()

Truth is analytic and free of noise: a contract finds wrong signs, frames and units, not poor
accuracy.  Tolerances are attributes; the test of an algorithm that is more exact than most
lowers them.  Nothing here needs pytest: any runner that calls the methods ``test_*`` will do.
"""

from nlights_core.testing.algorithms import AlgorithmContract
from nlights_core.testing.heights import HeightDetrendContract, IntegratorContract
from nlights_core.testing.lights import ImageDetrendContract, LightModelContract
from nlights_core.testing.normals import NormalDetrendContract, NormalSolverContract

__all__ = [
    "AlgorithmContract",
    "HeightDetrendContract",
    "ImageDetrendContract",
    "IntegratorContract",
    "LightModelContract",
    "NormalDetrendContract",
    "NormalSolverContract",
]
