"""Lobes and the cross term are those of the literature."""

import numpy as np
import pytest
from scipy.special import erfc

from nlights_core.calibration.reflectance import (
    KINDS,
    NORMAL_REFLECTANCE,
    ROUGHNESSES,
    Reflectance,
    cross_term,
    grazing,
    highlights,
)

LOBES = list(zip(KINDS, ROUGHNESSES, strict=True))
UP = np.array([0.0, 0.0, 1.0])


def directions(count=4000, seed=0):
    """Directions of the upper half, evenly spread."""
    ways = np.random.default_rng(seed).normal(size=(count, 3))
    ways[:, 2] = np.abs(ways[:, 2])
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


@pytest.mark.parametrize(("kind", "roughness"), LOBES)
def test_facets_of_a_lobe_cover_the_surface_once(kind, roughness):
    """Seen from straight above with the lamp beside the camera, a highlight is D F / (4 cos): D integrates to 1."""
    angle = np.linspace(1e-6, np.pi / 2 - 1e-3, 400_001)
    normals = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    got = highlights(
        normals, np.broadcast_to(UP, normals.shape), np.broadcast_to(UP, normals.shape), [(kind, roughness)]
    )[0]
    square, cosine = roughness**2, np.cos(angle)
    if kind == "ggx":
        masking = (2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine**2))) ** 2
    elif kind == "beckmann":
        # Smith's masking itself, which the rational function comes close to.
        steep = 1 / (roughness * np.tan(angle))
        behind = erfc(steep) / 2
        masking = 1 / (1 + np.exp(-(steep**2)) / (2 * np.sqrt(np.pi) * steep) - behind) ** 2
    else:
        masking = cosine**2
    facets = got * 4 * cosine / (NORMAL_REFLECTANCE * masking)
    # Radiance is in units in which matt white has 1, so D comes without its pi.
    whole = np.sum(facets * cosine * 2 * np.sin(angle)) * (angle[1] - angle[0])
    assert whole == pytest.approx(1, abs=5e-3)


def test_highlights_are_the_same_when_lamp_and_camera_change_places():
    ways, others = directions(), directions(seed=1)
    there, back = highlights(UP, ways, others, LOBES), highlights(UP, others, ways, LOBES)
    # Radiance under light across the ray: the cosine of incidence is in it.
    np.testing.assert_allclose(there / ways[:, 2], back / others[:, 2], rtol=1e-10, atol=1e-200)


def test_nothing_shines_that_faces_away():
    up, behind = UP[None], np.array([[0.9, 0.0, -np.sqrt(1 - 0.81)]])
    assert not highlights(up, behind, up, LOBES).any()
    assert not highlights(up, up, behind, LOBES).any()
    assert not cross_term(up, behind, up).any()


@pytest.mark.parametrize("reflectance", [0.02, 0.04, 0.1, 0.25])
def test_lobes_of_any_strength_have_fresnels_term_of_their_reflectance(reflectance):
    """A mirror-like facet, lamp and camera at 60 degrees to it: the half vector is the normal."""
    lamp, camera = (np.array([side * np.sin(np.pi / 3), 0.0, 0.5]) for side in (1, -1))
    strength = reflectance / NORMAL_REFLECTANCE
    lobe = [("ggx", 0.3)]
    upright, slanting = (
        strength * highlights(UP, *ways, lobe, grazing(strength))[0] for ways in ((UP, UP), (lamp, camera))
    )
    square, facets = 0.3**2, 1 / 0.3**2
    masking = (2 * 0.5 / (0.5 + np.sqrt(square + (1 - square) * 0.25))) ** 2
    assert upright == pytest.approx(reflectance * facets / 4)
    fresnel = reflectance + (1 - reflectance) * 0.5**5
    assert slanting == pytest.approx(fresnel * facets * masking / (4 * 0.5))


def test_the_cross_term_is_that_of_oren_and_nayar():
    ways, others = directions(), directions(seed=1)
    first, second = np.arccos(ways[:, 2]), np.arccos(others[:, 2])
    azimuth = np.arctan2(ways[:, 1], ways[:, 0]) - np.arctan2(others[:, 1], others[:, 0])
    expected = np.maximum(np.cos(azimuth), 0) * np.sin(np.maximum(first, second))
    expected *= np.tan(np.minimum(first, second)) * np.cos(first)
    np.testing.assert_allclose(cross_term(UP, ways, others), expected, atol=1e-12)


def test_a_surface_without_gloss_and_departure_is_matt():
    none = np.zeros(len(KINDS))
    assert Reflectance(none, 0.0).matt
    assert not Reflectance(none, 0.1).matt
    assert not Reflectance(none + 0.1, 0.0).matt
