"""Relative light: what photographs are divided by before details are compared."""

import numpy as np

from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.reduced_light.relative_light import RelativeLight


def test_a_speck_on_a_flat_leaves_no_edges_in_its_smooth_light():
    flats = np.full((1, 60, 80), 0.5, np.float32)
    flats[0, 30:32, 40:42] = 0.25
    vectors = np.broadcast_to(np.float32([0, 0, 1]), (1, 60, 80, 3))
    shaded = np.zeros((1, 24, 24), bool)
    lights = LightField(("A",), directions=np.array([[0.0, 0.0, 1.0]]))
    light = RelativeLight(("A",), flats, flats, vectors, shaded, 4, True, lights, PixelGrid(60, 80, 1.0))
    smooth = light.smooth_divisors
    steps = max(np.abs(np.diff(smooth, axis=axis)).max() for axis in (1, 2))
    assert steps / 0.5 < 1e-4
