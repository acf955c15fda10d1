"""The parabolic fit finds parabolas, whatever else is unknown."""

import os
import subprocess
import sys

import numpy as np
import pytest

from nlights_core.fields import HeightMap
from nlights_core.frames import PixelGrid
from nlights_plugins.height_detrends import ParabolicFit, parabolic_coefficients


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def coordinates(shape):
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    return x, y


def height_map(z):
    return HeightMap(z.astype(np.float32), PixelGrid(*z.shape, 0.04))


def bowl(shape):
    """All six terms of the second order."""
    x, y = coordinates(shape)
    return 0.3 - 0.2 * x + 0.1 * y + 0.7 * x**2 - 0.4 * x * y + 0.25 * y**2


@pytest.mark.parametrize("shape", [(300, 41), (40, 57), (3, 3)])
def test_all_nine_terms_are_found(rng, shape):
    c = rng.standard_normal((3, 3))
    x, y = coordinates(shape)
    z = sum(c[a, b] * x**a * y**b for a in range(3) for b in range(3))
    assert parabolic_coefficients(z) == pytest.approx(c, abs=1e-11)
    trend = ParabolicFit().trend(height_map(z))
    assert trend.dtype == np.float32
    assert trend == pytest.approx(z, abs=2e-6)


def test_six_terms_leave_what_is_of_higher_order():
    shape = (50, 61)
    x, y = coordinates(shape)
    z = bowl(shape)
    quadratic = ParabolicFit(terms="quadratic")
    assert quadratic.trend(height_map(z)) == pytest.approx(z, abs=2e-6)
    assert parabolic_coefficients(z + x**2 * y**2, "quadratic")[2, 2] == 0
    left = x**2 * y**2 - quadratic.trend(height_map(x**2 * y**2))
    assert np.std(left) > 0.05


def test_it_is_the_least_squares_fit_of_what_is_known(rng):
    z = rng.standard_normal((40, 30))
    known = rng.random(z.shape) > 0.4
    known[:, 20:] = False
    x, y = coordinates(z.shape)
    terms = np.stack([(x**a * y**b)[known] for a in range(3) for b in range(3)], axis=1)
    expected = np.linalg.lstsq(terms, z[known])[0].reshape(3, 3)
    assert parabolic_coefficients(np.where(known, z, np.nan)) == pytest.approx(expected, abs=1e-8)


def test_unknown_pixels_change_nothing_and_get_a_trend_all_the_same():
    z = bowl((600, 80))
    holed = z.copy()
    holed[100:300, 20:50] = np.nan
    assert ParabolicFit().trend(height_map(holed)) == pytest.approx(z, abs=5e-6)


def test_the_relief_is_left_where_it_is_no_parabola():
    x, y = coordinates((200, 150))
    relief = 0.05 * np.sin(40 * x) * np.cos(30 * y)
    z = 5 + bowl(x.shape) + relief
    left = z - ParabolicFit().trend(height_map(z))
    assert np.abs(left - relief).max() < 5e-3


def test_a_height_far_from_zero_keeps_its_precision():
    z = 1000 + 0.01 * bowl((100, 90))
    coefficients = parabolic_coefficients(z)
    assert coefficients[2, 0] == pytest.approx(0.007, rel=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 2), (2, 3)])
@pytest.mark.parametrize("terms", ["3x3", "quadratic"])
def test_few_pixels_are_met_without_a_guess_that_runs_away(rng, shape, terms):
    z = rng.random(shape)
    trend = ParabolicFit(terms=terms).trend(height_map(z))
    assert np.abs(trend).max() < 3
    if z.size <= 4:
        assert trend == pytest.approx(z, abs=1e-6)


def test_of_nothing_known_the_trend_is_zero():
    nothing = np.full((6, 7), np.nan)
    assert np.array_equal(ParabolicFit().trend(height_map(nothing)), np.zeros((6, 7)))


def test_the_height_is_not_overwritten():
    z = height_map(bowl((20, 30)))
    before = z.height.copy()
    ParabolicFit().trend(z)
    assert np.array_equal(z.height, before)


def test_the_number_of_threads_changes_no_bit():
    code = (
        "import numpy as np\n"
        "from nlights_plugins.height_detrends import parabolic_coefficients\n"
        "z = np.random.default_rng(0).random((750, 1000), np.float32)\n"
        "print(parabolic_coefficients(z).tobytes().hex())\n"
    )
    said = {
        subprocess.check_output([sys.executable, "-c", code], env=os.environ | {"OPENBLAS_NUM_THREADS": n})
        for n in ("1", "2")
    }
    assert len(said) == 1
