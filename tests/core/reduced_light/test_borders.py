"""What is no part of the artwork is found by its straight border; an artwork that fills the field is left whole."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from nlights_core.reduced_light.borders import find_border, read_proposal, write_border

SHAPE = (180, 240)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]
AZIMUTHS = np.radians(np.arange(8) * 45.0)


def paint(seed=0, low=0.25, high=0.6):
    """A painted albedo: large fields, strokes, noise."""
    rng = np.random.default_rng(seed)
    found = np.full(SHAPE, 0.4)
    for _ in range(60):
        y, x, turn = rng.uniform(0, 180), rng.uniform(0, 240), rng.uniform(0, np.pi)
        across = (ROWS - y) * np.cos(turn) - (COLUMNS - x) * np.sin(turn)
        along = (ROWS - y) * np.sin(turn) + (COLUMNS - x) * np.cos(turn)
        found[(np.abs(across) < rng.uniform(2, 12)) & (np.abs(along) < rng.uniform(10, 60))] = rng.uniform(
            low, high
        )
    return found


def photographed(albedo, shades=None, seed=1, flats=True):
    """Samples of a picture under 8 lamps; ``shades`` (L, h, w) is 0 where a lamp does not reach."""
    rng = np.random.default_rng(seed)
    lit = np.stack([0.7 + 0.2 * (np.cos(a) * COLUMNS / 240 + np.sin(a) * ROWS / 180) for a in AZIMUTHS])
    frames = albedo * lit * (1 if shades is None else 0.02 + 0.98 * shades)
    frames *= 1 + 0.01 * rng.standard_normal(frames.shape)
    return SimpleNamespace(frames=frames.astype(np.float32), flats=lit.astype(np.float32) if flats else None)


def rectangle(left=0, right=0, top=0, bottom=0, turn_deg=0.0):
    """Inside of a rectangle that leaves so many samples at each edge of the field."""
    t = np.radians(turn_deg)
    x, y = COLUMNS - 119.5, ROWS - 89.5
    x, y = x * np.cos(t) + y * np.sin(t) + 119.5, y * np.cos(t) - x * np.sin(t) + 89.5
    return (x >= left) & (x < 240 - right) & (y >= top) & (y < 180 - bottom)


def shadows(high, reach):
    """Shadows that what is high throws, ``reach`` samples away from each lamp."""
    shades = np.ones((8, *SHAPE))
    for i, a in enumerate(AZIMUTHS):
        for k in range(1, reach + 1):
            dy, dx = round(k * np.sin(a)), round(k * np.cos(a))
            shades[i] *= 1 - np.roll(high, (-dy, -dx), (0, 1)) * ~high
    return shades


def wrong(border, inside):
    """Samples of something else that stayed in, and of the artwork that were left out."""
    return int((border.inside & ~inside).sum()), int((~border.inside & inside).sum())


TABLES = {
    "all around": {"left": 30, "right": 22, "top": 14, "bottom": 40},
    "a corner": {"left": 50, "bottom": 30},
    "opposite": {"left": 20, "right": 60},
    "turned": {"left": 30, "right": 30, "top": 20, "bottom": 20, "turn_deg": 1.2},
}


@pytest.mark.parametrize("flats", [True, False])
@pytest.mark.parametrize("sides", TABLES.values(), ids=TABLES)
def test_a_black_cloth_is_left_out(sides, flats):
    inside = rectangle(**sides)
    cloth = 0.04 + 0.01 * np.sin(COLUMNS / 3) * np.sin(ROWS / 4)
    border = find_border(photographed(np.where(inside, paint(), cloth), flats=flats))
    beyond, lost = wrong(border, inside)
    assert beyond <= 5
    assert lost < 0.05 * inside.sum()
    assert not any(side.relief for side in border.sides)


@pytest.mark.parametrize("seed", range(3))
def test_a_frame_of_20_mm_is_told_from_the_picture_by_its_shadows(seed):
    inside = rectangle(20, 20, 18, 18)
    wood = 0.35 + 0.1 * np.sin(COLUMNS / 7 + 3 * np.sin(ROWS / 19))
    sample = photographed(np.where(inside, paint(seed), wood), shadows(~inside, 6))
    border = find_border(sample)
    assert wrong(border, inside)[0] == 0
    assert wrong(border, inside)[1] < 0.05 * inside.sum()
    assert all(side.relief for side in border.sides)
    assert len(border.sides) == 4


def test_a_panel_on_a_wooden_table_with_a_chart_beside_it():
    inside = rectangle(60, 20, 12, 16)
    beyond = 0.22 + 0.04 * np.sin(ROWS / 3 + np.sin(COLUMNS / 30))
    beyond[30:150, 10:40] = np.repeat(np.linspace(0.05, 0.9, 6), 20)[:, None]
    border = find_border(photographed(np.where(inside, paint(2), beyond), shadows(inside, 4)))
    assert {side.name for side in border.sides} >= {"left", "top", "bottom"}
    assert wrong(border, inside)[1] < 0.05 * inside.sum()
    assert not border.inside[30:150, 10:40].any()


def horizon():
    albedo = paint()
    albedo[110:] = 0.12 + 0.02 * np.sin(COLUMNS[110:] / 5)
    return albedo


def print_with_margins():
    return np.where(rectangle(25, 25, 25, 25), paint(), 0.85)


def ruled():
    albedo = np.full(SHAPE, 0.85)
    albedo[20:22], albedo[-22:-20], albedo[:, 20:22], albedo[:, -22:-20] = 0.2, 0.2, 0.2, 0.2
    return albedo


@pytest.mark.parametrize(
    "albedo", [np.full(SHAPE, 0.9), paint(1), paint(2, 0.03, 0.9), horizon(), print_with_margins(), ruled()]
)
@pytest.mark.parametrize("flats", [True, False])
def test_an_artwork_that_fills_the_field_is_left_whole(albedo, flats):
    assert find_border(photographed(albedo, flats=flats)) is None


def test_the_relief_of_a_picture_is_no_frame():
    rng = np.random.default_rng(5)
    high = np.zeros(SHAPE, bool)
    for _ in range(40):
        y, x = rng.integers(0, 170), rng.integers(0, 220)
        high[y : y + 9, x : x + 20] = True
    assert find_border(photographed(paint(), shadows(high, 3))) is None


def test_nothing_known_is_no_border():
    sample = photographed(np.full(SHAPE, 0.5))
    sample.frames[:] = np.nan
    assert find_border(sample) is None


def test_the_mask_of_the_photographs_is_that_of_the_small_picture():
    inside = rectangle(30, 22, 14, 40)
    border = find_border(photographed(np.where(inside, paint(), 0.04)))
    mask = border.mask(180 * 5 + 3, 240 * 5 + 4, 5)
    small = mask[2 : 180 * 5 : 5, 2 : 240 * 5 : 5]
    assert np.mean(small != border.inside) < 0.01
    assert not mask[-1].any()
    assert not mask[:, -1].any()


def test_what_was_found_is_written_in_words_and_as_a_picture(tmp_path):
    inside = rectangle(50, 0, 0, 30)
    border = find_border(photographed(np.where(inside, paint(), 0.04)))
    write_border(tmp_path, border)
    said = read_proposal(tmp_path)
    assert "left (dark), bottom (dark)" in said
    assert "mask: auto" in said
    picture = np.asarray(Image.open(tmp_path / "border.png")).astype(int)
    reddish = picture[..., 0] - picture[..., 2]
    assert reddish[~border.inside].min() > 50
    assert abs(reddish[border.inside]).max() == 0
    (tmp_path / "none").mkdir()
    write_border(tmp_path / "none", None)
    assert read_proposal(tmp_path / "none") == ""
    assert not list((tmp_path / "none").iterdir())
