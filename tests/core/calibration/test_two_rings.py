"""Two answers: heights by two halves of the lamps agree on sound captures, and on no other."""

import shutil

import numpy as np
import pytest
import tifffile

from nlights_core.calibration.fitting import calibrate
from nlights_core.calibration.record import TwoAnswers, read_calibration
from nlights_core.calibration.two_rings import compare_halves, divide_lamps
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.manifest import load_capture
from nlights_core.near_light.overview import reduced_room
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import read_flat_field
from nlights_core.recipe import load_recipe
from nlights_core.report.calibration_quality import of_calibration
from nlights_core.simulation.captures import simulate
from nlights_core.stages import calibration, flat_field, lights
from nlights_core.stages.inputs import read_lights
from nlights_core.store import Store

STAND = load_stand("vertical-dark")
LAMPS = tuple(STAND.lamps)
LOW, HIGH = LAMPS[:4], LAMPS[4:]


@pytest.fixture(scope="module")
def relief(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two_rings") / "capture"
    simulate(folder, STAND, scene="relief", width=240, seed=3)
    return folder


@pytest.fixture
def place(relief, tmp_path):
    """A capture that may be spoilt, with the same flats."""
    return shutil.copytree(relief, tmp_path / "capture")


def spoil(folder, lamp, factor):
    path = folder / f"light_{LAMPS.index(lamp) + 1}.tif"
    image = tifffile.imread(path).astype(float)
    columns = np.linspace(-0.5, 0.5, image.shape[1])[:, None]
    light = 256 + (image - 256) * factor(columns)
    tifffile.imwrite(path, np.clip(np.rint(light), 0, 65535).astype(np.uint16), photometric="rgb")


def answers(folder, scratch, groups=()):
    """What the two halves say, by a calibration that seeks the level and some groups."""
    tile, recipe, store = load_capture(folder)[0], load_recipe("default"), Store(scratch / "store")
    lamps = lights(store, tile, recipe.light_model)
    store.ensure(lamps)
    white = flat_field(store, tile, recipe.detrend.images, lamps.ref)
    store.ensure(white)
    field, divisor = read_lights(store, lamps.ref), read_flat_field(store.path(white.ref))
    with darkroom(tile, scratch) as room:
        small = reduced_room(room, lambda _: None)
    return compare_halves(small, field, divisor, calibrate(small, field, divisor, ("level", *groups)))


def test_a_sound_capture_gives_the_same_height_twice(relief, tmp_path):
    found = answers(relief, tmp_path)
    assert found.rings
    assert (found.low, found.high) == (LOW, HIGH)
    assert found.limit == pytest.approx(1.2e-4 * 500, rel=0.01)
    assert not found.disagree
    assert found.difference < found.limit / 3


def test_light_that_is_not_the_flats_makes_the_two_disagree_in_proportion(place, tmp_path):
    """A lamp that was turned: no group of unknowns can explain it."""
    spoil(place, LOW[0], lambda x: 1 + 0.02 * x)
    once = answers(place, tmp_path)
    spoil(place, LOW[0], lambda x: (1 + 0.04 * x) / (1 + 0.02 * x))
    twice = answers(place, tmp_path)
    assert once.disagree
    assert twice.difference / once.difference == pytest.approx(2, rel=0.15)


def test_a_drift_is_no_disagreement_once_it_is_known(place, tmp_path):
    for lamp, percent in zip(LAMPS, (2, -2, 1, -1, -2, 2, -1, 1), strict=True):
        spoil(place, lamp, lambda x, percent=percent: 1 + percent / 100 + 0 * x)
    assert answers(place, tmp_path).disagree
    assert not answers(place, tmp_path, ("lamps",)).disagree


def test_gloss_is_no_disagreement_once_it_is_known(tmp_path):
    folder = tmp_path / "varnished"
    simulate(folder, STAND, scene="painting", width=240, seed=3, varnish=True)
    blind = answers(folder, tmp_path)
    seeing = answers(folder, tmp_path, ("gloss",))
    assert blind.disagree
    assert seeing.difference < blind.difference / 3


def test_noise_alone_is_no_disagreement(place, tmp_path):
    """A hundredth of the photons: heights differ by chance, which the noise explains."""
    random = np.random.default_rng(1)
    for path in place.glob("light_*.tif"):
        image = tifffile.imread(path).astype(float)
        spread = 10 * np.sqrt(np.maximum(image - 256, 1) * 65535 / 50_000)
        noisy = image + spread * random.standard_normal(image.shape)
        tifffile.imwrite(path, np.clip(np.rint(noisy), 0, 65535).astype(np.uint16), photometric="rgb")
    found = answers(place, tmp_path)
    assert found.noise > 0.03
    assert not found.disagree


def cone(count, elevation_deg):
    angle = np.radians(360 * np.arange(count) / count)
    e = np.radians(elevation_deg)
    return 800 * np.stack(
        [np.cos(e) * np.cos(angle), np.cos(e) * np.sin(angle), 0 * angle + np.sin(e)], axis=1
    )


def field(*parts):
    positions = np.concatenate(parts)
    return LightField(tuple(f"L{i}" for i in range(len(positions))), positions=positions)


def test_a_stand_without_rings_is_divided_around_the_field():
    low, high = divide_lamps(field(cone(8, 35)))
    assert {tuple(low % 2), tuple(high % 2)} == {(0,) * 4, (1,) * 4}


def test_rings_of_any_order_and_number_are_told_apart():
    low, high = divide_lamps(field(cone(3, 50), cone(5, 20)))
    np.testing.assert_array_equal(low, [3, 4, 5, 6, 7])
    np.testing.assert_array_equal(high, [0, 1, 2])


def test_one_lamp_more_or_less_is_no_ring():
    low, high = divide_lamps(field(cone(8, 30), cone(1, 60)))
    assert sorted([len(low), len(high)]) == [4, 5]


@pytest.mark.parametrize(
    "lamps",
    [
        pytest.param(field(cone(5, 40)), id="too few"),
        pytest.param(field(cone(4, 89), cone(4, 20)), id="a ring that sees no slope"),
    ],
)
def test_lamps_that_have_no_two_halves_are_not_compared(lamps):
    assert divide_lamps(lamps) is None


def numbers(known):
    return {number.code: number for number in of_calibration(known, None) if number.code}


def test_the_stage_keeps_it_and_the_report_says_it(place, tmp_path):
    spoil(place, HIGH[1], lambda x: 1 + 0.06 * x)
    tile, recipe, store = load_capture(place)[0], load_recipe("default"), Store(tmp_path / "store")
    lamps = lights(store, tile, recipe.light_model)
    store.ensure(lamps)
    white = flat_field(store, tile, recipe.detrend.images, lamps.ref)
    store.ensure(white)
    work = calibration(store, tile, lamps.ref, white.ref, ("level",))
    store.ensure(work)
    known = read_calibration(store.path(work.ref))
    assert isinstance(known.answers, TwoAnswers)
    said = numbers(known)["two-rings"]
    assert said.value == known.answers.difference
    assert f"the low lamps ({', '.join(LOW)}) and by the high ones ({', '.join(HIGH)})" in said.warning
    assert numbers(None)["two-rings"].warning == ""
    assert numbers(None)["two-rings"].value is None
