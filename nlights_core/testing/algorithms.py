"""Contract of every algorithm, whatever its kind."""

from __future__ import annotations

import pickle
from typing import Any, ClassVar

import numpy as np

from nlights_core.algorithms import Algorithm
from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.surfaces import peaks

GRID = PixelGrid(48, 64, 0.5)
"""The grid of most checks: not square, and its pixels are not 1 mm."""
HILLS = peaks(top=0.8, half_width=11.0)


def expect(right: Any, sentence: str) -> None:
    """`assert` that survives ``python -O`` and says what is wrong."""
    if not right:
        raise AssertionError(sentence)


def expect_array(found: Array, shape: tuple[int, ...], what: str) -> None:
    """Check dtype float32 and a shape, naming the array."""
    expect(found.dtype == np.float32, f"{what} must be float32, not {found.dtype}")
    expect(found.shape == shape, f"{what} must have the shape {shape}, not {found.shape}")


def holed(shape: tuple[int, ...]) -> Array:
    """Mask of what is not known: one pixel inside, and the left border."""
    hole = np.zeros(shape, bool)
    hole[30, 40] = True
    hole[:, :2] = True
    return hole


class AlgorithmContract:
    """Contract of every algorithm; subclass the contract of a kind, not this."""

    algorithm: ClassVar[Any]
    kind: ClassVar[type[Algorithm]] = Algorithm

    def test_is_of_its_kind_and_has_a_hyphenated_name(self) -> None:
        """The recipe finds it by slot and name."""
        expect(isinstance(self.algorithm, self.kind), f"must be a subclass of {self.kind.__name__}")
        name = self.algorithm.name
        plain = name.replace("-", "")
        expect(plain.isalnum() and name == name.lower(), f"'{name}' must be lower case with hyphens")

    def test_every_option_is_described(self) -> None:
        """``nlights plugins`` and the recipe's schema show the descriptions."""
        for option, field in type(self.algorithm).model_fields.items():
            expect(field.description, f"option {option} needs Field(description=...)")

    def test_its_options_make_the_round_trip_through_json(self) -> None:
        """The dump is the provenance and part of the cache key."""
        text = self.algorithm.model_dump_json()
        expect(type(self.algorithm).model_validate_json(text) == self.algorithm, "dump loses an option")

    def test_it_travels_to_a_worker(self) -> None:
        """Workers are other processes: an algorithm is pickled."""
        expect(pickle.loads(pickle.dumps(self.algorithm)) == self.algorithm, "pickling changes it")
