"""Blocks lose gloss of every kind and departure, whatever their neighbours are, and keep what cannot be known."""

import numpy as np
import pytest

from nlights_core.calibration.compiled_correction import correct_blocks
from nlights_core.calibration.reflectance import KINDS, ROUGHNESSES, Reflectance, excess
from nlights_core.photographs.blocks import BLOCK, SAMPLE, TRIAL, USABLE, VALUE, X, Y, Z
from nlights_core.photographs.strips import Blocks, Optics

LAMPS, COLUMNS = 8, 2 * BLOCK + 41
CAMERA = np.array([0, 0, 1500], np.float32)
ANGLES = 2 * np.pi / LAMPS * np.arange(LAMPS)
POSITIONS = np.stack([800 * np.cos(ANGLES), 800 * np.sin(ANGLES), np.full(LAMPS, 700)], -1).astype(np.float32)
X_OF = np.linspace(-300, 300, COLUMNS).astype(np.float32)
Y_OF = np.array([-90, 110], np.float32)
TINTS = np.array([0.8, 1.0, 1.1])
COLOURS = slice(VALUE, VALUE + BLOCK)
PLANE, NO_LIMIT = np.zeros((0, 0), np.float32), np.full(2, np.inf)


def gloss_of(**strengths):
    """The third lobe of each kind that is named."""
    gloss = np.zeros(len(KINDS))
    for kind, strength in strengths.items():
        gloss[KINDS.index(kind) + 2] = strength
    return gloss


def painted(reflectance):
    """Lights, true matt light, and what is read of rough, glossy paint, (L, h, w) each."""
    random = np.random.default_rng(4)
    points = np.stack([*np.meshgrid(X_OF, Y_OF), np.zeros((len(Y_OF), COLUMNS))], -1)
    lights = ((POSITIONS[:, None, None] - points) / 700).astype(np.float32)
    normals = random.normal([0, 0, 1], [0.08, 0.08, 0], points.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = random.uniform(0.2, 0.9, points.shape[:2])
    views = CAMERA - points
    views /= np.linalg.norm(views, axis=-1, keepdims=True)
    shine, rough = excess(reflectance, normals, lights.astype(float), views)
    body = np.einsum("lhwk,hwk->lhw", lights, normals)
    return lights, body * albedo, (body + rough) * albedo + shine, shine


def blocks_of(lights, read, shine, usable):
    def plane(values):
        filled = np.pad(values, [(0, 0), (0, 0), (0, -values.shape[2] % BLOCK)], mode="edge")
        return np.moveaxis(filled.reshape(LAMPS, -1, BLOCK), 0, 1)

    rows, columns = read.shape[1:]
    samples = np.zeros((rows * -(-columns // BLOCK), LAMPS, SAMPLE), np.float32)
    inside = np.arange(-(-columns // BLOCK) * BLOCK) < columns
    weights = np.where(np.tile(inside.reshape(-1, BLOCK), (rows, 1))[:, None], plane(usable), 0)
    for place, values in ((VALUE, plane(read)), (USABLE, weights), (TRIAL, weights)):
        samples[..., place : place + BLOCK] = values
    for k, place in enumerate((X, Y, Z)):
        samples[..., place : place + BLOCK] = plane(lights[..., k])
    colours = np.concatenate([plane(shine + tint * (read - shine)) for tint in TINTS], -1).astype(np.float32)
    none = np.zeros((0, 0), np.float32)
    return Blocks(samples, colours, none, none, np.zeros(0, np.float32))


def correct(blocks, x_of, reflectance, heights=PLANE, reach=NO_LIMIT):
    """What is left of grey and of the three colours, (S, L, BLOCK) and (S, L, 3, BLOCK), and what was taken out."""
    none = np.zeros(1, np.float32)
    optics = Optics(
        none, np.zeros((LAMPS, 4, 3), np.float32), POSITIONS, np.ones(1, np.float32), CAMERA,
        np.zeros((LAMPS, 4, 12), np.float32), (2, 2), none, none, none,
    )  # fmt: skip
    removed = np.empty((len(blocks.samples), 3 * BLOCK), np.float32)
    correct_blocks(
        x_of, Y_OF, heights, optics, blocks, reach, reflectance.gloss, reflectance.roughnesses,
        reflectance.grazing, reflectance.departure, 0.02, 0.002, 4.77, 5, removed,
    )  # fmt: skip
    return blocks.samples[..., COLOURS], blocks.colours.reshape(-1, LAMPS, 3, BLOCK), removed


def rows_of(values, columns):
    """Pixels of blocks as rows, (L, h, columns)."""
    return np.moveaxis(values, 1, 0).reshape(LAMPS, len(Y_OF), -1)[..., :columns]


@pytest.mark.parametrize(
    "reflectance",
    [
        Reflectance(gloss_of(ggx=0.6), 0.0),
        Reflectance(gloss_of(beckmann=0.6), 0.0),
        Reflectance(gloss_of(ggx=0.6), 0.0, grazing=6.0),
        Reflectance(gloss_of(blinn=0.6), 0.0),
        Reflectance(gloss_of(), 0.4),
        Reflectance(gloss_of(ggx=0.2, beckmann=0.3, blinn=0.3), 0.3),
        Reflectance(gloss_of(ggx=0.2, beckmann=0.3, blinn=0.3), 0.0, np.array(ROUGHNESSES) * 1.37),
    ],
    ids=["ggx", "beckmann", "strong ggx", "blinn", "rough", "all", "moved"],
)
def test_what_is_left_is_matt(reflectance):
    lights, matt, read, shine = painted(reflectance)
    grey, colours, removed = correct(blocks_of(lights, read, shine, np.ones(read.shape)), X_OF, reflectance)
    assert np.abs(read - matt).max() > 0.02
    np.testing.assert_allclose(rows_of(grey, COLUMNS), matt, atol=5e-5)
    for c, tint in enumerate(TINTS):
        np.testing.assert_allclose(rows_of(colours[:, :, c], COLUMNS), tint * matt, atol=5e-5)
        share = (shine + tint * (read - matt - shine)).sum(axis=0) / lights[..., 2].sum(axis=0)
        taken = removed.reshape(-1, 3, BLOCK)[:, c].reshape(len(Y_OF), -1)
        np.testing.assert_allclose(taken[:, :COLUMNS], share, atol=5e-5)
        assert not taken[:, COLUMNS:].any()


def test_a_pixel_does_not_depend_on_its_neighbours():
    reflectance = Reflectance(gloss_of(ggx=0.2, beckmann=0.3, blinn=0.3), 0.3)
    lights, _, read, shine = painted(reflectance)
    # Of one lamp a reading is wrong: these pixels take more rounds than others.
    read[3, :, ::9] *= 1.5
    usable = np.ones(read.shape)
    usable[5, :, 30:50] = 0
    whole = rows_of(correct(blocks_of(lights, read, shine, usable), X_OF, reflectance)[0], COLUMNS)
    cut = (part[:, :, 53:] for part in (lights, read, shine, usable))
    part = rows_of(correct(blocks_of(*cut), X_OF[53:], reflectance)[0], COLUMNS - 53)
    np.testing.assert_allclose(part, whole[..., 53:], atol=1e-6)


def test_a_pixel_without_a_normal_stays():
    reflectance = Reflectance(gloss_of(ggx=0.6, blinn=0.3), 0.3)
    lights, _, read, shine = painted(reflectance)
    usable = np.ones(read.shape)
    usable[2:, 1, 7] = 0
    usable[:, 0, : BLOCK + 3] = 0
    before = blocks_of(lights, read, shine, usable)
    unknown = usable.sum(axis=0) < 3
    old = before.samples[..., COLOURS].copy(), before.colours.reshape(-1, LAMPS, 3, BLOCK).copy()
    grey, colours, removed = correct(before, X_OF, reflectance)
    np.testing.assert_array_equal(rows_of(grey, COLUMNS)[:, unknown], rows_of(old[0], COLUMNS)[:, unknown])
    for c in range(3):
        new, was = (rows_of(part[:, :, c], COLUMNS) for part in (colours, old[1]))
        np.testing.assert_array_equal(new[:, unknown], was[:, unknown])
        assert np.all(np.any(new[:, ~unknown] != was[:, ~unknown], axis=0))
    assert np.isfinite(removed).all()


def test_rays_that_miss_the_flat_are_left_out():
    matt = Reflectance(gloss_of(), 0.0)
    lights, _, read, shine = painted(matt)
    blocks = blocks_of(lights, read, shine, np.ones(read.shape))
    height, reach = 30.0, np.array([280.0, 95.0])
    correct(blocks, X_OF, matt, np.full(read.shape[1:], height, np.float32), reach)
    # Where the camera's rays meet the surface, and from there the lamps' the plane.
    seen = np.stack([*np.meshgrid(X_OF, Y_OF)], -1) * (1 - height / CAMERA[2])
    lamps = POSITIONS[:, None, None, :2]
    landed = lamps + (seen - lamps) * (POSITIONS[:, 2] / (POSITIONS[:, 2] - height))[:, None, None, None]
    reached = (np.abs(landed) <= reach).all(axis=-1)
    assert 0.2 < reached.mean() < 0.8
    for place in (VALUE, USABLE, TRIAL):
        left = rows_of(blocks.samples[..., place : place + BLOCK], COLUMNS)
        np.testing.assert_array_equal(left > 0, reached)
