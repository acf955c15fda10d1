"""Movements of photographs: told against movements that were made."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
import yaml
from scipy.ndimage import shift, zoom

from nlights_core.capture import Encoding, Tile
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.simulation.captures import simulate

REAL = Path(__file__).parents[4] / "shared" / "data"


def moved(across, up):
    """Move a picture's content to the right and up, px."""

    def spoil(light):
        return shift(light, (-up, across, 0)[: light.ndim], order=3, mode="nearest")

    return spoil


def assert_told(warning, across, up, lamps, within=0.3):
    assert (warning.code, warning.lamps, warning.unit) == ("moved", lamps, "px")
    assert warning.value == pytest.approx(np.hypot(across, up), abs=within)
    for lamp in lamps:
        assert lamp in warning.sentence
    words = warning.sentence.replace(",", " ").split()
    assert float(words[words.index("(dx") + 1]) == pytest.approx(across, abs=within)
    assert float(words[words.index("dy") + 1]) == pytest.approx(up, abs=within)


@pytest.mark.parametrize("scene", ["painting", "drawing", "relief"])
@pytest.mark.parametrize(("number", "across", "up"), [(1, 2, 0), (4, 0, -2), (6, -1.5, 1.5)])
def test_a_photograph_moved_by_two_pixels_is_told(photographs, scene, number, across, up):
    capture = photographs(scene)
    capture.change_frames(moved(across, up), number)
    (warning,) = capture.said()
    assert_told(warning, across, up, (f"Relio_{number}",))
    assert warning.sentence.startswith(f"light_{number}.tif (lamp Relio_{number}): moved by")


def grain(seed, across, up, darker=1.0):
    """Noise of a dim photograph, after its content moved."""
    random = np.random.default_rng(seed)

    def spoil(light):
        light = moved(across, up)(light * darker)
        return light + np.sqrt(np.maximum(light, 1)) * 4 * random.standard_normal(light.shape)

    return spoil


@pytest.mark.parametrize(
    ("number", "across", "up", "varnish", "darker"),
    [
        (8, -2.5, 0.5, False, 0.1),
        (3, 0, 2, False, 0.1),
        (5, 1.5, -1.5, False, 0.1),
        (3, 0, 2, True, 1.0),
        (5, 1.5, -1.5, True, 1.0),
    ],
)
def test_a_relief_that_noise_or_gloss_hides_is_followed_in_coarser_details(
    photographs, number, across, up, varnish, darker
):
    capture = photographs("relief", varnish=varnish)
    for n in range(1, 9):
        still = n != number
        capture.change_frames(grain(n, 0 if still else across, 0 if still else up, darker), n)
    (warning,) = capture.said()
    assert_told(warning, across, up, (f"Relio_{number}",))


@pytest.mark.parametrize(("number", "across", "up"), [(1, 2, 0), (3, -1, 1.75), (4, -1, 1.75)])
def test_a_movement_is_told_of_dark_relief_under_varnish(photographs, simulated, number, across, up):
    """Its highlights are brighter than the paint, differ from lamp to lamp, and lie anywhere."""
    capture = photographs("relief", "vertical-dark", varnish=True)
    # What the varnish adds is light that the matt relief has not.
    matt = simulated("relief", "vertical-dark")
    for n in range(1, 9):
        paint = tifffile.imread(matt / f"light_{n}.tif") - 256.0
        capture.change_frames(lambda light, paint=paint: light - 0.85 * paint, n)
    assert capture.said() == []
    capture.change_frames(moved(across, up), number)
    (warning,) = capture.said()
    assert_told(warning, across, up, (capture.tile.lamps[number - 1],))


@pytest.mark.parametrize(
    ("number", "across", "up", "measured"), [(2, 2, 0, True), (8, -1, 1.75, True), (6, -1, 1.75, False)]
)
def test_a_photograph_is_no_mixture_of_the_others_once_it_moved(
    tmp_path, copy_of, number, across, up, measured
):
    """Strong varnish on dark relief, the highlights a third of the light: its fine structure follows no lamp."""
    stand = load_stand("vertical-dark")
    simulate(tmp_path / "relief", stand, scene="relief", width=320, varnish=False, seed=61)
    simulate(tmp_path / "glossy", stand, scene="relief", width=320, varnish=True, seed=61)
    capture, random = copy_of(tmp_path / "glossy"), np.random.default_rng(61)
    for n in range(1, 9):
        matt = tifffile.imread(tmp_path / "relief" / f"light_{n}.tif") - 256.0

        def darken(light, matt=matt):
            light = light - 0.9 * matt
            return light + np.sqrt(np.maximum(light, 1)) * 0.5 * random.standard_normal(light.shape)

        capture.change_frames(darken, n)
    assert capture.said() == []
    capture.change_frames(moved(across, up), number)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps) == ("moved", (capture.tile.lamps[number - 1],))
    if measured:
        assert_told(warning, across, up, (capture.tile.lamps[number - 1],))
    else:
        assert (warning.code, warning.lamps, warning.value) == (
            "moved",
            (capture.tile.lamps[number - 1],),
            None,
        )


def test_no_amount_is_told_where_gloss_and_noise_hide_it(photographs):
    capture = photographs("relief", varnish=True)
    for n in range(1, 9):
        capture.change_frames(grain(n, -2.5 if n == 8 else 0, 0.5 if n == 8 else 0, 0.3), n)
    (warning,) = capture.said()
    assert (warning.code, warning.lamps, warning.value, warning.unit) == ("moved", ("Relio_8",), None, "")
    assert "could not be measured" in warning.sentence
    assert "dx" not in warning.sentence


def test_the_amount_is_told_beside_gloss_that_can_be_taken_out(photographs):
    capture = photographs("painting", "vertical-dark", varnish=True)
    capture.change_frames(moved(0, -2), 5)
    (warning,) = capture.said()
    assert_told(warning, 0, -2, (capture.tile.lamps[4],), within=0.15)


def test_dust_on_the_flats_leaves_no_texture_that_lies_still(photographs):
    random = np.random.default_rng(1)
    capture = photographs("relief")
    dust = np.where(random.uniform(size=(180, 240)) > 0.99, 0.6, 1)
    for n in range(1, 9):
        capture.change(
            f"flat/light_{n}.tif", lambda light: light * dust[: len(light), : light.shape[1], None]
        )
    assert capture.said() == []
    capture.change_frames(moved(-2, 0.5), 4)
    (warning,) = capture.said()
    assert_told(warning, -2, 0.5, ("Relio_4",))


@pytest.mark.parametrize(("across", "up"), [(1, 0), (-7, 3), (12, 5)])
def test_small_and_large_movements_are_told(photographs, across, up):
    capture = photographs("painting", "vertical-dark", varnish=True)
    capture.change_frames(moved(across, up), 3)
    (warning,) = capture.said()
    assert_told(warning, across, up, (capture.tile.lamps[2],))


def test_a_camera_that_moved_after_the_third_photograph_is_told_once(photographs):
    capture = photographs("painting")
    capture.change_frames(moved(0, -2), 4, 5, 6, 7, 8)
    (warning,) = capture.said()
    # Which ones stayed nobody can know: the fewer are said to have moved.
    assert_told(warning, 0, 2, ("Relio_1", "Relio_2", "Relio_3"))


def test_photographs_that_moved_each_in_its_own_way_are_told_apart(photographs):
    capture = photographs("painting")
    capture.change_frames(moved(2, 1), 2)
    capture.change_frames(moved(-1, 2), 7)
    first, second = capture.said()
    assert_told(first, 2, 1, ("Relio_2",))
    assert_told(second, -1, 2, ("Relio_7",))


def test_two_pixels_are_told_of_a_large_photograph(simulated, copy_of, tmp_path):
    """Two pixels are a fifth of a sample of the reduced photograph."""
    small, random = simulated("painting"), np.random.default_rng(3)
    for path in ["dark.tif", *(f"{folder}light_{n}.tif" for folder in ("", "flat/") for n in range(1, 9))]:
        light = zoom(tifffile.imread(small / path)[..., 1].astype(np.float32), 10, order=1)
        light += 40 * random.standard_normal(light.shape, np.float32)
        (tmp_path / path).parent.mkdir(exist_ok=True)
        tifffile.imwrite(tmp_path / path, np.clip(light, 0, 65535).astype(np.uint16))
    manifest = yaml.safe_load((small / "artwork.yaml").read_text(encoding="utf-8"))
    (tmp_path / "artwork.yaml").write_text(yaml.safe_dump(manifest), encoding="utf-8")
    capture = copy_of(tmp_path)
    assert capture.said() == []
    capture.change("light_5.tif", moved(2, -1))
    (warning,) = capture.said()
    assert_told(warning, 2, -1, ("Relio_5",))


def test_nothing_is_said_of_a_plane_without_texture(photographs):
    capture = photographs("plane")
    capture.change_frames(moved(2, 2), 5)
    assert capture.said() == []


def test_nothing_is_said_of_four_lamps(photographs):
    capture = photographs("painting")
    capture.change_frames(moved(2, 2), 2)
    tile = capture.tile
    four = {"frames": dict(list(tile.frames.items())[:4]), "flats": dict(list(tile.flats.items())[:4])}
    assert capture.said(tile.model_copy(update=four)) == []


def test_a_movement_is_told_without_flats_and_with_distant_lamps(photographs):
    capture = photographs("relief")
    capture.change_frames(moved(-2, 2), 8)
    positions = capture.tile.stand.lamp_positions()
    tile = capture.tile.model_copy(update={"flats": None})
    (near,) = capture.said(tile)
    assert_told(near, -2, 2, ("Relio_8",))
    directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    (distant,) = capture.said(capture.tile, LightField(tile.lamps, directions=directions))
    assert_told(distant, -2, 2, ("Relio_8",))


@pytest.mark.parametrize(("name", "lamps"), [("cat", [("L2",)]), ("pig", [])])
def test_of_real_photographs_the_one_that_moved_is_told(copy_of, tmp_path, name, lamps):
    folder = REAL / "harvard" / name
    if not folder.is_dir():
        pytest.skip("the photographs of Harvard are not beside the project")
    files = sorted((folder / "Objects").glob("*.png"))
    frames = {f"L{n}": path for n, path in enumerate(files, 1)}
    tile = Tile(artwork=name, name="t", frames=frames, encoding=Encoding())
    directions = np.loadtxt(folder / "light_directions.txt").T
    lights = LightField(tile.lamps, directions=directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert [warning.lamps for warning in copy_of(tmp_path).said(tile, lights)] == lamps
