"""Shading of the troubled captures against what is known of it exactly."""

import numpy as np
import pytest
from glossy_paint import (
    LOBES,
    Gloss,
    Paint,
    beckmann_facets,
    beckmann_unmasked,
    cosines,
    ggx_facets,
    ggx_unmasked,
    reflected,
    rough_body,
)

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import set_up
from nlights_core.simulation.illumination import VARNISH_EXPONENT, VARNISH_REFLECTANCE, shine

DEGREES = (0, 30, 60)


@pytest.fixture(scope="module")
def hemisphere():
    """Directions (3, h, w) and what each counts in an integral over the solid angle, (h, w)."""
    nodes, weights = np.polynomial.legendre.leggauss(300)
    up = (nodes + 1) / 2
    round_ = (np.arange(360) + 0.5) * 2 * np.pi / 360
    across = np.sqrt(1 - up**2)[:, None]
    ways = np.stack([across * np.cos(round_), across * np.sin(round_), np.repeat(up[:, None], 360, axis=1)])
    return ways, np.repeat(weights[:, None] / 2 * 2 * np.pi / 360, 360, axis=1)


def ray(degrees):
    angle = np.radians(degrees)
    return np.array([np.sin(angle), 0, np.cos(angle)])[:, None, None]


def seen(light, view):
    """Cosines on a level surface."""
    return cosines(np.array([0.0, 0.0, 1.0])[:, None, None], light, view)


def drawn(seed):
    """Random directions above a surface."""
    ways = np.random.default_rng(seed).normal(size=(3, 500, 1))
    ways[2] = np.abs(ways[2])
    return ways / np.linalg.norm(ways, axis=0)


@pytest.mark.parametrize("facets", [ggx_facets, beckmann_facets])
@pytest.mark.parametrize("roughness", [0.1, 0.35, 0.6, 1.0])
def test_the_facets_together_cover_the_surface_once(hemisphere, facets, roughness):
    ways, weights = hemisphere
    assert (facets(ways[2], roughness) * ways[2] * weights).sum() == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    ("facets", "unmasked"), [(ggx_facets, ggx_unmasked), (beckmann_facets, beckmann_unmasked)]
)
@pytest.mark.parametrize("degrees", DEGREES)
def test_the_facets_that_are_seen_fill_what_is_seen_of_the_surface(hemisphere, facets, unmasked, degrees):
    ways, weights = hemisphere
    view = ray(degrees)
    turned = np.maximum((ways * view).sum(axis=0), 0)
    filled = unmasked(view[2], 0.35) * (turned * facets(ways[2], 0.35) * weights).sum()
    assert filled.item() == pytest.approx(view[2].item(), abs=1e-3)


@pytest.mark.parametrize("lobe", ["ggx", "beckmann"])
@pytest.mark.parametrize("degrees", DEGREES)
def test_facets_never_send_back_more_than_they_receive_and_smooth_ones_all(hemisphere, lobe, degrees):
    ways, weights = hemisphere

    def sent_back(roughness):
        angles = seen(ways, ray(degrees))
        return (LOBES[lobe](angles, roughness) / np.pi * angles.lamp * weights).sum()

    assert 0.99 < sent_back(0.05) < 1.0001
    assert sent_back(0.6) < sent_back(0.35) < sent_back(0.05)


@pytest.mark.parametrize("lobe", LOBES)
def test_lamp_and_camera_can_change_places(lobe):
    there, back = (
        Gloss(lobe, 0.04, 0.35).radiance(seen(*pair)) for pair in ((drawn(1), drawn(2)), (drawn(2), drawn(1)))
    )
    assert there.max() > 0.1
    np.testing.assert_allclose(there, back, rtol=1e-9)


def test_rough_body_colour_is_as_published_in_angles():
    light, view = drawn(1), drawn(2)
    angles = seen(light, view)
    to_lamp, to_camera = np.arccos(light[2]), np.arccos(view[2])
    around = np.arctan2(light[1], light[0]) - np.arctan2(view[1], view[0])
    steady, varying = 1 - 0.5 * 0.25 / (0.25 + 0.33), 0.45 * 0.25 / (0.25 + 0.09)
    steep, low = np.maximum(to_lamp, to_camera), np.minimum(to_lamp, to_camera)
    published = steady + varying * np.maximum(0, np.cos(around)) * np.sin(steep) * np.tan(low)
    np.testing.assert_allclose(rough_body(angles, 0.5), published, rtol=1e-6)
    np.testing.assert_allclose(rough_body(angles, 0.5), rough_body(seen(view, light), 0.5), rtol=1e-12)
    np.testing.assert_array_equal(rough_body(angles, 0), 1)


def test_plain_paint_and_blinns_gloss_are_those_of_the_simulator():
    studio = set_up(load_stand("horizontal"), "relief", 80, True, 3)
    points, normals, _ = studio.truth(0, studio.grid.rows)
    camera = np.array(studio.grid.camera)
    paint = Paint(Gloss("blinn", VARNISH_REFLECTANCE, np.sqrt(2 / (VARNISH_EXPONENT + 2))))
    for group in studio.groups[::3]:
        matt, gloss = shine(group, points, normals, None, camera)
        ours = reflected(
            paint, group, points.astype(float), np.moveaxis(normals, -1, 0).astype(float), camera
        )
        np.testing.assert_allclose(ours[0][..., 0], matt, rtol=1e-5)
        np.testing.assert_allclose(ours[1][..., 0], gloss, atol=1e-5 * gloss.max())
