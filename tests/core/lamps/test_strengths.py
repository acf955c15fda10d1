"""Strengths and ambient light: simulated truth, DiLiGenT, the matte sphere of UW, PSBox."""

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image
from scipy.io import loadmat

from nlights_core.errors import TileError
from nlights_core.fields import LightField
from nlights_core.lamps.spheres import circle_of_mask, highlight_centre, mirror_direction, to_grey
from nlights_core.lamps.strengths import refine, refine_strengths

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"

needs_data = pytest.mark.skipif(not DATA.exists(), reason="the real captures are not beside the repository")

AZIMUTH = np.radians(np.arange(8) * 45 + 22.5)
ELEVATION = np.radians(np.tile([15.0, 45.0], 4))
STAND = np.stack(
    [np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)], axis=1
)
UNEVEN = np.array([1.08, 0.95, 0.92, 1.06, 1.02, 0.93, 1.07, 0.97])


def matte(slopes, noise, strength=1.0, ambient=0.0, seed=0):
    """Images (8, N) of a matte surface whose slopes spread by ``slopes``, and its normals."""
    random = np.random.default_rng(seed)
    normals = np.concatenate([-random.normal(0, slopes, (5000, 2)), np.ones((5000, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = random.uniform(0.2, 0.9, 5000)
    lit = np.maximum(STAND @ normals.T, 0)
    images = albedo * (np.broadcast_to(strength, 8)[:, None] * lit + np.broadcast_to(ambient, 8)[:, None])
    return images * (1 + random.normal(0, noise, images.shape)), normals


def solve(images, lights, shadow=None):
    """Scaled normals (N, 3) by plain least squares over the samples above ``shadow``."""
    if shadow is None:
        return np.linalg.lstsq(lights, images, rcond=None)[0].T
    used = images > shadow
    moments = np.einsum("ln,li,lk->nik", used, lights, lights)
    right = np.einsum("ln,li->ni", used * images, lights)
    found = np.full((images.shape[1], 3), np.nan)
    enough = np.linalg.cond(moments) < 1e6
    found[enough] = np.linalg.solve(moments[enough], right[enough][..., None])[..., 0]
    return found


def solve_refined(images, lights, strength, ambient, shadow=None):
    """As the chain does: divide by the strength, subtract the ambient share, solve again."""
    images, share = images / strength[:, None], ambient / strength
    scaled = solve(images, lights, shadow)
    for _ in range(4):
        scaled = solve(images - share[:, None] * np.linalg.norm(scaled, axis=1), lights, shadow)
    return scaled


def error(scaled, normals):
    """Mean angle to the true normals, degrees."""
    unit = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    return float(np.nanmean(np.degrees(np.arccos(np.clip((unit * normals).sum(axis=1), -1, 1)))))


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_strengths_that_are_8_percent_off_are_recovered_to_1_percent_on_relief(noise):
    images, _ = matte(0.5, noise, UNEVEN)
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_allclose(strength, UNEVEN / UNEVEN.mean(), atol=0.01)
    np.testing.assert_allclose(ambient, 0, atol=0.005)


def test_a_painting_with_3_degrees_of_texture_gains_a_factor_of_three_though_one_side_is_brighter():
    images, normals = matte(0.05, 0.01, 1 + 0.08 * np.cos(AZIMUTH))
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    before = error(solve(images, STAND), normals)
    assert error(solve_refined(images, STAND, strength, ambient), normals) < before / 3


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_true_strengths_of_a_flat_painting_stay_and_its_normals_do_not_tilt(noise):
    images, normals = matte(0.0, noise)
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    scaled = solve_refined(images, STAND, strength, ambient)
    tilt = error(scaled.mean(axis=0, keepdims=True), normals[:1])
    assert tilt < error(solve(images, STAND), normals) / 2


def test_without_the_prior_a_flat_painting_does_tilt():
    images, normals = matte(0.0, 0.01)
    strength, ambient = refine_strengths(images, STAND[:, None, :], prior=0)
    scaled = solve_refined(images, STAND, strength, ambient)
    assert error(scaled.mean(axis=0, keepdims=True), normals[:1]) > 1


def test_ambient_light_that_no_other_light_can_imitate_is_found():
    # What alpha = beta . l can imitate is a change of the normals; take it out of the pattern.
    pattern = 0.03 * np.array([1, 1, -1, -1, 1, 1, -1, -1.0])
    pattern -= STAND @ np.linalg.lstsq(STAND, pattern, rcond=None)[0]
    images, _ = matte(0.3, 0.001, ambient=pattern)
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_allclose(ambient, pattern, atol=0.003)
    np.testing.assert_allclose(strength, 1, atol=0.01)


def test_strengths_are_recovered_under_ambient_light_of_3_percent():
    truth = 0.03 * UNEVEN
    images, _ = matte(0.4, 0.005, UNEVEN, truth)
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_allclose(strength, UNEVEN / UNEVEN.mean(), atol=0.01)
    # The normals take what alpha_i = beta . (s_i l_i) can imitate.
    lights = STAND * UNEVEN[:, None]
    seen = truth - lights @ np.linalg.lstsq(lights, truth, rcond=None)[0]
    np.testing.assert_allclose(ambient, seen, atol=0.005)


def test_what_gloss_looks_like_is_not_taken_for_ambient_light_nor_for_strengths():
    images, normals = matte(0.4, 0.005)
    halfway = STAND + np.array([0, 0, 1])
    halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
    images += 0.3 * np.maximum(halfway @ normals.T, 0) ** 60
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_array_equal(ambient, 0)
    np.testing.assert_allclose(strength, 1, atol=0.01)


def test_a_stronger_prior_stays_closer_to_the_given_lights():
    images, _ = matte(0.05, 0.01, UNEVEN)
    away = [
        np.abs(refine_strengths(images, STAND[:, None, :], prior=p)[0] - 1).max() for p in (1, 100, 10000)
    ]
    assert away[0] > away[1] > away[2]
    assert away[2] < 0.02


def test_gloss_and_unknown_samples_do_not_pull_the_strengths():
    images, _ = matte(0.5, 0.005, UNEVEN)
    random = np.random.default_rng(1)
    images[0, random.random(5000) < 0.2] *= 1.8
    images[:, random.random(5000) < 0.1] = np.nan
    images[3, random.random(5000) < 0.2] = np.nan
    given = images.copy()
    strength, _ = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_allclose(strength, UNEVEN / UNEVEN.mean(), atol=0.01)
    np.testing.assert_array_equal(images, given)


def test_refining_a_light_field_makes_the_chain_see_unit_lamps():
    truth = 0.02 * UNEVEN
    images, _ = matte(0.5, 0.0, UNEVEN, truth)
    field = LightField(lamps=tuple("abcdefgh"), directions=STAND, power=np.full((8, 3), 2.0))
    refined = refine(field, images, STAND[:, None, :])
    strength, ambient = refine_strengths(images, STAND[:, None, :])
    np.testing.assert_allclose(refined.power, 2 * np.repeat(strength[:, None], 3, axis=1))
    np.testing.assert_allclose(refined.ambient * strength, ambient)
    assert refined.directions is field.directions


def test_without_a_prior_the_chain_sees_strengths_alone_of_mean_1():
    images, _ = matte(0.5, 0.0, UNEVEN)
    field = LightField(lamps=tuple("abcdefgh"), directions=STAND)
    refined = refine(field, images, STAND[:, None, :], prior=0)
    np.testing.assert_allclose(refined.power.ravel(), UNEVEN / UNEVEN.mean(), atol=1e-3)
    np.testing.assert_array_equal(refined.ambient, 0)


def test_too_few_lit_pixels_are_refused():
    images, _ = matte(0.1, 0.0)
    images[3:] = 0
    with pytest.raises(TileError, match="only 0 sampled pixels are lit by at least 4 of 8 lamps"):
        refine_strengths(images, STAND[:, None, :])


@needs_data
@pytest.mark.parametrize(("name", "plain"), [("ball", 4.17), ("bear", 8.39)])
def test_diligent_whose_true_strength_is_1_is_not_made_worse(name, plain):
    folder = DATA / "diligent" / name
    inside = imagecodecs.imread(folder / "mask.png") > 0
    inside = inside if inside.ndim == 2 else inside[..., 0]
    lights = np.loadtxt(folder / "light_directions.txt")
    intensities = np.loadtxt(folder / "light_intensities.txt")
    names = (folder / "filenames.txt").read_text().split()
    photographs = [imagecodecs.imread(folder / name) for name in names]
    assert photographs[0].dtype == np.uint16
    rows = [
        p[inside] / 65535 / e @ [0.299, 0.587, 0.114] for p, e in zip(photographs, intensities, strict=True)
    ]
    images = np.array(rows)
    normals = loadmat(folder / "Normal_gt.mat")["Normal_gt"][inside]
    before = error(solve(images, lights), normals)
    assert before == pytest.approx(plain, abs=0.005)
    chosen = np.random.default_rng(0).permutation(images.shape[1])[:1000]
    strength, ambient = refine_strengths(images[:, chosen], lights[:, None, :])
    assert error(solve_refined(images, lights, strength, ambient), normals) <= before + 0.05


@needs_data
def test_the_matte_sphere_of_uw_improves_under_lights_from_the_chrome_sphere():
    def photograph(name):
        return np.asarray(Image.open(DATA / "uw" / f"{name}.tga").convert("RGB")) / 255

    circle = circle_of_mask(to_grey(photograph("chrome/chrome.mask")))
    spots = [
        highlight_centre(to_grey(photograph(f"chrome/chrome.{i}")), circle, 250 / 255) for i in range(12)
    ]
    lights = np.array([mirror_direction(spot, circle) for spot in spots])
    mask = to_grey(photograph("gray/gray.mask"))
    circle = circle_of_mask(mask)
    row, column = np.nonzero(mask > 0.5)
    x, y = (column - circle[0]) / circle[2], (circle[1] - row) / circle[2]
    facing = x**2 + y**2 < 1 - 0.2**2
    row, column, x, y = (values[facing] for values in (row, column, x, y))
    normals = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=1)
    images = np.array([to_grey(photograph(f"gray/gray.{i}"))[row, column] for i in range(12)])
    before = error(solve(images, lights, shadow=0.05), normals)
    assert before <= 5.3
    chosen = np.random.default_rng(0).permutation(images.shape[1])[:5000]
    strength, ambient = refine_strengths(images[:, chosen], lights[:, None, :])
    assert error(solve_refined(images, lights, strength, ambient, shadow=0.05), normals) < before


@needs_data
def test_without_prior_and_ambient_the_strengths_are_those_of_psbox():
    golden = np.load(DATA / "golden" / "psbox_demo.npz")
    # PSBox: y-up, columns first, indices from 1, each image relative to its 99th percentile.
    chosen = golden["sampleIdx"].ravel().astype(int) - 1
    rows = []
    for i in range(1, 13):
        image = imagecodecs.imread(DATA / "psbox" / "Objects" / f"Image_{i:02d}.png")[::-1]
        rows.append(image.ravel(order="F")[chosen] / np.percentile(image, 99, method="hazen"))
    lights = np.loadtxt(DATA / "psbox" / "light_directions.txt").T
    strength, ambient = refine_strengths(
        np.array(rows), lights[:, None, :], prior=0, with_ambient=False, robust=False, shadow=0
    )
    reference = golden["lambda"].ravel()
    np.testing.assert_allclose(strength / strength.mean(), reference / reference.mean(), atol=1e-5)
    np.testing.assert_array_equal(ambient, 0)
    field = LightField(lamps=tuple(f"L{i}" for i in range(12)), directions=lights)
    refined = refine(field, np.array(rows), lights[:, None, :], prior=0)
    np.testing.assert_allclose(refined.power.ravel(), reference / reference.mean(), atol=1e-5)
    np.testing.assert_array_equal(refined.ambient, 0)
