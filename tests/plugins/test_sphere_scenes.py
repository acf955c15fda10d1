"""Chrome spheres in whole photographs: beside the artwork, among coins and stones, by traced rays."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter

from nlights_core.capture import Sphere, Tile
from nlights_core.capture_warnings import gathered, read_warnings
from nlights_core.errors import TileError
from nlights_core.lamps.spheres import doubt_of_directions
from nlights_core.testing.chrome import Room, photograph
from nlights_plugins.chrome_sphere import ChromeSphere

STONE = 0.5, 0.93
"""Where the first stone lies, shares of width and height."""


def ring(count=6, elevations=(35, 55)):
    """Lamps around the artwork, by turns at two elevations; (L, 3) unit vectors."""
    azimuth = 2 * np.pi * np.arange(count) / count + 0.2
    elevation = np.radians(np.resize(elevations, count))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


def table(width, height, radius, rng, albedo=0.25):
    """A table with a textured painting, coins that glint on it, and a polished stone at the lower border."""
    row, column = np.mgrid[:height, :width]
    colour = albedo * (1 + 0.4 * gaussian_filter(rng.standard_normal((height, width)), 2))
    relief, gloss = np.zeros((height, width)), np.zeros((height, width))
    painting = np.s_[int(0.15 * height) : int(0.85 * height), int(0.22 * width) : int(0.78 * width)]
    waves = gaussian_filter(rng.standard_normal((height, width)), 5)
    colour[painting] = np.clip(0.35 + 0.1 * waves / waves.std(), 0.05, 0.8)[painting]
    relief[painting] = waves[painting] * 8
    for x, y, size in ((0.4, 0.4, 1.0), (0.6, 0.35, 0.7), (0.55, 0.65, 1.3)):
        away = np.hypot(column - x * width, row - y * height)
        coin = away < size * radius
        colour[coin], gloss[coin] = 0.4, 0.8
        relief += np.clip(size * radius - away, 0, 3) + coin * waves * 4
    away = np.hypot((column - STONE[0] * width) / 1.15, (row - STONE[1] * height) * 1.1)
    relief = np.maximum(relief, 0.6 * np.sqrt(np.clip(radius**2 - away**2, 0, None)))
    colour[away < radius], gloss[away < radius] = 0.3, 0.25
    return Room(colour, relief, gloss)


def written(folder, spheres, width=1200, height=900, albedo=0.25, noise=0.004, lamps=None, even=False):
    """A tile whose own photographs show the spheres, as 16-bit TIFFs; and the true directions."""
    rng = np.random.default_rng(5)
    lamps = ring() if lamps is None else lamps
    room = table(width, height, 0.03 * width, rng, albedo)
    frames = {}
    for i, lamp in enumerate(lamps):
        light = rng.normal(photograph(room, spheres, lamp), noise).clip(0, 1)
        frames[f"L{i + 1}"] = folder / f"light_{i + 1}.tif"
        tifffile.imwrite(frames[f"L{i + 1}"], np.round(light * 65535).astype(np.uint16))
    return Tile(artwork="a", name="t", frames=frames, spheres=(Sphere(frames=frames),)), lamps


def stated(tile, **outline):
    return tile.model_copy(update={"spheres": (Sphere(frames=tile.frames, **outline),)})


def read(path, *, reduce=1):
    pixels = tifffile.imread(path)[..., None].astype(np.float32) / 65535
    h, w = (size // reduce for size in pixels.shape[:2])
    blocks = pixels[: h * reduce, : w * reduce].reshape(h, reduce, w, reduce, 1)
    return blocks.mean(axis=(1, 3))


def angles(found, truth):
    return np.degrees(np.arccos(np.clip((found * truth).sum(axis=1), -1, 1)))


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """A sphere of 6 % of the longer side, left of the painting."""
    return written(tmp_path_factory.mktemp("usual"), [(121.3, 300.4, 36.0)])


@pytest.mark.parametrize(
    ("share", "options"),
    [
        (0.03, {"width": 1600, "height": 1100}),
        (0.04, {}),
        (0.10, {"albedo": 0.1}),
        (0.06, {"albedo": 0.6, "noise": 0.02}),
        (0.06, {"lamps": ring(24, (25, 45, 70))}),
    ],
)
def test_a_sphere_beside_the_artwork_is_found_among_coins_and_stones(tmp_path, share, options):
    width = options.get("width", 1200)
    tile, lamps = written(tmp_path, [(0.09 * width + 0.3, 0.4 * width - 0.4, share * width / 2)], **options)
    field = ChromeSphere().locate(tile, read)
    # A pixel of the highlight is 2 / r radians; its place is a whole pixel.
    assert angles(field.directions, lamps).max() < 0.5 + np.degrees(2 / (share * width / 2))


def test_the_circle_is_right_to_a_quarter_of_a_pixel_and_the_lamps_to_a_pixel_of_the_highlight(tmp_path):
    circle = (371.6, 1200.3, 120.0)
    tile, lamps = written(tmp_path, [circle], 4000, 2700, lamps=ring(3, (45,)))
    model = ChromeSphere()
    assert angles(model.locate(tile, read).directions, lamps).max() < np.degrees(2 / 120)
    # The circle itself: one that misses it by a hundredth is told from it.
    same = model.locate(stated(tile, circle_px=circle), read).directions
    assert angles(model.locate(tile, read).directions, same).max() < np.degrees(4 * 0.25 / 120)


def test_several_spheres_in_one_picture_are_all_found_and_averaged(tmp_path):
    spheres = [(110.2, 300.0, 36.0), (1085.7, 520.6, 40.0), (112.0, 700.4, 44.0)]
    tile, lamps = written(tmp_path, spheres)
    listed_twice = tile.model_copy(update={"spheres": tile.spheres * 2})
    found = ChromeSphere().locate(listed_twice, read).directions
    each = [ChromeSphere().locate(stated(tile, circle_px=circle), read).directions for circle in spheres]
    mean = np.sum(each, axis=0)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    assert angles(found, mean).max() < 0.3
    assert angles(found, lamps).max() < 1.5


def test_without_a_sphere_among_coins_and_stones_none_is_found(tmp_path):
    tile, _ = written(tmp_path, [])
    with pytest.raises(TileError, match=r"no chrome sphere found: .*circle_px \(column, row, radius\)"):
        ChromeSphere().locate(tile, read)


def test_the_edge_of_the_mirrored_table_is_not_taken_for_the_outline(usual):
    tile, lamps = usual
    found = ChromeSphere().locate(tile, read).directions
    ring_of_table = stated(tile, circle_px=(121.3, 300.4, 36.0 / np.sqrt(2)))
    assert angles(found, lamps).max() < 2
    with pytest.raises(TileError):
        ChromeSphere().locate(ring_of_table, read)


@pytest.mark.parametrize(
    ("circle", "told"),
    [
        ((STONE[0] * 1200, STONE[1] * 900, 34.0), "circle"),  # on the stone
        ((480.0, 360.0, 36.0), "circle"),  # on a coin
        ((121.3, 340.4, 36.0), "circle|highlight"),  # half beside the sphere
        ((121.3, 300.4, 54.0), r"is seen, \[121\.\d, 300\.\d, 3[56]\.\d\]"),  # half as large again
        ((121.3, 300.4, 180.0), "circle|highlight"),  # much too large
        ((900.0, 150.0, 50.0), "highlight"),  # on the painting
        ((5000.0, 300.0, 36.0), "outside the photograph"),
    ],
)
def test_a_circle_at_a_wrong_place_is_refused_with_the_remedy(usual, circle, told):
    with pytest.raises(TileError, match=told):
        ChromeSphere().locate(stated(usual[0], circle_px=circle), read)


def test_a_circle_on_the_sphere_is_taken_as_it_is_without_a_word(usual, tmp_path):
    tile, lamps = usual
    with gathered(tmp_path):
        found = ChromeSphere().locate(stated(tile, circle_px=(121.3, 300.4, 36.2)), read).directions
    assert angles(found, lamps).max() < 2
    assert read_warnings(tmp_path) == []


def test_directions_that_no_rig_has_are_named():
    names = [f"L{i}" for i in range(6)]
    whole = ring()
    assert doubt_of_directions(whole, names) is None
    bunched = whole * np.array([0.05, 0.05, 1])
    aside = np.stack([np.ones(6), 0.5 * whole[:, 1], 0.3 + 0.1 * whole[:, 0]], axis=1)
    flat = whole * np.array([1, 0.001, 1])
    same = np.concatenate([whole[:5], whole[:1]])
    for found, told in (
        (bunched, "bunched"),
        (aside, "on one side"),
        (flat, "in one plane"),
        (same, "L0 and L5 would be less than 1 degree apart"),
    ):
        clause = doubt_of_directions(found / np.linalg.norm(found, axis=1, keepdims=True), names)
        assert clause is not None
        assert told in clause
