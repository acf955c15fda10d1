"""Flats of a board that is not plane: what turns with it is found and taken out."""

import numpy as np
import pytest

from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.photographs.turned_flats import warn_of_bow, without_board

STAND = load_stand("horizontal")
LIGHTS = LightField(tuple(STAND.lamps), positions=STAND.lamp_positions())
X, Y = np.linspace(-240, 240, 33), np.linspace(180, -180, 25)


def readings(shape, turn_deg=0.0, albedo=lambda u, v: 0 * u, brighter=1.0):
    """What a board z = shape(u, v) turned in its plane reads, by numerical slopes and the law of the square."""
    angle = np.radians(turn_deg)
    x, y = np.meshgrid(X, Y)

    def own(x, y):
        return np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x

    def height(x, y):
        return shape(*own(x, y))

    across, up = (
        (height(x + 0.01 * i, y + 0.01 * j) - height(x - 0.01 * i, y - 0.01 * j)) / 0.02
        for i, j in ((1, 0), (0, 1))
    )
    normals = np.stack([-across, -up, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rays = LIGHTS.vectors(np.stack([x, y, height(x, y)])).astype(float)
    light = (rays * normals).sum(axis=-1) * np.exp(albedo(*own(x, y)))
    return np.asarray(0.3 * brighter * light[..., None] * [1.0, 0.9], np.float32)


def plane(u, v):
    return 0 * u


def flattened(sets, turn):
    return without_board(sets, [0, turn], LIGHTS, X, Y)[0]


def off(found):
    """Departure from a plane board's readings beyond a factor, rms."""
    return float(np.std(np.log(found / readings(plane)).mean(axis=-1)))


def cylinder(u, v):
    return -0.3 * ((0.87 * u + 0.5 * v) / 250) ** 2


def twisted(u, v):
    return 0.3 * u * v / 250**2 + 0.2 * (u / 250) ** 3


def off_centre(u, v):
    return -0.3 * ((u - 100) ** 2 + v**2) / 250**2


def bow(u, v):
    return -0.3 * (u**2 + v**2) / 250**2


@pytest.mark.parametrize(
    ("shape", "turn", "left"),
    [
        pytest.param(twisted, 90, 0.1, id="a twist, by a quarter turn"),
        pytest.param(cylinder, 90, 0.8, id="what of a cylinder is not round, by a quarter turn"),
        pytest.param(lambda u, v: 0.3 * (u / 250) ** 3, 180, 0.05, id="an S, by a half turn"),
        pytest.param(lambda u, v: 0.3 * (u / 250) ** 3, 90, 0.05, id="an S, by a quarter turn"),
        pytest.param(lambda u, v: 0.3 * (u / 250) ** 3, 37, 0.05, id="an S, by any turn"),
    ],
)
def test_what_turns_with_the_board_is_taken_out(shape, turn, left):
    first = readings(shape)
    found = flattened([first, readings(shape, turn)], turn)
    assert off(found) < left * off(first)


@pytest.mark.parametrize(("shape", "turn"), [(bow, 180), (bow, 90), (cylinder, 180)])
def test_what_looks_the_same_turned_stays_and_is_not_made_worse(shape, turn):
    first = readings(shape)
    found = flattened([first, readings(shape, turn)], turn)
    assert off(found) == pytest.approx(off(first), rel=0.05)


def test_of_a_bow_beside_the_middle_a_half_turn_leaves_one_about_the_middle():
    found = flattened([readings(off_centre), readings(off_centre, 180)], 180)
    ratio = np.log(found / readings(bow))
    assert np.std(ratio) < 0.1 * off(readings(off_centre))


def test_a_plane_board_under_lamps_that_got_brighter_changes_nothing():
    sets = [readings(plane), readings(plane, 90, brighter=1.03)]
    np.testing.assert_allclose(flattened(sets, 90), sets[0], rtol=1e-4)


def test_an_uneven_albedo_is_taken_out_as_well():
    def dirty(u, v):
        return 0.03 * u / 250

    first = readings(plane, albedo=dirty)
    found = flattened([first, readings(plane, 180, albedo=dirty)], 180)
    assert off(found) < 0.05 * off(first)


def test_the_turn_is_anticlockwise():
    first = readings(twisted)
    wrong = flattened([first, readings(twisted, 60)], -60)
    right = flattened([first, readings(twisted, 60)], 60)
    assert off(right) < 0.2 * off(wrong)


def test_saturated_blocks_of_any_set_are_not_known():
    first, second = readings(twisted), readings(twisted, 90)
    second[2, 3:5, 6] = np.nan
    found = flattened([first, second], 90)
    assert np.isnan(found[2, 3:5, 6]).all()
    assert np.isfinite(found).sum() == found.size - 4


@pytest.mark.parametrize(("height", "codes"), [(0.3, ["flat-bowed"]), (0.01, [])])
def test_a_board_that_is_found_to_be_bowed_is_named_with_its_height(height, codes):
    def bent(u, v):
        return height * u * v / 250**2

    _, bow = without_board([readings(bent), readings(bent, 90)], [0, 90], LIGHTS, X, Y)
    assert bow == pytest.approx(2 * height * 240 * 180 / 250**2, rel=0.05)
    assert [warning.code for warning in warn_of_bow(bow, X, Y)] == codes


def test_noise_is_hardly_taken_for_a_board():
    random = np.random.default_rng(0)
    sets = [readings(plane) * (1 + 0.0003 * random.standard_normal((8, 25, 33, 2))) for _ in range(2)]
    found, bow = without_board(sets, [0, 90], LIGHTS, X, Y)
    assert off(found) < 0.0003
    assert warn_of_bow(bow, X, Y) == []
