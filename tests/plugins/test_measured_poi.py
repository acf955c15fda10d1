"""Measured points of interest: positions, aims and directions in the plane frame."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.stands import Axes, Lamp, Stand
from nlights_plugins.measured_poi import MeasuredPoi

STAND = Stand(
    name="wall",
    source="test",
    # Measured with X right, Y into the wall, Z up.
    axes=Axes(x="X", y="Z", z="-Y"),
    field_mm=(500, 375),
    camera=(0, -1500, 0),
    lamps={"east": (900, -300, 0), "north": (0, -600, 800), "west": (-900, -300, 0)},
    lamp=Lamp(half_angle_deg=12.5, emitter_size_mm=30),
    uncertainty_mm=1,
)


def tile(*lamps, stand=STAND):
    return Tile(artwork="a", name="r0c0", stand=stand, frames={lamp: Path(f"{lamp}.tif") for lamp in lamps})


def no_photograph(path, *, reduce=1):
    raise AssertionError("measured-poi must not read photographs")


def test_lamps_are_where_they_were_measured_in_the_order_of_the_frames():
    field = MeasuredPoi().locate(tile("north", "east"), no_photograph)
    assert field.lamps == ("north", "east")
    np.testing.assert_array_equal(field.positions, [[0, 800, 600], [900, 0, 300]])
    assert field.exponents is None


def test_distant_lamps_shine_from_their_direction_at_the_fields_centre():
    field = MeasuredPoi(distant=True).locate(tile("north"), no_photograph)
    assert not field.near
    np.testing.assert_allclose(field.directions, [[0, 0.8, 0.6]])


def test_with_emission_the_irradiance_is_half_at_the_half_angle_from_the_centre():
    field = MeasuredPoi(emission=True).locate(tile("north"), no_photograph)
    half = np.radians(12.5)
    # The ray that leaves the lamp 12.5 degrees off its axis, at the axis' length.
    lamp, side = np.array([0, 800, 600.0]), np.array([1.0, 0, 0])
    point = lamp + 1000 * (np.cos(half) * -lamp / 1000 + np.sin(half) * side)
    strength = np.linalg.norm(field.vectors(point.reshape(3, 1, 1)), axis=-1)
    assert strength.item() == pytest.approx(0.5, rel=1e-5)


def test_a_tile_without_a_stand_is_refused_with_the_remedy():
    with pytest.raises(TileError, match=r"tile r0c0: measured-poi needs a stand.*chrome-sphere"):
        MeasuredPoi().locate(tile("north", stand=None), no_photograph)


def test_a_lamp_that_the_stand_does_not_have_is_named():
    with pytest.raises(TileError, match="'wall' has no lamp south; it has east, north, west"):
        MeasuredPoi().locate(tile("north", "south"), no_photograph)


def test_emission_of_distant_lamps_is_refused():
    with pytest.raises(ValidationError, match="emission describes near lamps"):
        MeasuredPoi(emission=True, distant=True)
