"""The simulator: its photographs follow from its truth by independent physics."""

import numpy as np
import pytest
import tifffile
import yaml

from nlights_core.errors import CaptureError
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.simulation import captures as simulation
from nlights_core.simulation import illumination
from nlights_core.simulation.captures import expose, simulate
from nlights_core.simulation.evaluation import angles_between
from nlights_core.simulation.illumination import horizon, lamp_groups, shine
from nlights_core.simulation.scenes import SCENES, synthetic_stand
from nlights_core.simulation.surfaces import Stroke, strokes

STAND = synthetic_stand()
LAMPS = len(STAND.lamps)


def read(folder, name):
    return tifffile.imread(folder / name)


def photographs(folder, prefix=""):
    dark = read(folder, "dark.tif").mean()
    return np.stack([read(folder, f"{prefix}light_{n + 1}.tif").astype(float) - dark for n in range(LAMPS)])


@pytest.fixture(scope="module")
def painting(tmp_path_factory):
    folder = tmp_path_factory.mktemp("painting")
    simulate(folder, STAND, scene="painting", width=160)
    return folder


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    simulate(folder, STAND, scene="plane", width=96)
    return folder


def test_the_manifest_names_every_photograph(painting):
    manifest = yaml.safe_load((painting / "artwork.yaml").read_text())
    assert manifest["stand"] == "stand.yaml"  # this stand is not shipped, so it travels along
    assert list(manifest["frames"]) == list(manifest["flats"]) == list(STAND.lamps)
    for name in [*manifest["frames"].values(), *manifest["flats"].values(), manifest["dark"]]:
        image = read(painting, name)
        assert (image.shape, image.dtype) == ((120, 160, 3), np.uint16)


def test_the_truth_is_float32_on_the_photographs_grid(painting):
    shapes = {"normals": (120, 160, 3), "albedo": (120, 160, 3), "height": (120, 160)}
    for name, shape in shapes.items():
        image = read(painting, f"truth/{name}.tif")
        assert (image.shape, image.dtype) == (shape, np.float32)
    assert np.linalg.norm(read(painting, "truth/normals.tif"), axis=-1) == pytest.approx(1, abs=1e-6)


def test_true_normals_are_the_slopes_of_the_true_height(tmp_path):
    simulate(tmp_path, STAND, scene="relief", width=400)
    height = read(tmp_path, "truth/height.tif").astype(float)
    grid = PixelGrid(300, 400, 1.25, (0.0, 0.0, 1540.0))
    x, y, _ = grid.points(0, 300, height).astype(float)
    tangents = [np.stack([np.gradient(axis, axis=k) for axis in (x, y, height)], axis=-1) for k in (1, 0)]
    differences = np.cross(tangents[1], tangents[0])
    angles = angles_between(read(tmp_path, "truth/normals.tif"), differences)
    # The relief's texture curves within a pixel, which differences of heights cannot follow.
    assert np.median(angles) < 0.05
    assert angles.max() < 1.5


def test_frames_over_flats_give_the_normals_and_the_albedo_back(painting):
    """Least squares relative to the flat, with only the measured positions known."""
    height, albedo = read(painting, "truth/height.tif"), read(painting, "truth/albedo.tif")
    grid = PixelGrid(120, 160, 500 / 160, (0.0, 0.0, 1540.0))
    lamps = LightField(tuple(STAND.lamps), positions=STAND.lamp_positions())
    over_plane = lamps.vectors(grid.points(0, 120))[..., 2]
    lights = lamps.vectors(grid.points(0, 120, height)) / over_plane[..., None]
    flats = photographs(painting, "flat/").mean(axis=-1)
    ratio = photographs(painting).mean(axis=-1) / flats
    matrix = np.einsum("lhw,lhwi,lhwj->hwij", flats, lights, lights)
    right = np.einsum("lhw,lhwi,lhw->hwi", flats, lights, ratio)
    solved = np.linalg.solve(matrix, right[..., None])[..., 0]
    angles = angles_between(solved, read(painting, "truth/normals.tif"))
    assert angles.mean() < 0.35  # the flats' own noise is not smoothed here
    found = np.linalg.norm(solved, axis=-1) * simulation.FLAT_ALBEDO
    assert np.median(found / albedo.mean(axis=-1)) == pytest.approx(1, abs=0.005)


def test_the_heights_lie_near_the_plane():
    size = np.array(STAND.field_mm)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 161) * size[0], np.linspace(-0.5, 0.5, 121) * size[1])
    heights = {
        name: make(STAND.field_mm, 2.0, np.random.default_rng(0)).surface.height(x, y)
        for name, make in SCENES.items()
    }
    assert not heights["plane"].any()
    assert np.ptp(heights["drawing"]) == pytest.approx(1.5, abs=0.5)
    assert abs(heights["painting"].mean()) < 0.1
    assert heights["relief"].min() >= 0
    assert heights["relief"].max() == pytest.approx(8, abs=0.5)
    border = np.concatenate([heights["relief"][[0, -1]].ravel(), heights["relief"][:, [0, -1]].ravel()])
    assert border.max() < 0.2


@pytest.mark.parametrize("scene", SCENES)
def test_slopes_are_moderate_and_albedos_physical(scene):
    x, y = np.meshgrid(np.linspace(-249, 249, 400), np.linspace(-187, 187, 300))
    artwork = SCENES[scene](STAND.field_mm, 3.0, np.random.default_rng(0))
    assert np.degrees(np.arctan(np.hypot(*artwork.surface.slopes(x, y)))).max() < 35
    albedo = artwork.albedo(x, y)
    assert albedo.shape == (300, 400, 3)
    assert albedo.min() > 0.02
    assert albedo.max() < 0.95


def test_the_same_seed_gives_the_same_files_and_another_does_not(tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        simulate(tmp_path / name, STAND, scene="drawing", width=48, seed=seed)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.tif"))
    assert len(files) == 2 * LAMPS + 4
    for file in files:
        same = (tmp_path / "a" / file).read_bytes()
        assert same == (tmp_path / "b" / file).read_bytes()
        assert same != (tmp_path / "c" / file).read_bytes()


def test_the_brightest_matt_pixel_is_near_80_percent_of_saturation(card):
    brightest = max(photographs(card).max(), photographs(card, "flat/").max())
    assert brightest == pytest.approx(0.8 * 65535, rel=0.04)


def test_noise_has_the_variance_of_shot_and_read_noise():
    random = np.random.default_rng(0)
    per_electron = (simulation.SATURATION - simulation.BLACK_LEVEL) / simulation.FULL_WELL
    for share in (0.0, 0.01, 0.5):
        image = expose(np.full((200, 200, 3), share, np.float32), 1.0, random).astype(float)
        electrons = share * simulation.FULL_WELL
        assert image.mean() == pytest.approx(simulation.BLACK_LEVEL + electrons * per_electron, rel=1e-3)
        deviation = per_electron * np.sqrt(electrons + simulation.READ_NOISE**2)
        assert image.std() == pytest.approx(deviation, rel=0.02)


def test_light_past_saturation_is_clipped():
    assert (expose(np.full((4, 4, 3), 3.0, np.float32), 1.0, np.random.default_rng(0)) == 65535).all()


def test_varnish_adds_light_and_only_to_the_artwork(painting, tmp_path):
    simulate(tmp_path, STAND, scene="painting", width=160, varnish=True)
    added = photographs(tmp_path) - photographs(painting)
    assert np.percentile(added, 99) > 2000
    assert added.min() >= -simulation.BLACK_LEVEL
    np.testing.assert_array_equal(photographs(tmp_path, "flat/"), photographs(painting, "flat/"))


def test_a_highlight_is_where_the_normal_halves_light_and_view():
    group = lamp_groups(STAND, np.random.default_rng(0))[1]
    points = np.zeros((3, 1, 61), np.float32)
    tilts = np.radians(np.linspace(0, 45, 61))
    normals = np.stack([np.sin(tilts), 0 * tilts, np.cos(tilts)], axis=-1)[None].astype(np.float32)
    matt, gloss = shine(group, points, normals, None, np.array([0.0, 0.0, 1540.0]))
    elevation = np.degrees(np.arctan2(group.centre[2], group.centre[0]))
    lobe = gloss / matt
    assert np.degrees(tilts[lobe.argmax()]) == pytest.approx((90 - elevation) / 2, abs=1)


def test_a_group_of_lamps_surrounds_its_measured_position():
    for group, measured in zip(
        lamp_groups(STAND, np.random.default_rng(0)), STAND.lamp_positions(), strict=True
    ):
        np.testing.assert_allclose(group.positions.mean(axis=0), measured, atol=1e-9)
        apart = np.linalg.norm(group.positions - measured, axis=1)
        np.testing.assert_allclose(apart, illumination.GROUP_EDGE_MM / np.sqrt(2))
        assert np.abs((group.positions - measured) @ measured).max() < 1e-6
        aim = angles_between(group.axes, -group.positions)
        assert 0 < aim.max() < 5


def test_light_falls_with_the_square_of_the_distance_and_off_the_axis():
    group = lamp_groups(STAND, np.random.default_rng(0))[1]
    up = np.zeros((1, 1, 3), np.float32)
    up[..., 2] = 1
    at_foot = np.array([200.0, 0.0, 0.0], np.float32)[:, None, None]
    matt, _ = shine(group, at_foot, up, None)
    expected = 0.0
    for position, axis, power in zip(group.positions, group.axes, group.powers, strict=True):
        ray = position - at_foot[:, 0, 0]
        distance = np.linalg.norm(ray)
        emission = (-(ray / distance) @ axis) ** STAND.lamp.exponent
        expected += power * emission * ray[2] / distance**3
    assert matt[0, 0] == pytest.approx(expected * (group.centre @ group.centre), rel=1e-5)


def test_a_ridge_casts_a_shadow_away_from_the_lamp():
    ridge = strokes([Stroke(0.0, 0.0, 8.0, 60.0, 0.0, 8.0)])
    sky = horizon(ridge, PixelGrid(300, 400, 0.5), np.array([640.0, 0.0, 170.0]))
    reach = np.array([-60.0, -20.0, 20.0])
    # The crest, 8 mm high, stands 22 degrees above the point 20 mm behind it; the lamp only 14.
    far, near, lit = sky.at(reach, np.zeros(3))
    assert near == pytest.approx(8 / 20, rel=0.1)
    assert near > 170 / 660
    # From 60 mm on the lamp is seen above the crest.
    assert far < 170 / 700
    assert lit < 0.01


def test_a_shadowed_point_gets_no_light():
    ridge = strokes([Stroke(0.0, 0.0, 8.0, 60.0, 0.0, 8.0)])
    group = lamp_groups(STAND, np.random.default_rng(0))[0]
    sky = horizon(ridge, PixelGrid(300, 400, 0.5), group.centre)
    points = np.array([[-20.0, 20.0], [0, 0], [0, 0]], np.float32)[:, None]
    up = np.tile(np.array([0, 0, 1], np.float32), (1, 2, 1))
    matt, _ = shine(group, points, up, sky)
    assert matt[0, 0] == 0
    assert matt[0, 1] > 0.1


def test_a_folder_that_holds_something_is_refused_and_left_alone(tmp_path):
    (tmp_path / "note.txt").write_text("keep me")
    with pytest.raises(CaptureError, match="already holds something"):
        simulate(tmp_path, STAND, scene="plane", width=48)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_an_unknown_scene_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(CaptureError, match="plane, drawing, painting, relief"):
        simulate(tmp_path / "new", STAND, scene="sculpture", width=48)
    assert not (tmp_path / "new").exists()


def test_a_run_that_is_stopped_leaves_nothing_behind(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "new", STAND, scene="plane", width=48, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_up_to_all_rows(tmp_path):
    seen = []
    simulate(tmp_path / "new", STAND, scene="plane", width=96, progress=lambda *p: seen.append(p))
    assert seen == [(64, 72), (72, 72)]
