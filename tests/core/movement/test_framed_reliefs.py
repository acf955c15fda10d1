"""Reliefs in frames, whose thin shadows look like edges that moved."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import shift

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import BLACK_LEVEL, simulate


def put_in_frame(capture, high, wide, pixel):
    """Put a wooden frame, ``high`` mm deep and ``wide`` px broad, around a capture; it casts hard shadows."""
    random = np.random.default_rng(5)
    tile = capture.tile
    for n, (east, north, up) in enumerate(tile.stand.lamp_positions(), 1):
        flat = tifffile.imread(capture.folder / f"flat/light_{n}.tif").astype(np.float32) - BLACK_LEVEL
        rows, columns = flat.shape[:2]
        y, x = np.mgrid[:rows, :columns]
        from_edges = [(x, -east), (columns - 1 - x, east), (rows - 1 - y, -north), (y, north)]
        inside = np.min([away for away, _ in from_edges], axis=0) >= wide
        shade = [away - wide < high * towards / up / pixel for away, towards in from_edges if towards > 0]
        shade = np.any(shade, axis=0)[..., None]
        wood = (0.28 + 0.11 * np.sin(x / 7 + 3 * np.sin(y / 19)))[..., None] * flat

        def framed(light, flat=flat, inside=inside[..., None], shade=shade, wood=wood):
            light = np.where(inside, np.where(shade, 0.004 * flat, light), wood)
            return light + random.normal(size=light.shape) * np.sqrt(np.maximum(light, 0) * 1.3)

        capture.change_frames(framed, n)


@pytest.mark.parametrize(("stand", "high"), [("vertical-dark", 20), ("horizontal", 15)])
def test_thin_shadows_at_the_foot_of_a_frame_are_no_movement(copy_of, tmp_path, stand, high):
    """A lamp nearly in line with an edge of the frame casts a shadow one pixel wide."""
    simulate(tmp_path / "relief", load_stand(stand), scene="relief", width=480, varnish=False, seed=9308)
    capture = copy_of(tmp_path / "relief")
    put_in_frame(capture, high, 38, 500 / 480)
    assert capture.said() == []


@pytest.mark.parametrize(
    ("numbers", "across", "up"),
    [((2,), 2, 0), ((6,), 0.7, 0), ((4,), -1.2, 1.6), ((1, 3, 7), 0, 2)],
)
def test_a_movement_is_measured_away_from_thin_shadows(photographs, numbers, across, up):
    capture = photographs("relief", "vertical-dark")
    put_in_frame(capture, 10, 12, 500 / 240)
    capture.change_frames(lambda light: shift(light, (-up, across, 0), order=3, mode="nearest"), *numbers)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps) == ("moved", tuple(f"Relio_{n}" for n in numbers))
    assert warning.value == pytest.approx(np.hypot(across, up), abs=0.2)
