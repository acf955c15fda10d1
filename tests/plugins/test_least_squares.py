"""The least-squares solver against PSBox's own results on PSBox's own demo."""

from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from nlights_plugins.least_squares import LeastSquares

DATA = Path(__file__).parents[3] / "shared" / "data"


@pytest.mark.skipif(not (DATA / "golden").exists(), reason="PSBox's demo is not beside the project")
def test_given_psboxs_mask_and_lights_normals_and_albedo_are_psboxs():
    golden = np.load(DATA / "golden" / "psbox_demo.npz")
    photographs = [
        imagecodecs.imread(DATA / "psbox" / "Objects" / f"Image_{i:02d}.png")[::-1] for i in range(1, 13)
    ]
    # PSBox divides each photograph by its 99th percentile (MATLAB's, which numpy calls hazen).
    images = np.stack([image / np.percentile(image, 99, method="hazen") for image in photographs])
    weights = golden["shadow_mask"].transpose(2, 0, 1).astype(np.float32)
    lights = golden["L2"].T[:, None, None, :]
    found = LeastSquares(shadow=0, condition=1e9).solve(images, lights, weights)
    # nLights leaves unknown what faces away from the camera; PSBox keeps it.
    known = np.isfinite(golden["rho2"]) & (golden["n2"][..., 2] > 0)
    np.testing.assert_array_equal(np.isfinite(found.albedo), known)
    np.testing.assert_allclose(found.normals[known], golden["n2"][known], atol=1e-6)
    np.testing.assert_allclose(found.albedo[known], golden["rho2"][known], atol=1e-6)


def test_a_wrong_light_is_not_left_out_but_a_shadow_and_a_missing_one_are():
    lights = np.array(
        [[0.5, 0, 0.8], [-0.5, 0, 0.8], [0, 0.5, 0.8], [0, -0.5, 0.8], [0.3, 0.3, 0.9]], np.float32
    )
    normal = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])
    images = (0.6 * lights @ normal)[:, None, None].repeat(4, axis=2).astype(np.float32)
    weights = np.ones_like(images)
    images[0, 0, 1] = 0.0  # a cast shadow
    images[1, 0, 2], weights[1, 0, 2] = np.nan, 0  # not measured
    images[2, 0, 3] *= 1.2  # gloss
    found = LeastSquares().solve(images, lights[:, None, None, :], weights)
    np.testing.assert_allclose(found.normals[0, :3], np.tile(normal, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found.albedo[0, :3], 0.6, atol=1e-6)
    assert np.linalg.norm(found.normals[0, 3] - normal) > 0.01
    assert np.count_nonzero(found.weights[:, 0, 1]) == 4


def test_three_lights_in_a_row_are_no_three_lights():
    lights = np.array([[0.5, 0, 0.8], [0.0, 0, 0.9], [-0.5, 0, 0.8]], np.float32)[:, None, None, :]
    images = np.full((3, 1, 1), 0.5, np.float32)
    found = LeastSquares().solve(images, lights, np.ones_like(images))
    assert np.isnan(found.normals).all()
    assert np.isnan(found.confidence[0, 0])
