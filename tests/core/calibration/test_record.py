"""What a calibration leaves in the store is read back as it was, and a level only where it was measured."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.record import (
    LARGEST,
    MISFIT,
    MODEL,
    OF_NOISE,
    read_calibration,
    read_uncertainty,
    write_calibration,
    write_nothing,
)
from nlights_core.calibration.two_rings import TwoAnswers
from nlights_core.frames import PixelGrid
from nlights_core.near_light.overview import block_edge

ANSWERS = TwoAnswers(0.02, 0.01, ("a", "b", "c", "d"), ("e", "f", "g", "h"), True, 0.06)


def test_what_all_share_is_read_back_as_it_was_written(varnished, tmp_path):
    _, scene = varnished
    write_calibration(tmp_path, scene.found, scene.errors, 0.02, ANSWERS, 1.1)
    known = read_calibration(tmp_path)
    np.testing.assert_array_equal(known.shared.vector(), scene.found.shared.vector())
    assert known.believed == scene.found.believed
    assert (known.residual, known.unreached) == (scene.errors.residual, 0.02)
    assert (known.answers, known.noisier) == (ANSWERS, 1.1)
    np.testing.assert_array_equal(np.load(tmp_path / "height.npy"), scene.found.height)
    np.testing.assert_array_equal(
        read_uncertainty(tmp_path), np.stack([scene.errors.height, scene.errors.slope, scene.errors.noisier])
    )


@pytest.mark.parametrize(
    ("sigma", "residual", "noise", "level", "stated", "misfit"),
    [
        (0.1, 0.0, 0.0, 0.0, 0.1, False),
        (0.03, 0.0, 0.0, 10.0, float(np.hypot(0.03, 10 * MODEL)), False),
        (LARGEST + 0.01, 0.0, 0.0, 0.0, None, False),
        (0.1, 1.1 * MISFIT, 0.0, 0.0, None, True),
        (0.1, 1.1 * MISFIT, 1.2 * MISFIT / OF_NOISE, 0.0, 0.1, False),
        (0.1, 0.0, 0.0, 2 * LARGEST / MODEL, None, False),
        (0.0, 0.0, 0.0, 0.0, None, False),
    ],
    ids=["sound", "high", "wide", "misfit", "noise", "too-high", "not-sought"],
)
def test_a_level_is_stated_where_it_was_measured(
    matt, tmp_path, sigma, residual, noise, level, stated, misfit
):
    _, scene = matt
    covariance = np.zeros_like(scene.found.covariance)
    covariance[0, 0] = sigma**2
    believed = ("level",) if sigma else ()
    found = replace(
        scene.found, believed=believed, covariance=covariance, shared=replace(scene.found.shared, level=level)
    )
    write_calibration(
        tmp_path, found, scene.errors._replace(residual=residual, noise=noise), 0.0, ANSWERS, 1.1
    )
    known = read_calibration(tmp_path)
    assert known.level_uncertainty == (None if stated is None else pytest.approx(stated))
    assert (known.shared.level, known.misfit) == (level, misfit)


def test_where_nothing_is_sought_nothing_is_said(tmp_path):
    write_nothing(tmp_path, 5, PixelGrid(61, 1100, 0.5), 1.1)
    known = read_calibration(tmp_path)
    assert not known.shared.vector().any()
    assert len(known.shared.strengths) == 5
    assert (known.level_uncertainty, known.residual, known.strange) == (None, None, None)
    assert (known.believed, known.misfit) == ((), False)
    height = np.load(tmp_path / "height.npy")
    assert height.shape == (61 // block_edge(1100), 1100 // block_edge(1100))
    assert not height.any()
    assert np.isnan(read_uncertainty(tmp_path)).all()
